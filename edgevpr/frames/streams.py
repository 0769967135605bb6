"""Network streams, decoded by FFmpeg: complete pictures, each with the time at which it was taken, estimated by the
stamps of the stream (`StampedTime`) or without (`UnstampedTime`). A thread receives packets as they come (`Arrivals`),
the thread of `frames.live` decodes them (`StreamCapture`)."""

import math
import threading
from collections import deque
from collections.abc import Callable
from queue import Queue
from statistics import median
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from edgevpr.core.arrays import Image
from edgevpr.frames.causes import TransportError
from edgevpr.frames.decoding import Fetched, WholePictures, open_pictures
from edgevpr.frames.rtp import describe_rtp
from edgevpr.frames.shot import OpeningError, Refusal, Shot, StreamFacts, coarse
from edgevpr.frames.webpictures import PartsFile, Snapshots, open_request

if TYPE_CHECKING:
    from _typeshed import SupportsRead
    from av.video.frame import VideoFrame

OPEN_TIMEOUT_S = 5.0
READ_TIMEOUT_S = 3.0
# RTSP over TCP loses no packets, but the camera may lose some before sending. FFmpeg reports that only if it may hold
# packets back to wait for the missing one: at least two. It opens the addresses in an .sdp file only if these protocols
# are allowed.
_OPTIONS = {"rtsp_transport": "tcp", "reorder_queue_size": "2"}
# Some cameras send RTSP by UDP only. FFmpeg then waits 0.1 s for a packet that is missing, and reports it.
_UDP_OPTIONS = {"rtsp_transport": "udp"}
_SDP_OPTIONS = {"protocol_whitelist": "data,file,rtp,udp"}
_RAW_OPTIONS = {"analyzeduration": "1", "fpsprobesize": "0"}  # else FFmpeg watches for its rate for up to 5 s
_BYTES_OF_LUMA = ("yuv", "nv12", "nv21", "gray")  # prefixes of pixel formats whose first plane is the brightness
_BEHIND_S = 0.3  # a packet that has waited longer for decoding is skipped if a later key frame has arrived
_TOO_OLD_S = 5.0  # a packet that has waited longer for decoding is skipped in any case
_RESTART_S = 5.0  # a larger change of the delay: the sender has restarted, or something has held the stream up
_BACKLOG_S = 0.005  # a picture with a delay shorter than the least so far by more than this was in a backlog
_IN_TIME = 3  # pictures in a row not in a backlog after which there is none any more
_WAITED_S = 0.002  # a picture that was returned sooner than this was in a buffer already
_USUAL_OF, _AS_USUAL = 9, 1.5  # number of waits whose median is the usual one, and the multiple of it that is normal
_WINDOW_S, _STEADY_S = 5.0, 0.2  # delays that vary by less for so long are due to the path, and not to congestion


def open_address(uri: str, clock: Callable[[], float], period_s: float) -> "StreamCapture | Snapshots":
    """Open a network stream or an .sdp file as `open_stream` does, or an address of a single picture, which is then
    requested every `period_s` seconds."""
    if not uri.lower().startswith("http"):
        return open_stream(uri, clock)
    opened_s = clock()
    request = open_request(uri, OPEN_TIMEOUT_S)
    if request is None:
        return open_stream(uri, clock)  # or the cause
    kind = request.headers.get_content_type()
    if kind.startswith("multipart/"):
        return StreamCapture(_open(uri, "mpjpeg", PartsFile(request)), clock, opened_s)
    if kind == "application/octet-stream":  # FFmpeg as a server says so; a second request would find it gone
        return StreamCapture(_open(uri, None, request), clock, opened_s)
    request.close()
    if kind.startswith("image/"):
        return Snapshots(uri, period_s, OPEN_TIMEOUT_S, clock)
    if kind == "text/html":
        raise OpeningError(f"no video at this address, but {kind}")
    return open_stream(uri, clock)


def open_stream(uri: str, clock: Callable[[], float], form: str | None = None) -> "StreamCapture":
    """Open a network stream or an .sdp file, with time-outs. `clock` is the monotonic clock, in seconds; `form`
    FFmpeg's name of a format without time stamps (None: it finds out). Raises OpeningError with the cause."""
    opened_s = clock()
    return StreamCapture(_open(uri, form), clock, opened_s)


def _open(uri: str, form: str | None = None, file: "SupportsRead[bytes] | None" = None) -> WholePictures:
    options = _RAW_OPTIONS if form else _OPTIONS if "://" in uri else _SDP_OPTIONS
    if uri.lower().startswith(("udp:", "rtp:")) and (described := describe_rtp(uri, OPEN_TIMEOUT_S)):
        uri, form, options = described[0], "sdp", _SDP_OPTIONS | described[1]
    timeouts_s = OPEN_TIMEOUT_S, READ_TIMEOUT_S
    try:
        return open_pictures(uri, options, timeouts_s, form, file)
    except TransportError:
        return open_pictures(uri, _UDP_OPTIONS, timeouts_s)


