"""Old pixels under a new time: streams that are cut, corrupted or lose packets, read as in a flight.

Every picture carries its number in every band of its rows, so that what is delivered tells how old each part of it is.
"""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace

from hostile_cameras import Camera, Film
from hostile_streams import streams
from numbered_pictures import numbers_in, picture

from edgevpr.frames.condition import Condition
from edgevpr.frames.decoding import Fetched, WholePictures
from edgevpr.frames.source import open_source

RATE_HZ = 40.0
OLD_S = 1.0
_WHOLE_AT_FIRST = 80
_TOO_SLOW = ("MJPEG over HTTP, whole", "H.264 in MPEG-TS, 0% lost", "H.264 in RTSP, 0% lost")
_SLOWER, _LONGER = 2.0, 3  # than the stream: the work for a picture; and than the others: how long it is borne


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
    film = Film(picture=picture, count=count, rate_hz=rate_hz, whole_at_first=_WHOLE_AT_FIRST)
    rows = [
        _judged(stream.name, stream.is_whole, stream.camera(film, seed)) for stream in streams() if only(stream.name)
    ]
    long = replace(film, count=_LONGER * count)
    for stream in streams():
        name = f"{stream.name}, decoded too slowly"
        if stream.name in _TOO_SLOW and only(name):
            with _slow_decoder(_SLOWER / rate_hz):
                rows.append(_judged(name, False, stream.camera(long, seed)))
    return rows


@contextmanager
def _slow_decoder(work_s: float) -> Iterator[None]:
    """Let every packet take so much longer to decode."""
    decode = WholePictures.decode

    def slowly(whole: WholePictures, fetched: Fetched) -> object:
        time.sleep(work_s)
        return decode(whole, fetched)

    WholePictures.decode = slowly
    try:
        yield
    finally:
        WholePictures.decode = decode


def _judged(stream: str, is_whole: bool, camera: Camera) -> Row:
    source = open_source(camera.uri, live=True)
    camera.roll()
    looked_at = old = broken = 0
    first, superseded = None, 0  # the first picture looked at, and how many before it were not
    latencies_s = [0.0]
    # What the source still holds when all is sent is not lost: it is read until the source says that no more comes.
    while (frame := source.read(0.05)) or not (camera.done.is_set() and source.condition is Condition.LOST):
        if frame is None:
            continue
        numbers = numbers_in(frame.image)
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
        is_whole=is_whole,
        sent=len(camera.sent_s) - (first or 0),
        delivered=delivered,
        refused=refused,
        looked_at=looked_at,
        old=old,
        broken=broken,
        latency_s=max(latencies_s),
    )
