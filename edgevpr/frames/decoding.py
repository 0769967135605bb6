"""Decodes streams and video files with FFmpeg (PyAV), which unlike OpenCV reports lost packets and incomplete
images. Imported only when a stream or video file is opened, because the library uses much memory."""

import errno
import logging
import re
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple
from urllib.parse import urlsplit

import av
import av.logging
from av.container import InputContainer
from av.packet import Packet
from av.video.frame import VideoFrame

from edgevpr.core.arrays import Image
from edgevpr.frames.images import is_whole_jpeg
from edgevpr.frames.pixels import PixelConverter
from edgevpr.frames.shot import OpeningError, Refusal, StreamFacts

if TYPE_CHECKING:
    from edgevpr.frames.webpictures import ResponseFile

# FFmpeg's messages are searched for reports of lost packets, then discarded: edgevpr reports faults in its own words.
av.logging.set_level(av.logging.WARNING)
av.logging.set_skip_repeated(False)
logging.getLogger("libav").setLevel(logging.CRITICAL + 1)
_LOSS_WORD = "missed"  # "RTP: missed 3 packets" is the only sign of packet loss

_DOUBTFUL_PACKETS = 2  # after a sign of packet loss: this packet and the next
_NO_STAMPS_FLAG = 0x80  # AVFMT_NOTIMESTAMPS: FFmpeg derives the timestamps from a frame rate

_UNKNOWN_HOST_PATTERN = re.compile(r"(?:resolve hostname |getaddrinfo\()([^\s:,]+)")
_STATUS_PATTERN = re.compile(r"(?:failed:|HTTP error|returned) ([45]\d\d)\b")  # of RTSP and of HTTP
_STATUS_CAUSES = {"403": "access forbidden (403)", "404": "no stream at this path (404)"}
_ERRNO_CAUSES = {
    errno.ECONNREFUSED: "connection refused",
    errno.ECONNRESET: "connection closed by the camera",
    errno.EHOSTUNREACH: "no route to the host",
    errno.ENETUNREACH: "no route to the host",
    errno.EINVAL: "invalid address: correct host and port",
    errno.EADDRINUSE: "UDP port in use by another program",
}


class TransportError(OpeningError):
    """The camera refuses the requested RTSP transport."""


class TimedPacket(NamedTuple):
    """A packet of a stream. `is_doubtful`: packets before it may be missing. `request_s`, `arrival_s`: when the call
    that fetched it began and returned (seconds, monotonic). `is_after_gap`: edgevpr dropped packets before it."""

    packet: "Packet[Any]"
    is_doubtful: bool = False
    request_s: float = 0.0
    arrival_s: float = 0.0
    is_after_gap: bool = False


def open_decoder(
    uri: str,
    options: dict[str, str],
    timeouts_s: tuple[float, float] | None = None,
    format_name: str | None = None,
    file: "ResponseFile | None" = None,
) -> "VideoDecoder":
    """Open the stream or file `uri` with FFmpeg's `options`. `timeouts_s`: time limits in seconds for opening it and
    for each read (None: no limits). `format_name`: name of its format (None: FFmpeg detects it). `file`: an open file
    to read instead, which the decoder closes. Raises OpeningError with the cause on failure or without video."""
    with av.logging.Capture() as log_lines:
        try:
            container = av.open(file or uri, "r", format=format_name, options=options, timeout=timeouts_s)
        except (av.FFmpegError, OSError, ValueError) as error:
            text = "\n".join(message for _, _, message in log_lines)
            if file:
                file.close()
            if "SETUP failed: 461" in text or "Nonmatching transport" in text:
                raise TransportError("transport refused (461)") from None
            raise OpeningError(_find_cause(uri, error, text, timeouts_s[0] if timeouts_s else 0.0)) from None
    if container.streams.video and getattr(container.streams.video[0], "codec_context", None):  # None: unknown codec
        return VideoDecoder(container, _has_loss(log_lines), file)
    has_video = bool(container.streams.video)
    container.close()
    if file:
        file.close()
    raise OpeningError("the codec is unknown to FFmpeg" if has_video else "no video in the stream")


def _has_loss(log_lines: list[tuple[int, str, str]]) -> bool:
    return any(_LOSS_WORD in message for _, _, message in log_lines)


def _find_cause(uri: str, error: Exception, text: str, timeout_s: float) -> str:
    """Return why FFmpeg could not open `uri` within `timeout_s` seconds. Some causes appear only in the `text` that
    FFmpeg logged. The result never contains the address, which may contain a password."""
    if host := _UNKNOWN_HOST_PATTERN.search(text):
        if uri.count("@") > 1:  # the host may be part of the password
            return "no such host: percent-encode special characters in the password, such as @ as %40"
        return f"no such host {host[1]}"
    if isinstance(error, (av.HTTPClientError, av.HTTPServerError)):
        code = _STATUS_PATTERN.search(f"{text}\n{error}")
        status = code[1] if code else "HTTP"
        if status == "401":
            if "@" not in urlsplit(uri).netloc:
                return "password needed (401): add USER:PASSWORD@ before the host"
            return "password refused (401): correct it, and percent-encode special characters, such as % as %25"
        return _STATUS_CAUSES.get(status, f"refused by the camera ({status})")
    error_number = errno.EADDRINUSE if "Address already in use" in text else getattr(error, "errno", 0)
    if error_number in _ERRNO_CAUSES:
        return _ERRNO_CAUSES[error_number]
    if isinstance(error, av.ExitError) or "Immediate exit" in text or error_number == errno.ETIMEDOUT:
        missing = "video in the packets" if uri.lower().startswith(("udp:", "rtp:")) else "answer"
        return f"no {missing} within {timeout_s:g} s"
    if isinstance(error, av.InvalidDataError):
        return "connection closed by the camera" if "End of file" in text else "no video that FFmpeg can read"
    return getattr(error, "strerror", None) or type(error).__name__


