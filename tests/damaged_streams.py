"""Cameras on loopback whose streams are cut, corrupted or lose packets, and what of their pictures is delivered.

Every picture carries its number in every band of its rows, so that what is delivered tells how old each part of it is.
"""

import random
import socket
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from unittest.mock import patch

import cv2
import numpy as np
from answering_cameras import RTCP, RtspCamera
from encoders import Encoder, describe_rtp
from loopback import free_port
from numbered_pictures import HEIGHT, WIDTH, draw_picture, read_numbers

from edgevpr.frames.decoding import TimedPacket, VideoDecoder
from edgevpr.frames.shot import Condition
from edgevpr.frames.source import open_source

_X264 = {"preset": "ultrafast", "tune": "zerolatency", "g": "30"}
_ENCODERS = {  # by FFmpeg's names of codecs and of their options
    "H.264": ("libx264", _X264),
    "H.264, refreshed bit by bit": ("libx264", _X264 | {"x264-params": "intra-refresh=1"}),
    "H.265": ("libx265", _X264 | {"x265-params": "log-level=none"}),
    "MPEG-2": ("mpeg2video", {"g": "15", "b": "2M"}),
    "MJPEG": ("mjpeg", {"huffman": "default", "threads": "1", "qmin": "4", "qmax": "4"}),
}
_TS_BYTES = 7 * 188  # of a datagram of MPEG-TS
_MJPEG = ("whole", "cut to 15 %", "bytes corrupted", "truncated")
_LOSSY = (
    ("H.264", "MPEG-TS", (0.0, 0.1, 0.3, 0.5)),
    ("H.264, refreshed bit by bit", "MPEG-TS", (0.0, 0.02)),
    ("H.265", "MPEG-TS", (0.1,)),
    ("MPEG-2", "MPEG-TS", (0.1,)),
    ("H.264", "RTP", (0.0, 0.02, 0.1, 0.3, 0.5)),
    ("H.265", "RTP", (0.1,)),
    ("MPEG-2", "RTP", (0.1,)),
    ("MJPEG", "RTP", (0.02, 0.1)),
    ("H.264", "RTSP", (0.0, 0.02, 0.1, 0.3, 0.5)),
    ("H.265", "RTSP", (0.1,)),
    ("MPEG-2", "RTSP", (0.1,)),
    ("MJPEG", "RTSP", (0.02,)),
)
RATE_HZ = 40.0
OLD_S = 1.0
_WHOLE_AT_FIRST = 80  # pictures that every camera sends, so that the viewer gets to know the stream
_TOO_SLOW = ("MJPEG over HTTP, whole", "H.264 in MPEG-TS, 0% lost", "H.264 in RTSP, 0% lost")
_SLOWER = 2.0  # than the stream: the work for a picture; and than the others: how long it is borne
_LONGER = 3


@dataclass(frozen=True, slots=True, kw_only=True)
class Film:
    """What a camera sees: `count` pictures by their numbers, each uint8 (H, W, 3) BGR."""

    count: int
    rate_hz: float

    def play(self) -> Iterator[tuple[int, np.ndarray]]:
        """Yield number and picture when each is due."""
        start_s = time.monotonic()
        for number in range(self.count):
            shown = draw_picture(number)
            time.sleep(max(0.0, start_s + number / self.rate_hz - time.monotonic()))
            yield number, shown


class Camera:
    """A camera at `uri`, which films when told to `roll`. `sent_s` is when each picture began to leave it, by its
    number, on the monotonic clock; `done` is set once the last one has left."""

    uri = ""

    def __init__(self, film: Film) -> None:
        self.sent_s: dict[int, float] = {}
        self.done = threading.Event()
        self._film, self._rolls = film, threading.Event()
        self._thread = threading.Thread(target=self._send, daemon=True)

    def _send(self) -> None:
        raise NotImplementedError

    def roll(self) -> None:
        self._rolls.set()

    def close(self) -> None:
        """Wait until all is sent, and release the sockets."""
        self._rolls.set()
        self._thread.join()


