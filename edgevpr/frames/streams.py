"""Network streams, decoded by FFmpeg: every picture is whole, and is as old as its time stamp says."""

from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from edgevpr.frames.age import StampedTime, UnstampedTime
from edgevpr.frames.arrivals import Arrival, Arrivals
from edgevpr.frames.decoding import WholePictures, open_pictures
from edgevpr.frames.newness import coarse
from edgevpr.frames.shot import Refusal, Shot

if TYPE_CHECKING:
    from av.video.frame import VideoFrame

OPEN_TIMEOUT_S = 5.0
READ_TIMEOUT_S = 3.0
# RTSP over its own connection loses nothing, but the camera may lose packets before, in the air or for want of room.
# FFmpeg says so only where it may hold packets back to see whether the missing one follows: two are the least. It
# connects to the addresses in an .sdp file only where it is allowed.
_OPTIONS = {"rtsp_transport": "tcp", "reorder_queue_size": "2"}
_SDP_OPTIONS = {"protocol_whitelist": "file,rtp,udp"}
_BYTES_OF_LUMA = ("yuv", "nv12", "nv21", "gray")  # pixel formats that begin with a plane of brightness
_BEHIND_S = 0.3  # a packet that has waited longer is left out, as soon as pictures can be decoded without it
_TOO_OLD_S = 5.0  # a packet that has waited longer is left out in any case


def open_stream(uri: str, clock: Callable[[], float]) -> "StreamCapture | None":
    """Open a network stream or an .sdp file with time-outs; None where nothing is there."""
    opened_s = clock()
    options = _OPTIONS if "://" in uri else _SDP_OPTIONS
    whole = open_pictures(uri, options, (OPEN_TIMEOUT_S, READ_TIMEOUT_S))
    return StreamCapture(whole, clock, opened_s) if whole else None


class StreamCapture:
    """The pictures of an open stream."""

    def __init__(self, whole: WholePictures, clock: Callable[[], float], opened_s: float) -> None:
        self._whole, self._clock = whole, clock
        self._unit_s = float(self._whole.stream.time_base)
        self._stamped = StampedTime() if whole.is_stamped else None
        self._unstamped = UnstampedTime(opened_s)
        self._ready: deque[Shot | Refusal] = deque()
        self._arrivals = Arrivals(whole.fetch, clock)

    def read(self) -> Shot | Refusal | None:
        """Wait for the next picture and return it, or the reason why it is refused; None where the stream is lost."""
        while not self._ready:
            arrival = self._arrivals.next()
            if arrival is None:
                return None
            came_s = self._unstamped.taken_s(arrival.asked_s, arrival.t_mono_s)
            if self._stamped:
                self._note_stamp(arrival)
            if self._is_left_out(arrival):
                return self._whole.skip()
            pictures = self._whole.decode(arrival.fetched)
            if isinstance(pictures, Refusal):
                return pictures
            self._ready.extend(self._shot(picture, came_s, arrival.t_mono_s) for picture in pictures)
        return self._ready.popleft()

    def release(self) -> None:
        """Close the connection."""
        self._arrivals.close()
        self._whole.close()

    def _note_stamp(self, arrival: Arrival) -> None:
        packet = arrival.fetched.packet
        if packet.pts is None:
            return
        order = packet.pts if packet.dts is None else packet.dts
        self._stamped.arrived(packet.pts * self._unit_s, order * self._unit_s, arrival.t_mono_s)
        if self._stamped.is_live:
            self._whole.caught_up()

    def _is_left_out(self, arrival: Arrival) -> bool:
        waited_s = self._clock() - arrival.t_mono_s
        return waited_s > _TOO_OLD_S or (waited_s > _BEHIND_S and self._arrivals.can_begin_anew())

    def _shot(self, picture: "VideoFrame", came_s: float, arrived_s: float) -> Shot | Refusal:
        if self._stamped:
            stamp_s = None if picture.pts is None else picture.pts * self._unit_s
            taken_s = None if stamp_s is None else self._stamped.taken_s(stamp_s, arrived_s)
        else:
            taken_s = came_s
        if taken_s is None:
            return Refusal.LATE
        return Shot(t_mono_s=taken_s, look=self._look(picture), pixels=lambda: self._whole.pixels(picture))

    def _look(self, picture: "VideoFrame") -> np.ndarray:
        if not picture.format.name.startswith(_BYTES_OF_LUMA) or picture.format.components[0].bits != 8:
            return coarse(self._whole.pixels(picture, "gray"))
        plane = picture.planes[0]
        return coarse(np.frombuffer(plane, np.uint8).reshape(-1, plane.line_size)[: picture.height, : picture.width])
