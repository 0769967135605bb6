"""Network streams, decoded by FFmpeg: every picture is whole, and is as old as its time stamp says.

A thread takes packets from the network as they come (`Arrivals`), another one decodes them (`StreamCapture`), and the
time at which each picture was taken is worked out on this machine's clock (`StampedTime`, `UnstampedTime`).
"""

import math
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from statistics import median
from typing import TYPE_CHECKING

import numpy as np

from edgevpr.core.arrays import Image
from edgevpr.frames.decoding import Fetched, WholePictures, open_pictures
from edgevpr.frames.shot import Refusal, Shot, coarse

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
_RESTART_S = 5.0  # a longer jump of the delay: the sender has begun anew, or something has held the stream up
_BACKLOG_S = 0.005  # a picture that comes sooner than all before it by more has waited to be fetched
_IN_TIME = 3  # pictures in a row after which none is waiting any more
_WAITED_S = 0.002  # a picture that took longer to get was not there before
_USUAL_OF, _AS_USUAL = 9, 1.5  # waits whose median is the usual one, and the share of it that is no delay
_WINDOW_S, _STEADY_S = 5.0, 0.2  # delays that differ by no more for so long are the way, and not a jam


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
        self._unit_s = float(whole.time_base)
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
            self._note_stamp(arrival)
            waited_s = self._clock() - arrival.t_mono_s
            if waited_s > _TOO_OLD_S or (waited_s > _BEHIND_S and self._arrivals.can_begin_anew()):
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

    def _note_stamp(self, arrival: "Arrival") -> None:
        packet = arrival.fetched.packet
        if self._stamped is None or packet.pts is None:
            return
        order = packet.pts if packet.dts is None else packet.dts
        self._stamped.arrived(packet.pts * self._unit_s, order * self._unit_s, arrival.t_mono_s)
        if self._stamped.is_live:
            self._whole.caught_up()

    def _shot(self, picture: "VideoFrame", came_s: float, arrived_s: float) -> Shot | Refusal:
        taken_s: float | None = came_s
        if self._stamped:
            stamp = picture.pts
            taken_s = None if stamp is None else self._stamped.taken_s(stamp * self._unit_s, arrived_s)
        if taken_s is None:
            return Refusal.LATE
        return Shot(t_mono_s=taken_s, look=self._look(picture), pixels=lambda: self._whole.pixels(picture))

    def _look(self, picture: "VideoFrame") -> Image:
        if not picture.format.name.startswith(_BYTES_OF_LUMA) or picture.format.components[0].bits != 8:
            return coarse(self._whole.pixels(picture, "gray"))
        plane = picture.planes[0]
        rows = np.frombuffer(memoryview(plane), np.uint8).reshape(-1, plane.line_size)
        return coarse(rows[: picture.height, : picture.width])


@dataclass(frozen=True, slots=True)
class Arrival:
    """A packet that was asked for at `asked_s` and came at `t_mono_s`."""

    fetched: Fetched
    asked_s: float
    t_mono_s: float


class Arrivals:
    """Takes the packets from a stream as they come, in a thread of its own: on a board that is too slow to decode them
    they wait here, where it is known how long, and not in the network, where it is not."""

    def __init__(self, fetch: Callable[[], Fetched | None], clock: Callable[[], float]) -> None:
        self._fetch, self._clock = fetch, clock
        self._waiting: deque[Arrival] = deque()
        self._changed = threading.Condition()
        self._is_over = self._is_closing = False
        self._thread = threading.Thread(target=self._take, name="fetch", daemon=True)
        self._thread.start()

    def next(self) -> Arrival | None:
        """Wait for the next packet and return it; None where the stream is lost."""
        with self._changed:
            self._changed.wait_for(lambda: self._waiting or self._is_over)
            return self._waiting.popleft() if self._waiting else None

    def can_begin_anew(self) -> bool:
        """Tell whether a picture waits that can be decoded without those before it."""
        with self._changed:
            return any(arrival.fetched.packet.is_keyframe for arrival in self._waiting)

    def close(self) -> None:
        """Take no more, and wait for the packet that is being fetched."""
        self._is_closing = True
        self._thread.join()

    def _take(self) -> None:
        try:
            while not self._is_closing:
                asked_s = self._clock()
                fetched = self._fetch()
                if fetched is None:
                    break
                arrival = Arrival(fetched, asked_s, self._clock())
                with self._changed:
                    self._waiting.append(arrival)
                    self._changed.notify()
        finally:
            with self._changed:
                self._is_over = True
                self._changed.notify()


