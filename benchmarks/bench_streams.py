"""Old pixels under a new time: streams that are cut, corrupted or lose packets, read as in a flight.

Every picture carries its number in every band of its rows, so that what is delivered tells how old each part of it is.
"""

import random
import time
from collections.abc import Callable
from dataclasses import dataclass

from hostile_streams import LossyCamera, MjpegCamera, numbers_in

from edgevpr.frames.source import open_source

RATE_HZ = 40.0
OLD_S = 1.0
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
    ("H.264", "MPEG-TS", 0.0),
    ("H.264", "MPEG-TS", 0.1),
    ("H.264", "MPEG-TS", 0.3),
    ("H.264", "MPEG-TS", 0.5),
    ("H.264, refreshed bit by bit", "MPEG-TS", 0.0),
    ("H.264, refreshed bit by bit", "MPEG-TS", 0.02),
    ("H.265", "MPEG-TS", 0.1),
    ("MPEG-2", "MPEG-TS", 0.1),
    ("H.264", "RTP", 0.0),
    ("H.264", "RTP", 0.02),
    ("H.264", "RTP", 0.1),
    ("H.265", "RTP", 0.1),
    ("MPEG-2", "RTP", 0.1),
    ("MJPEG", "RTP", 0.02),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """Counts of the pictures of one stream. `sent` counts from the first that was delivered; `delivered` to the flight
    or superseded by a newer one; `refused` by reason; of those `looked_at`, `old` have a part more than a second older
    than the frame claims, and `broken` a part that cannot be read."""

    stream: str
    is_whole: bool
    sent: int
    delivered: int
    refused: dict[str, int]
    looked_at: int
    old: int
    broken: int
    latency_s: float


def run(count: int, seed: int, only: Callable[[str], bool] = lambda stream: True) -> list[Row]:
    """Send `count` pictures over every stream whose name is wanted, and judge what is delivered."""
    rows = []
    for kind in filter(lambda kind: only(f"MJPEG over HTTP, {kind}"), _MJPEG):
        camera = MjpegCamera(count, RATE_HZ, _damage(kind, random.Random(seed)))
        rows.append(_judged(f"MJPEG over HTTP, {kind}", kind == "whole", camera))
    for codec, transport, lost in _LOSSY:
        name = f"{codec} in {transport}, {lost:.0%} lost"
        if only(name):
            camera = LossyCamera(count, RATE_HZ, _ENCODERS[codec], lost, seed, rtp=transport == "RTP")
            rows.append(_judged(name, not lost, camera))
    return rows


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


def _judged(stream: str, is_whole: bool, camera: MjpegCamera | LossyCamera) -> Row:
    source = open_source(camera.uri, live=True)
    looked_at = old = broken = 0
    first: int | None = None
    latencies_s = [0.0]
    while not camera.done.is_set():
        frame = source.read(0.05)
        if frame is None:
            continue
        numbers = numbers_in(frame.image)
        known = [number for number in numbers if number in camera.sent_s]
        looked_at += 1
        old += any(frame.t_mono_s - camera.sent_s[number] > OLD_S for number in known)
        broken += None in numbers
        latencies_s.append(source.latency_s)
        if first is None and known:
            first = max(known)
    time.sleep(0.1)
    delivered = looked_at + source.dropped
    refused = dict(source.refused)
    source.close()
    camera.close()
    return Row(
        stream=stream,
        is_whole=is_whole,
        sent=len(camera.sent_s) - (first or 0),
        delivered=delivered,
        refused=refused,
        looked_at=looked_at,
        old=old,
        broken=broken,
        latency_s=max(latencies_s),
    )