class StreamCapture:
    """The pictures of an open stream: a `Capture`. `whole` decodes it. `clock` is the monotonic clock in seconds, and
    `opened_s` its time just before the opening."""

    def __init__(self, whole: WholePictures, clock: Callable[[], float], opened_s: float) -> None:
        self._whole, self._clock = whole, clock
        self._unit_s = float(whole.time_base)
        self._stamped = StampedTime() if whole.is_stamped else None
        self._unstamped = UnstampedTime(opened_s)
        self._ready: deque[Shot | Refusal] = deque()
        self._arrivals = Arrivals(whole.fetch, clock)

    @property
    def facts(self) -> StreamFacts:
        return self._whole.facts

    def read(self) -> Shot | Refusal | None:
        while not self._ready:
            arrival = self._arrivals.next()
            if arrival is None:
                return None
            fetched, asked_s, t_mono_s = arrival
            came_s = self._unstamped.taken_s(asked_s, t_mono_s)
            self._note_stamp(fetched, t_mono_s)
            waited_s = self._clock() - t_mono_s
            if waited_s > _TOO_OLD_S or (waited_s > _BEHIND_S and self._arrivals.can_begin_anew()):
                return self._whole.skip()
            pictures = self._whole.decode(fetched)
            if isinstance(pictures, Refusal):
                return pictures
            self._ready.extend(self._shot(picture, came_s, t_mono_s) for picture in pictures)
        return self._ready.popleft()

    def release(self) -> None:
        self._arrivals.close()
        self._whole.close()

    def _note_stamp(self, fetched: Fetched, t_mono_s: float) -> None:
        packet = fetched.packet
        if self._stamped is None or packet.pts is None:
            return
        order = packet.pts if packet.dts is None else packet.dts
        self._stamped.arrived(packet.pts * self._unit_s, order * self._unit_s, t_mono_s)
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


# A packet, and when the call that fetched it began and returned (seconds, monotonic).
Arrival: TypeAlias = tuple[Fetched, float, float]


class Arrivals:
    """A queue filled by a thread that fetches packets as soon as they come. If the board decodes too slowly, packets
    wait in this queue, with known arrival times, and not in network buffers, where the time would be unknown."""

    def __init__(self, fetch: Callable[[], Fetched | None], clock: Callable[[], float]) -> None:
        self._fetch, self._clock, self._is_closing = fetch, clock, False
        self._waiting: Queue[Arrival | None] = Queue()  # None: the stream is lost
        self._thread = threading.Thread(target=self._take, name="fetch", daemon=True)
        self._thread.start()

    def next(self) -> Arrival | None:
        """Wait for the next packet and return it; None if the stream is lost."""
        arrival = self._waiting.get()
        if arrival is None:
            self._waiting.put(None)
        return arrival

    def can_begin_anew(self) -> bool:
        """Return True if a key frame is in the queue, which can be decoded without the packets before it."""
        with self._waiting.mutex:
            return any(arrival and arrival[0].packet.is_keyframe for arrival in self._waiting.queue)

    def close(self) -> None:
        """Stop the thread, and wait until its current fetch has returned."""
        self._is_closing = True
        self._thread.join()

    def _take(self) -> None:
        try:
            while not self._is_closing:
                asked_s = self._clock()
                fetched = self._fetch()
                if fetched is None:
                    break
                self._waiting.put((fetched, asked_s, self._clock()))
        finally:
            self._waiting.put(None)


class StampedTime:
    """Estimates when pictures were taken, from the stream's time stamps.

    The stamps count from an unknown zero. The delay of a picture is its arrival time minus its stamp. The least delay
    so far is assumed to be that of a picture that arrives at once; a picture with a longer delay is older by the
    difference. A larger value replaces the least delay only if delays have been steady for five seconds, as after a
    clock drift or a pause of the sender; in a congested network they vary. `is_live`: True once the pictures that were
    buffered before the opening have been fetched."""

    def __init__(self) -> None:
        self._begin_anew()

    def _begin_anew(self) -> None:
        self.is_live, self._in_time = False, 0
        self._order_s, self._order_delay_s = -math.inf, math.nan
        self._least_order_delay_s = self._least_s = math.inf
        self._window: list[tuple[float, float, float]] = []

    def arrived(self, stamp_s: float, order_s: float, t_mono_s: float) -> None:
        """Record the arrival at `t_mono_s` of a picture with the stamp `stamp_s`. `order_s` is its decoding time stamp,
        which differs only in streams that send pictures in another order than they were taken. All in seconds."""
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
        """Return the time at which the picture with the stamp `stamp_s` was taken, at most its arrival `t_mono_s`. None
        while pictures that were buffered before the opening are still being fetched: their age is unknown."""
        return min(t_mono_s, stamp_s + self._least_s) if self.is_live else None

    def _look_back(self, t_mono_s: float, delay_s: float, order_delay_s: float) -> None:
        if self._window and t_mono_s - self._window[0][0] > _WINDOW_S:
            _, delays_s, order_delays_s = zip(*self._window, strict=True)
            if max(order_delays_s) - min(order_delays_s) < _STEADY_S:
                self._least_s = min(delays_s)
            self._window.clear()
        self._window.append((t_mono_s, delay_s, order_delay_s))


class UnstampedTime:
    """Estimates when pictures were taken, for streams without time stamps (MJPEG over HTTP). Only the time spent
    waiting for each picture is known.

    After a wait of usual length, the picture has just arrived. After a longer wait it may have been delayed on its way,
    by as much as the wait. A picture returned without any wait was in a buffer, at most since the last wait ended."""

    def __init__(self, opened_s: float) -> None:
        self._since_s = opened_s
        self._waits_s: deque[float] = deque(maxlen=_USUAL_OF)

    def taken_s(self, asked_s: float, t_mono_s: float) -> float:
        """Return the earliest time at which the picture can have arrived whose fetch began at `asked_s` and ended at
        `t_mono_s`. All in seconds of the monotonic clock."""
        wait_s = t_mono_s - asked_s
        if wait_s > _WAITED_S:
            usual_s = median(self._waits_s) if len(self._waits_s) == _USUAL_OF else 0.0
            self._since_s = t_mono_s if wait_s <= _AS_USUAL * usual_s else asked_s
            self._waits_s.append(wait_s)
        return self._since_s
