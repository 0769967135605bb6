"""Cameras on loopback that damage what they send, and pictures in which the time can be read from the pixels."""

import random
import socket
import subprocess
import tempfile
import threading
import time
import zlib
from collections.abc import Callable
from pathlib import Path

import cv2
import imageio_ffmpeg
import numpy as np

WIDTH, HEIGHT = 320, 240
_BAND_PX, _BAR_PX = 16, 16
_NUMBER_BITS, _CHECK_BITS = 12, 8
_WHOLE_AT_FIRST = 20  # pictures before the damage begins, so that the source knows the stream
_PACKETS_AT_FIRST = 40


def _texture() -> np.ndarray:
    noise = np.random.default_rng(1).integers(0, 256, (1024, 1024)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 2.0)
    return np.clip((smooth - smooth.mean()) * 6 + 128, 0, 255).astype(np.uint8)


_GROUND = _texture()


def _bars(number: int) -> tuple[int, ...]:
    grey = (number ^ (number >> 1)) & (2**_NUMBER_BITS - 1)
    word = grey << _CHECK_BITS | zlib.crc32(grey.to_bytes(2, "big")) & (2**_CHECK_BITS - 1)
    return tuple((word >> bit) & 1 for bit in reversed(range(_NUMBER_BITS + _CHECK_BITS)))


_NUMBERS = {_bars(number): number for number in range(2**_NUMBER_BITS)}


def picture(number: int) -> np.ndarray:
    """Return the picture of this number, (240, 320, 3) BGR: ground that moves by, and in every band of rows the number
    as a code of bars with its check."""
    y, x = 2 * number % 700, 3 * number % 700
    grey = _GROUND[y : y + HEIGHT, x : x + WIDTH].copy()
    row = np.repeat(np.where(_bars(number), 215, 40).astype(np.uint8), _BAR_PX)
    for top in range(0, HEIGHT, _BAND_PX):
        grey[top + _BAND_PX // 2 : top + _BAND_PX] = row
    return cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR)


def numbers_in(image: np.ndarray) -> list[int | None]:
    """Return the number in every band of rows; None for a band whose bars are damaged."""
    grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    bands = grey.reshape(HEIGHT // _BAND_PX, _BAND_PX, WIDTH // _BAR_PX, _BAR_PX)[:, 10:14, :, 4:12]
    return [_NUMBERS.get(tuple(int(bar) for bar in bars)) for bars in bands.mean((1, 3)) > 128]


class MjpegCamera:
    """MJPEG over HTTP, to one viewer; `damage` changes the JPEG file of a picture. `sent_s` is when each was sent."""

    def __init__(self, count: int, rate_hz: float, damage: Callable[[bytes], bytes]) -> None:
        self.sent_s: dict[int, float] = {}
        self.done = threading.Event()
        self._count, self._rate_hz, self._damage = count, rate_hz, damage
        self._server = socket.create_server(("127.0.0.1", 0))
        self.uri = f"http://127.0.0.1:{self._server.getsockname()[1]}/"
        threading.Thread(target=self._serve, daemon=True).start()

    def _serve(self) -> None:
        with self._server, self._server.accept()[0] as viewer:
            viewer.recv(4096)
            viewer.sendall(b"HTTP/1.0 200 OK\r\nContent-Type: multipart/x-mixed-replace;boundary=part\r\n\r\n")
            for number in range(self._count):
                jpeg = cv2.imencode(".jpg", picture(number))[1].tobytes()
                if number >= _WHOLE_AT_FIRST:
                    jpeg = self._damage(jpeg)
                head = f"--part\r\nContent-Type: image/jpeg\r\nContent-Length: {len(jpeg)}\r\n\r\n".encode()
                self.sent_s[number] = time.monotonic()
                try:
                    viewer.sendall(head + jpeg + b"\r\n")
                except OSError:
                    break
                time.sleep(1 / self._rate_hz)
            self.done.set()

    def close(self) -> None:
        """Wait until all is sent."""
        self.done.wait(60)


class LossyCamera:
    """An encoder whose datagrams are handed on to the viewer, but for a share that is lost: MPEG-TS over UDP, or RTP
    described by an .sdp file."""

    def __init__(self, count: int, rate_hz: float, encoder: tuple[str, ...], lost: float, seed: int, *, rtp: bool):
        self.sent_s: dict[int, float] = {}
        self.done = threading.Event()
        self._count, self._rate_hz, self._lost, self._random = count, rate_hz, lost, random.Random(seed)
        self._in = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._in.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 21)
        self._in.bind(("127.0.0.1", 0))
        self._in.settimeout(0.2)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.bind(("127.0.0.1", 0))
            self._viewer = probe.getsockname()
        inner, outer = self._in.getsockname()[1], self._viewer[1]
        self._folder = tempfile.TemporaryDirectory()
        sdp = Path(self._folder.name) / "camera.sdp"
        target = ["-f", "mpegts", f"udp://127.0.0.1:{inner}?pkt_size=1316"]
        if rtp:
            target = ["-f", "rtp", "-sdp_file", str(sdp), f"rtp://127.0.0.1:{inner}?pkt_size=1200"]
        source = ["-f", "rawvideo", "-pix_fmt", "bgr24", "-s", f"{WIDTH}x{HEIGHT}", "-r", f"{rate_hz:g}", "-i", "-"]
        self._encoder = subprocess.Popen(
            [imageio_ffmpeg.get_ffmpeg_exe(), "-v", "quiet", *source, *encoder, *target],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
        )
        self._threads = [threading.Thread(target=work, daemon=True) for work in (self._film, self._hand_on)]
        for thread in self._threads:
            thread.start()
        self.uri = str(sdp) if rtp else f"udp://127.0.0.1:{outer}"
        if rtp:
            while not (sdp.exists() and f"m=video {inner} " in sdp.read_text() and sdp.read_text().endswith("\n")):
                time.sleep(0.02)
            sdp.write_text(sdp.read_text().replace(f"m=video {inner} ", f"m=video {outer} "))

    def _film(self) -> None:
        with self._encoder.stdin as pipe:
            for number in range(self._count):
                self.sent_s[number] = time.monotonic()
                pipe.write(picture(number).tobytes())
                pipe.flush()
                time.sleep(1 / self._rate_hz)
        self._encoder.wait()
        self.done.set()

    def _hand_on(self) -> None:
        handed_on = 0
        with self._in, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
            while not self.done.is_set():
                try:
                    datagram = self._in.recv(65536)
                except TimeoutError:
                    continue
                handed_on += 1
                if handed_on <= _PACKETS_AT_FIRST or self._random.random() >= self._lost:
                    out.sendto(datagram, self._viewer)

    def close(self) -> None:
        """Wait until all is sent."""
        for thread in self._threads:
            thread.join(60)
        self._folder.cleanup()
