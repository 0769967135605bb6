"""The streams that a hostile world makes of a film: cut, corrupted, truncated, and with packets lost."""

import random
from collections.abc import Callable
from dataclasses import dataclass

from hostile_cameras import Camera, Film, LossyCamera, MjpegCamera

_X264 = ("-c:v", "libx264", "-preset", "ultrafast", "-tune", "zerolatency", "-pix_fmt", "yuv420p", "-g", "30")
_ENCODERS = {
    "H.264": _X264,
    "H.264, refreshed bit by bit": (*_X264, "-x264-params", "intra-refresh=1"),
    "H.265": ("-c:v", "libx265", "-preset", "ultrafast", "-tune", "zerolatency", "-pix_fmt", "yuv420p", "-g", "30",
              "-x265-params", "log-level=none"),
    "MPEG-2": ("-c:v", "mpeg2video", "-g", "15", "-b:v", "2M"),
    "MJPEG": ("-c:v", "mjpeg", "-pix_fmt", "yuvj420p", "-huffman", "0", "-q:v", "4"),
}  # fmt: skip
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


@dataclass(frozen=True, slots=True)
class Stream:
    """A way to send a film. `camera` makes the camera of a film that does so, with damage drawn from a seed."""

    name: str
    is_whole: bool
    camera: Callable[[Film, int], Camera]


def streams() -> list[Stream]:
    """List all streams."""
    return [_mjpeg(kind) for kind in _MJPEG] + [
        _lossy(codec, transport, lost) for codec, transport, shares in _LOSSY for lost in shares
    ]


def _mjpeg(kind: str) -> Stream:
    name = f"MJPEG over HTTP, {kind}"
    return Stream(name, kind == "whole", lambda film, seed: MjpegCamera(film, _damage(kind, random.Random(seed))))


def _lossy(codec: str, transport: str, lost: float) -> Stream:
    def camera(film: Film, seed: int) -> Camera:
        return LossyCamera(film, _ENCODERS[codec], transport, lost, seed)

    return Stream(f"{codec} in {transport}, {lost:.0%} lost", not lost, camera)


def _damage(kind: str, dice: random.Random) -> Callable[[bytes], bytes]:
    def corrupted(jpeg: bytes) -> bytes:
        damaged = bytearray(jpeg)
        for _ in range(5):
            damaged[dice.randrange(len(damaged))] = dice.randrange(256)
        return bytes(damaged)

    def now_and_then(damage: Callable[[bytes], bytes]) -> Callable[[bytes], bytes]:
        return lambda jpeg: damage(jpeg) if dice.random() < 0.5 else jpeg

    return {
        "whole": lambda jpeg: jpeg,
        "cut to 15 %": lambda jpeg: jpeg[: len(jpeg) * 15 // 100],
        "bytes corrupted": now_and_then(corrupted),
        "truncated": now_and_then(lambda jpeg: jpeg[: dice.randrange(len(jpeg))]),
    }[kind]
