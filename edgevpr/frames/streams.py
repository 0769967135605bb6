"""Network streams, decoded by FFmpeg: complete pictures, each with the time at which it was taken (`frames.age`). A
thread receives packets as they come (`Arrivals`), the thread of `frames.live` decodes them (`StreamCapture`)."""

import threading
from collections import deque
from collections.abc import Callable
from queue import Queue
from typing import TYPE_CHECKING, TypeAlias

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
READ_TIMEOUT_S = 3.0
# RTSP over TCP loses no packets, but the camera may lose some before sending. FFmpeg reports that only if it may hold
# packets back to wait for the missing one: at least two. It opens the addresses in an .sdp file only if these protocols
# are allowed.
_OPTIONS = {"rtsp_transport": "tcp", "reorder_queue_size": "2"}
# Some cameras send RTSP by UDP only. FFmpeg then waits 0.1 s for a packet that is missing, and reports it.
_UDP_OPTIONS = {"rtsp_transport": "udp"}
_SDP_OPTIONS = {"protocol_whitelist": "data,file,rtp,udp"}
_RAW_OPTIONS = {"analyzeduration": "1", "fpsprobesize": "0"}  # else FFmpeg watches for its rate for up to 5 s
_BEHIND_S = 0.3  # a packet that has waited longer for decoding is skipped if a later key frame has arrived
_TOO_OLD_S = 5.0  # a packet that has waited longer for decoding is skipped in any case


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

    def release(self) -> None:
        self._arrivals.close()
        self._whole.close()

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
