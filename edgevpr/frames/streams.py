"""Network streams, decoded by FFmpeg: complete images, each with the time at which it was taken (`frames.age`). One
thread receives packets as they arrive (`PacketQueue`); the thread of `frames.live` decodes them (`StreamCapture`)."""

import threading
from collections import deque
from collections.abc import Callable

from av.video.frame import VideoFrame

from edgevpr.core.types import FRAME_TIME_SD_S
from edgevpr.frames.age import HIDDEN_DELAY_SD_S, CaptureTime, StampedTime, UnstampedTime
from edgevpr.frames.decoding import TimedPacket, TransportError, VideoDecoder, open_decoder
from edgevpr.frames.rtp import describe_rtp
from edgevpr.frames.shot import Capture, OpeningError, Refusal, Shot, StreamFacts
from edgevpr.frames.webpictures import ResponseFile, SnapshotCapture, try_request

OPEN_TIMEOUT_S = 5.0
# `frames.live` closes a stream without images earlier; this limit allows for the second image of a slow camera. A
# UDP port cannot be reopened while FFmpeg is still waiting on it, so that wait is short.
READ_TIMEOUT_S = 15.0
UDP_READ_TIMEOUT_S = 3.0
# RTSP over TCP loses no packets, but the camera may lose some before sending. FFmpeg reports that only if it may hold
# back at least two packets while it waits for a missing one. Probing the frame rate, which is not needed, would
# exceed the opening timeout at 1 image/s. FFmpeg opens addresses in an .sdp file only for whitelisted protocols.
_OPTIONS = {"rtsp_transport": "tcp", "reorder_queue_size": "2", "fpsprobesize": "0"}
# Some cameras send RTSP over UDP only. FFmpeg then waits 0.1 s for a missing packet, and reports it.
_UDP_OPTIONS = {"rtsp_transport": "udp", "fpsprobesize": "0"}
_SDP_OPTIONS = {"protocol_whitelist": "data,file,rtp,udp"}
_RAW_OPTIONS = {"analyzeduration": "1", "fpsprobesize": "0"}  # otherwise FFmpeg probes for the frame rate for up to 5 s
_SKIPPABLE_AGE_S = 0.3  # a packet queued for longer is skipped if a later key frame has arrived
_MAX_PACKET_AGE_S = 5.0  # a packet queued for longer is always skipped
_MAX_QUEUED_BYTES = 16_000_000  # five seconds of 25 Mbit/s
_MAX_QUEUED_PACKETS = 2000
_CLOSE_TIMEOUT_S = 0.5


def open_address(
    uri: str, clock: Callable[[], float], period_s: float, upright: bool = True
) -> "StreamCapture | SnapshotCapture":
    """Open a network stream, an .sdp file, or the address of a single image, which is requested every `period_s`
    seconds and rotated by its EXIF data if `upright`. `clock`: monotonic. Raises OpeningError with the cause."""
    opened_s = clock()
    response = try_request(uri, OPEN_TIMEOUT_S) if uri.lower().startswith("http") else None
    content_type = response.headers.get_content_type() if response else ""
    timeouts_s = OPEN_TIMEOUT_S, READ_TIMEOUT_S
    if response and content_type.startswith("multipart/"):
        parts = ResponseFile(response, is_multipart=True)
        return StreamCapture(open_decoder(uri, _RAW_OPTIONS, timeouts_s, "mpjpeg", parts), clock, opened_s)
    if response and content_type == "application/octet-stream":  # if FFmpeg is the server, it answers one request only
        file = ResponseFile(response, is_multipart=False)
        return StreamCapture(open_decoder(uri, _OPTIONS, timeouts_s, file=file), clock, opened_s)
    if response:
        response.close()
    if content_type.startswith("image/"):
        return SnapshotCapture(uri, period_s, OPEN_TIMEOUT_S, clock, upright=upright)
    if content_type == "text/html":
        raise OpeningError(f"no video at this address, only {content_type}")
    return StreamCapture(_open_stream(uri), clock, opened_s)


def open_raw(
    uri: str, clock: Callable[[], float], format_name: str, timeout_s: float, delay_sd_s: float = FRAME_TIME_SD_S
) -> "StreamCapture":
    """Open a stream in a format without timestamps (`format_name`: its name in FFmpeg), and wait up to `timeout_s`
    seconds for its first image. `delay_sd_s`: see `Shot`. Raises OpeningError with the cause."""
    opened_s = clock()
    decoder = open_decoder(uri, _RAW_OPTIONS, (timeout_s, READ_TIMEOUT_S), format_name)
    return StreamCapture(decoder, clock, opened_s, delay_sd_s)


def _open_stream(uri: str) -> VideoDecoder:
    udp_timeouts_s = OPEN_TIMEOUT_S, UDP_READ_TIMEOUT_S
    if "://" not in uri:
        return open_decoder(uri, _SDP_OPTIONS, udp_timeouts_s)
    if uri.lower().startswith(("udp:", "rtp:")):
        if sdp := describe_rtp(uri, OPEN_TIMEOUT_S):
            return open_decoder(sdp, _SDP_OPTIONS, udp_timeouts_s, "sdp")
        return open_decoder(uri, _OPTIONS, udp_timeouts_s)
    try:
        return open_decoder(uri, _OPTIONS, (OPEN_TIMEOUT_S, READ_TIMEOUT_S))
    except TransportError:
        return open_decoder(uri, _UDP_OPTIONS, udp_timeouts_s)