class VideoDecoder:
    """Decodes the complete images of one stream or file: `fetch` a packet, then `decode` it. A damaged image is
    rejected, and so are all later ones until the next key frame, which depends on no other image.

    `is_cancelled`: set this to True to end a `fetch` in another thread at the next packet, even an audio packet.
    `is_backlog_suspect`: FFmpeg reported lost packets while it read ahead during the opening, but not which ones. All
    packets are rejected until this is set to False."""

    def __init__(self, container: InputContainer, is_backlog_suspect: bool, file: "ResponseFile | None" = None) -> None:
        self.container, self.stream, self._file = container, container.streams.video[0], file
        self.unit_s = float(self.stream.time_base or 1e-6)  # of the timestamps
        self.is_stamped = not container.format.flags & _NO_STAMPS_FLAG
        self.is_backlog_suspect = is_backlog_suspect
        self.is_cancelled = False
        self._codec = self.stream.codec_context
        self._codec.thread_count = 1  # parallel decoding delays images and uses memory
        self._codec.options = {"err_detect": "explode"}  # report damaged data as an error instead of concealing it
        self._packets = container.demux()
        self._converter = PixelConverter()
        self._doubtful_count = 0  # if above zero, this many of the next packets are doubtful
        self._refusal: Refusal | None = Refusal.LATE  # reason to reject all images until the next key frame
        self._has_begun = False

    @property
    def facts(self) -> StreamFacts:
        """The stream's own description of its images; available once one has been decoded."""
        aspect, rate = self._codec.sample_aspect_ratio, self.stream.average_rate
        bits = self._codec.format.components[0].bits if self._codec.format else 8
        rate_hz = float(rate) if rate and self.is_stamped else None
        return StreamFacts(codec=self._codec.name, bits=bits, pixel_aspect=float(aspect or 1), rate_hz=rate_hz)

    def fetch(self) -> TimedPacket | None:
        """Wait for the next packet and return it; None at the end, or if the stream is lost. One thread may fetch
        while another decodes."""
        index = self.stream.index
        with av.logging.Capture() as log_lines:
            try:
                packets = (packet for packet in self._packets if self.is_cancelled or packet.stream.index == index)
                packet = next(packets, None)
            except (av.FFmpegError, OSError):
                return None
        if packet is None or self.is_cancelled:
            return None
        if packet.is_corrupt or _has_loss(log_lines):
            # FFmpeg reports a gap while it assembles the image that follows the one it returns.
            self._doubtful_count = _DOUBTFUL_PACKETS
        self._doubtful_count -= 1
        return TimedPacket(packet, self._doubtful_count >= 0)

    def skip(self) -> Refusal:
        """Reject the packet just fetched without decoding it, and all later ones until the next key frame. Returns the
        reason: LATE, or the reason of an earlier rejection that is still in effect."""
        return self._refuse(Refusal.LATE)

    def decode(self, fetched: TimedPacket) -> list[VideoFrame] | Refusal:
        """Return the images that this packet completes (none, one or, at the end, several), or why it is rejected."""
        packet = fetched.packet
        if not packet.size:
            return [] if self._refusal else self._decode_packet(packet)
        if fetched.is_doubtful or self.is_backlog_suspect:
            return self._refuse()
        if self._refusal:
            if not packet.is_keyframe:
                return self._refusal
            if self._has_begun:
                self._codec.flush_buffers()
            self._refusal, self._has_begun = None, True
        # Corrupted bytes within a JPEG are detected only if they are invalid or the data ends early. Most are valid:
        # the rest of the image is shifted or brighter, but contains no parts of an older one.
        if self._codec.name == "mjpeg" and not is_whole_jpeg(bytes(packet)):
            return self._refuse()
        return self._decode_packet(packet)

    def make_thumbnail(self, picture: VideoFrame) -> Image:
        """Return a coarse grey copy of an image, see `Shot.thumbnail`."""
        return self._converter.make_thumbnail(picture)

    def prepare_conversion(self, picture: VideoFrame) -> Callable[[], Image]:
        """Return a function that converts an image to pixels, uint8 (H, W, 3) BGR or (H, W) grey; any thread may call
        it. Images of maps and queries are both converted here, so that equal images give equal pixels."""
        aspect = self._codec.sample_aspect_ratio or self.stream.sample_aspect_ratio
        return self._converter.prepare_conversion(picture, float(aspect or 1))

    def close(self) -> None:
        """Close the file or the connection."""
        self.container.close()
        if self._file:
            self._file.close()

    def _decode_packet(self, packet: "Packet[Any]") -> list[VideoFrame] | Refusal:
        with av.logging.Capture():
            try:
                pictures = self._codec.decode(packet)
            except av.FFmpegError:
                return self._refuse()
        return self._refuse() if any(picture.is_corrupt for picture in pictures) else pictures

    def _refuse(self, reason: Refusal = Refusal.DAMAGED) -> Refusal:
        self._refusal = self._refusal or reason
        return self._refusal