class StampedTime:
    """Time by the stream's own time stamps.

    They share no zero with this machine's clock: the least delay seen so far is taken for none, and all that a picture
    took longer is its age. That least delay is forgotten only for another one that has been steady for five seconds, as
    when clocks drift or the sender has paused: delays in a jam waver, and may last. `is_live`: what waited for the
    opening has been fetched."""

    is_live: bool
    _in_time: int
    _order_s: float
    _order_delay_s: float
    _least_s: float
    _least_order_delay_s: float
    _window: list[tuple[float, float, float]]

    def __init__(self) -> None:
        self._begin_anew()

    def arrived(self, stamp_s: float, order_s: float, t_mono_s: float) -> None:
        """Take note that a picture with this stamp has arrived. `order_s` is its stamp in the order of decoding, the
        same but for pictures that are sent out of turn."""
        delay_s, order_delay_s = t_mono_s - stamp_s, t_mono_s - order_s
        if order_s < self._order_s or abs(order_delay_s - self._order_delay_s) > _RESTART_S:
            self._begin_anew()
        self._in_time = self._in_time + 1 if order_delay_s > self._least_order_delay_s - _BACKLOG_S else 0
        self.is_live = self.is_live or self._in_time >= _IN_TIME
        self._order_s, self._order_delay_s = order_s, order_delay_s
        self._least_order_delay_s = min(self._least_order_delay_s, order_delay_s)
        self._look_back(t_mono_s, delay_s, order_delay_s)
        self._least_s = min(self._least_s, delay_s)

    def taken_s(self, stamp_s: float, t_mono_s: float) -> float | None:
        """Return the time at which the picture with this stamp was taken, `t_mono_s` at the latest. None while what has
        waited since the opening is still being fetched: how old that is cannot be known."""
        return min(t_mono_s, stamp_s + self._least_s) if self.is_live else None

    def _look_back(self, t_mono_s: float, delay_s: float, order_delay_s: float) -> None:
        if self._window and t_mono_s - self._window[0][0] > _WINDOW_S:
            _, delays_s, order_delays_s = zip(*self._window, strict=True)
            if max(order_delays_s) - min(order_delays_s) < _STEADY_S:
                self._least_s = min(delays_s)
            self._window.clear()
        self._window.append((t_mono_s, delay_s, order_delay_s))

    def _begin_anew(self) -> None:
        self.is_live, self._in_time = False, 0
        self._order_s, self._order_delay_s = -math.inf, math.nan
        self._least_order_delay_s = self._least_s = math.inf
        self._window = []


class UnstampedTime:
    """Time for streams without time stamps (MJPEG over HTTP). A picture that was waited for, for no longer than usual,
    has just come. One that took longer may have been held up on its way: it has come since it was asked for. One that
    was there already may have come at any moment since the last one that was waited for."""

    def __init__(self, opened_s: float) -> None:
        self._since_s = opened_s
        self._waits_s: deque[float] = deque(maxlen=_USUAL_OF)

    def taken_s(self, asked_s: float, t_mono_s: float) -> float:
        """Return the time of the picture asked for at `asked_s` and got at `t_mono_s`: where that is in doubt, the
        earliest at which it can have come."""
        wait_s = t_mono_s - asked_s
        if wait_s > _WAITED_S:
            usual_s = median(self._waits_s) if len(self._waits_s) == _USUAL_OF else 0.0
            self._since_s = t_mono_s if wait_s <= _AS_USUAL * usual_s else asked_s
            self._waits_s.append(wait_s)
        return self._since_s
