"""Cameras on loopback that damage what they send, and know when they have sent which picture."""

import random
import socket
import subprocess
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import cv2
import imageio_ffmpeg
import numpy as np
from rtsp_camera import RtspCamera, free_port


@dataclass(frozen=True, slots=True, kw_only=True)
class Film:
    """What a camera sees: `count` pictures by their numbers, each uint8 (H, W, 3) BGR. The first `whole_at_first` are
    sent whole by every camera, so that the viewer gets to know the stream."""

    picture: Callable[[int], np.ndarray]
    count: int
    rate_hz: float
    whole_at_first: int

    def play(self) -> Iterator[tuple[int, np.ndarray]]:
        """Yield number and picture when each is due."""
        start_s = time.monotonic()
        for number in range(self.count):
            picture = self.picture(number)
            time.sleep(max(0.0, start_s + number / self.rate_hz - time.monotonic()))
            yield number, picture


class Camera(Protocol):
    """A camera at `uri`, which films when told to `roll`. `sent_s` is when each picture began to leave it, by its
    number, on the monotonic clock; `done` is set once the last one has left."""

    uri: str
    sent_s: dict[int, float]
    done: threading.Event

    def roll(self) -> None: ...

    def close(self) -> None:
        """Wait until all is sent, and release the sockets."""
        ...


class MjpegCamera:
    """MJPEG over HTTP, to one viewer; `damage` changes the JPEG file of a picture."""

    def __init__(self, film: Film, damage: Callable[[bytes], bytes]) -> None:
        self.sent_s: dict[int, float] = {}
        self.done = threading.Event()
        self._film, self._damage, self._rolls = film, damage, threading.Event()
        self._server = socket.create_server(("127.0.0.1", 0))
        self._server.settimeout(60)
        self.uri = f"http://127.0.0.1:{self._server.getsockname()[1]}/"
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def roll(self) -> None:
        self._rolls.set()

    def close(self) -> None:
        self._rolls.set()
        self._thread.join()

    def _serve(self) -> None:
        with self._server, self._server.accept()[0] as viewer:
            viewer.recv(4096)
            viewer.sendall(b"HTTP/1.0 200 OK\r\nContent-Type: multipart/x-mixed-replace;boundary=part\r\n\r\n")
            self._rolls.wait()
            for number, picture in self._film.play():
                jpeg = cv2.imencode(".jpg", picture)[1].tobytes()
                if number >= self._film.whole_at_first:
                    jpeg = self._damage(jpeg)
                head = f"--part\r\nContent-Type: image/jpeg\r\nContent-Length: {len(jpeg)}\r\n\r\n".encode()
                self.sent_s[number] = time.monotonic()
                try:
                    viewer.sendall(head + jpeg + b"\r\n")
                except OSError:  # the viewer has gone
                    break
        self.done.set()


class LossyCamera:
    """An encoder of which a share of the datagrams is lost: MPEG-TS over UDP, RTP described by an .sdp file, or an RTSP
    server behind such a lossy radio, which itself loses nothing."""

    def __init__(self, film: Film, encoder: tuple[str, ...], transport: str, lost: float, seed: int) -> None:
        self.sent_s: dict[int, float] = {}
        self.done = threading.Event()
        self._film, self._lost, self._random = film, lost, random.Random(seed)
        self._rolls, self._filmed = threading.Event(), threading.Event()
        self._in = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._in.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 21)
        self._in.bind(("127.0.0.1", 0))
        self._in.settimeout(0.2)
        inner, outer = self._in.getsockname()[1], free_port()
        self._viewer = "127.0.0.1", outer
        self._pictures_begun = _PicturesInTs() if transport == "MPEG-TS" else _PicturesInRtp()
        self._folder = tempfile.TemporaryDirectory()
        sdp = Path(self._folder.name) / "camera.sdp"
        target = ["-f", "rtp", "-sdp_file", str(sdp), f"rtp://127.0.0.1:{inner}?pkt_size=1200"]
        if transport == "MPEG-TS":
            target = ["-f", "mpegts", f"udp://127.0.0.1:{inner}?pkt_size=1316"]
        self._encoder = _encoder(film, encoder, target)
        self._threads = [threading.Thread(target=work, daemon=True) for work in (self._feed, self._hand_on)]
        for thread in self._threads:
            thread.start()
        self._server: RtspCamera | None = None
        self.uri = f"udp://127.0.0.1:{outer}"
        if transport != "MPEG-TS":
            while not (sdp.exists() and f"m=video {inner} " in sdp.read_text() and sdp.read_text().endswith("\n")):
                time.sleep(0.02)
            sdp.write_text(sdp.read_text().replace(f"m=video {inner} ", f"m=video {outer} "))
            self.uri = str(sdp)
        if transport == "RTSP":
            self._server = RtspCamera(sdp.read_text(), outer, free_port())
            self.uri = self._server.uri

    def roll(self) -> None:
        self._rolls.set()

    def close(self) -> None:
        self._rolls.set()
        for thread in self._threads:
            thread.join()
        if self._server:
            self._server.switch_off()
        self._folder.cleanup()

    def _feed(self) -> None:
        with self._encoder.stdin as pipe:
            pipe.write(self._film.picture(0).tobytes())  # the encoder says what it sends only when it has seen one
            pipe.flush()
            self._rolls.wait()
            for _, picture in self._film.play():
                pipe.write(picture.tobytes())
                pipe.flush()
        self._encoder.wait()
        self._filmed.set()

    def _hand_on(self) -> None:
        number = -2  # the first picture is shown twice
        with self._in, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
            while True:
                try:
                    datagram = self._in.recv(65536)
                except TimeoutError:
                    if self._filmed.is_set():
                        break
                    continue
                for _ in range(self._pictures_begun.in_datagram(datagram)):
                    number += 1
                    if number >= 0:
                        self.sent_s[number] = time.monotonic()
                if len(self.sent_s) <= self._film.whole_at_first or self._random.random() >= self._lost:
                    out.sendto(datagram, self._viewer)
        self.done.set()


class _PicturesInTs:
    """Counts the pictures that begin in a datagram of MPEG-TS packets: the units of FFmpeg's first stream."""

    def in_datagram(self, datagram: bytes) -> int:
        packets = (datagram[start : start + 188] for start in range(0, len(datagram), 188))
        return sum(packet[1] == 0x41 and packet[2] == 0 for packet in packets)


class _PicturesInRtp:
    """Counts the pictures that begin in an RTP datagram, one at most: each has a time stamp of its own."""

    def __init__(self) -> None:
        self._stamp = b""

    def in_datagram(self, datagram: bytes) -> int:
        before, self._stamp = self._stamp, datagram[4:8]
        return before != self._stamp


def _encoder(film: Film, codec: tuple[str, ...], target: list[str]) -> subprocess.Popen:
    height, width = film.picture(0).shape[:2]
    source = ["-f", "rawvideo", "-pix_fmt", "bgr24", "-s", f"{width}x{height}", "-r", f"{film.rate_hz:g}", "-i", "-"]
    return subprocess.Popen(
        [imageio_ffmpeg.get_ffmpeg_exe(), "-v", "quiet", *source, *codec, *target],
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
    )