class StreamCapture(Capture):
    """The images of an open stream. `decoder` decodes it. `clock` is the monotonic clock in seconds, and
    `opened_s` its time just before the opening. `delay_sd_s`: see `Shot`."""

    def __init__(
        self, decoder: VideoDecoder, clock: Callable[[], float], opened_s: float, delay_sd_s: float = HIDDEN_DELAY_SD_S
    ) -> None:
        self._decoder, self._clock, self._delay_sd_s = decoder, clock, delay_sd_s
        self._stamped = StampedTime() if decoder.is_stamped else None
        self._unstamped = UnstampedTime(opened_s)
        self._ready: deque[Shot | Refusal] = deque()
        self._arrivals = PacketQueue(decoder.fetch, clock, decoder.close)

    @property
    def facts(self) -> StreamFacts:
        return self._decoder.facts

    def read(self) -> Shot | Refusal | None:
        while not self._ready:
            arrival = self._arrivals.next()
            if arrival is None:
                return None
            if arrival.is_after_gap:
                self._decoder.skip()
            if self._stamped:
                self._record_stamps(self._stamped, arrival)
            taken = self._unstamped.estimate(arrival.request_s, arrival.arrival_s)
            waited_s = self._clock() - arrival.arrival_s
            if waited_s > _MAX_PACKET_AGE_S or (waited_s > _SKIPPABLE_AGE_S and self._arrivals.has_key_frame()):
                return self._decoder.skip()
            pictures = self._decoder.decode(arrival)
            if isinstance(pictures, Refusal):
                return pictures
            self._ready.extend(self._make_shot(picture, taken, arrival.arrival_s) for picture in pictures)
        return self._ready.popleft()

    def cancel(self) -> None:
        self._decoder.is_cancelled = True
        self._arrivals.cancel()

    def release(self) -> None:
        self.cancel()
        self._arrivals.close()

    def _record_stamps(self, stamped: StampedTime, arrival: TimedPacket) -> None:
        packet, unit_s = arrival.packet, self._decoder.unit_s
        if packet.pts is None:
            return
        dts = packet.pts if packet.dts is None else packet.dts
        stamped.record_arrival(packet.pts * unit_s, dts * unit_s, arrival.arrival_s, packet.size)
        if stamped.is_live:
            self._decoder.is_backlog_suspect = False  # the packets from now on were sent after the opening

    def _make_shot(self, picture: VideoFrame, unstamped: CaptureTime, arrival_s: float) -> Shot | Refusal:
        taken: CaptureTime | None = unstamped
        if stamped := self._stamped:
            taken = None if picture.pts is None else stamped.estimate(picture.pts * self._decoder.unit_s, arrival_s)
        if taken is None:
            return Refusal.LATE
        thumbnail, convert = self._decoder.make_thumbnail(picture), self._decoder.prepare_conversion(picture)
        times = {"t_mono_s": taken.t_s, "t_sd_s": taken.sd_s, "delay_sd_s": self._delay_sd_s}
        return Shot(thumbnail=thumbnail, convert=convert, **times)


class PacketQueue:
    """A queue that a thread fills with packets as soon as they arrive. If the board decodes too slowly, packets wait
    here with known arrival times, and not in network buffers, where those would be unknown. If too many wait, all of
    them are dropped, and so are new packets up to the next key frame.

    The thread itself closes the stream, with `close_stream`, because only it knows when its last fetch has returned:
    FFmpeg cannot be interrupted, and closing a stream in use would crash the process."""

    def __init__(
        self, fetch: Callable[[], TimedPacket | None], clock: Callable[[], float], close_stream: Callable[[], None]
    ) -> None:
        self._fetch, self._clock, self._close_stream = fetch, clock, close_stream
        self._queued: deque[TimedPacket] = deque()
        self._queued_bytes = 0
        self._has_gap = self._is_lost = False
        self._changed = threading.Condition()
        self._is_unused = threading.Event()
        self._thread = threading.Thread(target=self._run, name="fetch", daemon=True)
        self._thread.start()

    def next(self) -> TimedPacket | None:
        """Wait for the next packet and return it; None if the stream is lost or cancelled."""
        with self._changed:
            self._changed.wait_for(lambda: self._queued or self._is_lost)
            if not self._queued:
                return None
            arrival = self._queued.popleft()
            self._queued_bytes -= arrival.packet.size
            return arrival

    def has_key_frame(self) -> bool:
        """Return True if the queue has a key frame, which can be decoded without the packets before it."""
        with self._changed:
            return any(arrival.packet.is_keyframe for arrival in self._queued)

    def cancel(self) -> None:
        """Drop all packets and make `next` return None from now on."""
        with self._changed:
            self._is_lost = True
            self._clear()
            self._changed.notify_all()

    def close(self) -> None:
        """Let the thread close the stream as soon as its fetch has returned, and wait for that up to half a second. The
        stream must not be used after this call."""
        self.cancel()
        self._is_unused.set()
        self._thread.join(_CLOSE_TIMEOUT_S)

    def _run(self) -> None:
        try:
            while not self._is_lost:
                request_s = self._clock()
                fetched = self._fetch()
                if fetched is None:
                    break
                self._put(fetched._replace(request_s=request_s, arrival_s=self._clock()))
        finally:
            with self._changed:
                self._is_lost = True
                self._changed.notify_all()
            self._is_unused.wait()
            self._close_stream()

    def _put(self, arrival: TimedPacket) -> None:
        with self._changed:
            if self._queued_bytes > _MAX_QUEUED_BYTES or len(self._queued) > _MAX_QUEUED_PACKETS:
                self._clear()
                self._has_gap = True
            if self._is_lost or (self._has_gap and not arrival.packet.is_keyframe):
                return
            self._queued.append(arrival._replace(is_after_gap=self._has_gap))
            self._queued_bytes += arrival.packet.size
            self._has_gap = False
            self._changed.notify_all()

    def _clear(self) -> None:
        self._queued.clear()
        self._queued_bytes = 0
