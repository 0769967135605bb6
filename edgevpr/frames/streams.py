"""Network streams, decoded by FFmpeg: complete pictures, each with the time at which it was taken (`frames.age`). A
thread receives packets as they come (`Arrivals`), the thread of `frames.live` decodes them (`StreamCapture`)."""

import threading
from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

from edgevpr.frames.age import StampedTime, Taken, UnstampedTime
from edgevpr.frames.causes import TransportError
from edgevpr.frames.decoding import Fetched, WholePictures, open_pictures
from edgevpr.frames.rtp import describe_rtp
from edgevpr.frames.shot import OpeningError, Refusal, Shot, StreamFacts
from edgevpr.frames.webpictures import PartsFile, Snapshots, open_request

if TYPE_CHECKING:
    from _typeshed import SupportsRead
    from av.video.frame import VideoFrame

OPEN_TIMEOUT_S = 5.0
# `frames.live` closes a stream that gives no picture sooner than this: so long it may wait for the second picture of a
# slow camera. A port of UDP cannot be opened again while FFmpeg still waits at it, so that wait is short.
READ_TIMEOUT_S = 15.0
UDP_READ_TIMEOUT_S = 3.0
# RTSP over TCP loses no packets, but the camera may lose some before sending. FFmpeg reports that only if it may hold
# packets back to wait for the missing one: at least two. Its search for the rate, which nobody needs here, takes longer
# than the opening may where a picture comes each second. It opens the addresses in an .sdp file only if these protocols
# are allowed.
_OPTIONS = {"rtsp_transport": "tcp", "reorder_queue_size": "2", "fpsprobesize": "0"}
# Some cameras send RTSP by UDP only. FFmpeg then waits 0.1 s for a packet that is missing, and reports it.
_UDP_OPTIONS = {"rtsp_transport": "udp", "fpsprobesize": "0"}
_SDP_OPTIONS = {"protocol_whitelist": "data,file,rtp,udp"}
_RAW_OPTIONS = {"analyzeduration": "1", "fpsprobesize": "0"}  # else FFmpeg watches for its rate for up to 5 s
_BEHIND_S = 0.3  # a packet that has waited longer for decoding is skipped if a later key frame has arrived
_TOO_OLD_S = 5.0  # a packet that has waited longer for decoding is skipped in any case
_WAITING_BYTES = 16_000_000  # most bytes of packets that wait for decoding: five seconds of 25 Mbit/s
_WAITING_PACKETS = 2000
_CLOSE_S = 0.5  # longest wait for a stream to be closed


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


def open_stream(
    uri: str, clock: Callable[[], float], form: str | None = None, open_timeout_s: float | None = None
) -> "StreamCapture":
    """Open a network stream or an .sdp file, with time-outs. `clock` is the monotonic clock, in seconds; `form`
    FFmpeg's name of a format without time stamps (None: it finds out); `open_timeout_s` the seconds to wait for the
    first picture (None: the usual ones). Raises OpeningError with the cause."""
    opened_s = clock()
    return StreamCapture(_open(uri, form, open_timeout_s=open_timeout_s), clock, opened_s)


def _open(
    uri: str,
    form: str | None = None,
    file: "SupportsRead[bytes] | None" = None,
    open_timeout_s: float | None = None,
) -> WholePictures:
    options = _RAW_OPTIONS if form else _OPTIONS if "://" in uri else _SDP_OPTIONS
    is_udp = uri.lower().startswith(("udp:", "rtp:")) or "://" not in uri
    if is_udp and "://" in uri and (described := describe_rtp(uri, OPEN_TIMEOUT_S)):
        uri, form, options = described[0], "sdp", _SDP_OPTIONS | described[1]
    open_s = open_timeout_s or OPEN_TIMEOUT_S
    timeouts_s = open_s, UDP_READ_TIMEOUT_S if is_udp else READ_TIMEOUT_S
    try:
        return open_pictures(uri, options, timeouts_s, form, file)
    except TransportError:
        return open_pictures(uri, _UDP_OPTIONS, (open_s, UDP_READ_TIMEOUT_S))