class MjpegCamera(Camera):
    """MJPEG over HTTP, to one viewer; `damage` changes the JPEG file of a picture."""

    def __init__(self, film: Film, damage: Callable[[bytes], bytes]) -> None:
        super().__init__(film)
        self._damage = damage
        self._server = socket.create_server(("127.0.0.1", 0))
        self._server.settimeout(60)
        self.uri = f"http://127.0.0.1:{self._server.getsockname()[1]}/"
        self._thread.start()

    def _send(self) -> None:
        with self._server, self._server.accept()[0] as viewer:
            viewer.recv(4096)
            viewer.sendall(b"HTTP/1.0 200 OK\r\nContent-Type: multipart/x-mixed-replace;boundary=part\r\n\r\n")
            self._rolls.wait()
            for number, shown in self._film.play():
                jpeg = cv2.imencode(".jpg", shown)[1].tobytes()
                if number >= _WHOLE_AT_FIRST:
                    jpeg = self._damage(jpeg)
                head = f"--part\r\nContent-Type: image/jpeg\r\nContent-Length: {len(jpeg)}\r\n\r\n".encode()
                self.sent_s[number] = time.monotonic()
                try:
                    viewer.sendall(head + jpeg + b"\r\n")
                except OSError:  # the viewer has gone
                    break
        self.done.set()


class LossyCamera(Camera):
    """An encoder of which a share of the datagrams is lost: MPEG-TS over UDP, RTP described by an .sdp file, or an RTSP
    server behind such a lossy radio, which itself loses nothing."""

    def __init__(self, film: Film, encoder: tuple[str, dict[str, str]], transport: str, lost: float, seed: int) -> None:
        super().__init__(film)
        (self._codec, self._options), self._lost, self._random = encoder, lost, random.Random(seed)
        self._form = "mpegts" if transport == "MPEG-TS" else "rtp"
        self._viewer = "127.0.0.1", free_port()
        self.uri = f"udp://127.0.0.1:{self._viewer[1]}"
        self._folder = tempfile.TemporaryDirectory()
        self._server: RtspCamera | None = None
        sdp = describe_rtp(self._codec, self._viewer[1])
        if transport == "RTP":
            path = Path(self._folder.name) / "camera.sdp"
            path.write_text(sdp)
            self.uri = str(path)
        if transport == "RTSP":
            self._server = RtspCamera(sdp)
            self.uri = self._server.uri
        self._thread.start()

    def close(self) -> None:
        super().close()
        if self._server:
            self._server.close()
        self._folder.cleanup()

    def _send(self) -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
            give = partial(self._forward, out)
            encoder = Encoder(give, self._form, self._codec, self._film.rate_hz, (WIDTH, HEIGHT), self._options)
            self._rolls.wait()
            for number, shown in self._film.play():
                self.sent_s[number] = time.monotonic()
                encoder.write(number, shown)
            encoder.close()
        self.done.set()

    def _forward(self, out: socket.socket, data: bytes) -> None:
        size = _TS_BYTES if self._form == "mpegts" else len(data)
        for datagram in (data[start : start + size] for start in range(0, len(data), size)):
            is_rtcp = self._form == "rtp" and datagram[1] == RTCP
            if is_rtcp or (len(self.sent_s) > _WHOLE_AT_FIRST and self._random.random() < self._lost):
                continue
            if self._server:
                self._server.send(datagram)
            else:
                out.sendto(datagram, self._viewer)


def list_cameras(seed: int) -> dict[str, Callable[[Film], Camera]]:
    """Return what makes the camera of each stream, by name, with damage drawn from a seed."""
    cameras: dict[str, Callable[[Film], Camera]] = {}
    for kind in _MJPEG:
        cameras[f"MJPEG over HTTP, {kind}"] = partial(MjpegCamera, damage=_damage(kind, random.Random(seed)))
    for codec, transport, shares in _LOSSY:
        for lost in shares:
            way = {"encoder": _ENCODERS[codec], "transport": transport, "lost": lost, "seed": seed}
            cameras[f"{codec} in {transport}, {lost:.0%} lost"] = partial(LossyCamera, **way)
    return cameras