class StreamCapture:
    """The pictures of an open stream: a `Capture`. `whole` decodes it. `clock` is the monotonic clock in seconds, and
    `opened_s` its time just before the opening."""

    def __init__(self, whole: WholePictures, clock: Callable[[], float], opened_s: float) -> None:
        self._whole, self._clock = whole, clock
        self._unit_s = float(whole.time_base)
        self._stamped = StampedTime() if whole.is_stamped else None
        self._unstamped = UnstampedTime(opened_s)
        self._ready: deque[Shot | Refusal] = deque()
        self._arrivals = Arrivals(whole.fetch, clock, whole.close)

    @property
    def facts(self) -> StreamFacts:
        return self._whole.facts

    def read(self) -> Shot | Refusal | None:
        while not self._ready:
            arrival = self._arrivals.next()
            if arrival is None:
                return None
            fetched, asked_s, t_mono_s, is_after_gap = arrival
            if is_after_gap:
                self._whole.skip()
            came = self._unstamped.taken(asked_s, t_mono_s)
            self._note_stamp(fetched, t_mono_s)
            waited_s = self._clock() - t_mono_s
            if waited_s > _TOO_OLD_S or (waited_s > _BEHIND_S and self._arrivals.can_begin_anew()):
                return self._whole.skip()
            pictures = self._whole.decode(fetched)
            if isinstance(pictures, Refusal):
                return pictures
            self._ready.extend(self._shot(picture, came, t_mono_s) for picture in pictures)
        return self._ready.popleft()

    def cancel(self) -> None:
        self._whole.is_cancelled = True
        self._arrivals.cancel()

    def release(self) -> None:
        self.cancel()
        self._arrivals.close()

    def _note_stamp(self, fetched: Fetched, t_mono_s: float) -> None:
        packet = fetched.packet
        if self._stamped is None or packet.pts is None:
            return
        order = packet.pts if packet.dts is None else packet.dts
        self._stamped.arrived(packet.pts * self._unit_s, order * self._unit_s, t_mono_s, packet.size)
        if self._stamped.is_live:
            self._whole.caught_up()

    def _shot(self, picture: "VideoFrame", came: Taken, arrived_s: float) -> Shot | Refusal:
        taken: Taken | None = came
        if self._stamped:
            stamp = picture.pts
            taken = None if stamp is None else self._stamped.taken(stamp * self._unit_s, arrived_s)
        if taken is None:
            return Refusal.LATE
        look, pixels = self._whole.look(picture), self._whole.conversion(picture)
        return Shot(t_mono_s=taken.t_s, t_sd_s=taken.sd_s, look=look, pixels=pixels)


class Arrival(NamedTuple):
    """A packet, and when the call that fetched it began and returned (seconds, monotonic). `is_after_gap`: packets
    before it were dropped."""

    fetched: Fetched
    asked_s: float
    t_mono_s: float
    is_after_gap: bool = False


class Arrivals:
    """A queue filled by a thread that fetches packets as soon as they come. If the board decodes too slowly, packets
    wait in this queue, with known arrival times, and not in network buffers, where the time would be unknown. If more
    wait than are decoded in time, all are dropped, and those to come up to the next key frame.

    The thread closes the stream by `close_stream`, since only it knows when its last fetch has returned: FFmpeg cannot
    be interrupted, and closing a stream in use would crash the process."""

    def __init__(
        self, fetch: Callable[[], Fetched | None], clock: Callable[[], float], close_stream: Callable[[], None]
    ) -> None:
        self._fetch, self._clock, self._close_stream = fetch, clock, close_stream
        self._waiting: deque[Arrival] = deque()
        self._waiting_bytes = 0
        self._has_gap = self._is_lost = False
        self._changed = threading.Condition()
        self._is_unused = threading.Event()
        self._thread = threading.Thread(target=self._run, name="fetch", daemon=True)
        self._thread.start()

    def next(self) -> Arrival | None:
        """Wait for the next packet and return it; None if the stream is lost or cancelled."""
        with self._changed:
            self._changed.wait_for(lambda: self._waiting or self._is_lost)
            if not self._waiting:
                return None
            arrival = self._waiting.popleft()
            self._waiting_bytes -= arrival.fetched.packet.size
            return arrival

    def can_begin_anew(self) -> bool:
        """Return True if a key frame is in the queue, which can be decoded without the packets before it."""
        with self._changed:
            return any(arrival.fetched.packet.is_keyframe for arrival in self._waiting)

    def cancel(self) -> None:
        """Drop all packets, and let `next` return None from now on."""
        with self._changed:
            self._is_lost = True
            self._clear()
            self._changed.notify_all()

    def close(self) -> None:
        """Let the thread close the stream, as soon as its fetch has returned; wait half a second for it. Nothing of
        the stream may be used any more."""
        self.cancel()
        self._is_unused.set()
        self._thread.join(_CLOSE_S)

    def _run(self) -> None:
        try:
            while not self._is_lost:
                asked_s = self._clock()
                fetched = self._fetch()
                if fetched is None:
                    break
                self._put(fetched, asked_s, self._clock())
        finally:
            with self._changed:
                self._is_lost = True
                self._changed.notify_all()
            self._is_unused.wait()
            self._close_stream()

    def _put(self, fetched: Fetched, asked_s: float, t_mono_s: float) -> None:
        with self._changed:
            if self._waiting_bytes > _WAITING_BYTES or len(self._waiting) > _WAITING_PACKETS:
                self._clear()
                self._has_gap = True
            if self._is_lost or (self._has_gap and not fetched.packet.is_keyframe):
                return
            self._waiting.append(Arrival(fetched, asked_s, t_mono_s, self._has_gap))
            self._waiting_bytes += fetched.packet.size
            self._has_gap = False
            self._changed.notify_all()

    def _clear(self) -> None:
        self._waiting.clear()
        self._waiting_bytes = 0