def _damage(kind: str, dice: random.Random) -> Callable[[bytes], bytes]:
    def corrupt(jpeg: bytes) -> bytes:
        damaged = bytearray(jpeg)
        for _ in range(5):
            damaged[dice.randrange(len(damaged))] = dice.randrange(256)
        return bytes(damaged)

    def damage_some(damage: Callable[[bytes], bytes]) -> Callable[[bytes], bytes]:
        return lambda jpeg: damage(jpeg) if dice.random() < 0.5 else jpeg

    return {
        "whole": lambda jpeg: jpeg,
        "cut to 15 %": lambda jpeg: jpeg[: len(jpeg) * 15 // 100],
        "bytes corrupted": damage_some(corrupt),
        "truncated": damage_some(lambda jpeg: jpeg[: dice.randrange(len(jpeg))]),
    }[kind]


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """Counts of the pictures of one stream, of which nothing need be lost where it `is_whole`. `sent` counts from the
    first that was delivered; `delivered` to the flight or superseded by a newer one; `refused` by reason; of those
    `looked_at`, `old` have a part more than a second older than the frame claims, and `broken` a part that cannot be
    read; `latency_s` is that of the slowest."""

    stream: str
    is_whole: bool
    sent: int
    delivered: int
    refused: dict[str, int]
    looked_at: int
    old: int
    broken: int
    latency_s: float


def run(
    count: int, seed: int, only: Callable[[str], bool] = lambda stream: True, rate_hz: float = RATE_HZ
) -> list[Row]:
    """Send `count` pictures over every stream whose name is wanted, and judge what is delivered; then over some once
    more, with a decoder that is too slow for them."""
    film = Film(count=count, rate_hz=rate_hz)
    cameras = list_cameras(seed)
    rows = [_judge(name, make(film)) for name, make in cameras.items() if only(name)]
    for name in _TOO_SLOW:
        slow = f"{name}, decoded too slowly"
        if only(slow):
            with patch.object(VideoDecoder, "decode", _slow_down(VideoDecoder.decode, _SLOWER / rate_hz)):
                rows.append(_judge(slow, cameras[name](replace(film, count=_LONGER * count))))
    return rows


def _slow_down(decode: Callable[..., object], work_s: float) -> Callable[..., object]:
    """Let every packet take so much longer to decode."""

    def decode_slowly(whole: VideoDecoder, fetched: TimedPacket) -> object:
        time.sleep(work_s)
        return decode(whole, fetched)

    return decode_slowly


def _judge(stream: str, camera: Camera) -> Row:
    source = open_source(camera.uri, live=True)
    camera.roll()
    looked_at = old = broken = 0
    first, superseded = None, 0  # the first picture looked at, and how many before it were not
    latencies_s = [0.0]
    # What the source still holds when all is sent is not lost: it is read until the source says that no more comes.
    while (frame := source.read(0.05)) or not (camera.done.is_set() and source.condition is Condition.LOST):
        if frame is None:
            continue
        numbers = read_numbers(frame.image)
        known = [number for number in numbers if number in camera.sent_s]
        looked_at += 1
        old += any(frame.t_mono_s - camera.sent_s[number] > OLD_S for number in known)
        broken += None in numbers
        if not camera.done.is_set():  # the very last one comes when the stream is given up
            latencies_s.append(source.latency_s)
        if first is None and known:
            first, superseded = max(known), int(frame.name.split()[1])
    delivered = looked_at + source.dropped - superseded
    refused = dict(source.refused)
    source.close()
    camera.close()
    return Row(
        stream=stream,
        is_whole=stream.endswith((", whole", " 0% lost")),
        sent=len(camera.sent_s) - (first or 0),
        delivered=delivered,
        refused=refused,
        looked_at=looked_at,
        old=old,
        broken=broken,
        latency_s=max(latencies_s),
    )
