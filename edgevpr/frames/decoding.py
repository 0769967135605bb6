"""Decoding of streams and video files with FFmpeg (PyAV), which reports lost packets and incomplete pictures, as OpenCV
does not. Imported only when a stream or video file is opened, because the library takes memory.
"""

import logging
from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction
from typing import TYPE_CHECKING, Any

import av
import av.logging

from edgevpr.core.arrays import Image
from edgevpr.frames.causes import explain_failure
from edgevpr.frames.images import jpeg_is_whole
from edgevpr.frames.pixels import PixelConverter
from edgevpr.frames.shot import OpeningError, Refusal, StreamFacts

if TYPE_CHECKING:
    from _typeshed import SupportsRead
    from av.container import InputContainer
    from av.packet import Packet
    from av.video.frame import VideoFrame

# FFmpeg's messages are searched for lost packets. All others are dropped: edgevpr reports faults in its own words.
av.logging.set_level(av.logging.WARNING)
av.logging.set_skip_repeated(False)
logging.getLogger("libav").setLevel(logging.CRITICAL + 1)
_MISSED = "missed"  # "RTP: missed 3 packets", the only sign of it

_PACKETS_IN_DOUBT = 2  # after a sign of loss: this packet and the next
_UNSTAMPED = 0x80  # AVFMT_NOTIMESTAMPS of FFmpeg: the time stamps are made up from a frame rate


def open_pictures(
    uri: str,
    options: dict[str, str],
    timeouts_s: tuple[float, float] | None = None,
    form: str | None = None,
    file: "SupportsRead[bytes] | None" = None,
) -> "WholePictures":
    """Open the stream or file `uri` with `options` of FFmpeg. `timeouts_s`: time limits in seconds for opening it and
    for each read (None: no limits). `form`: name of its format (None: FFmpeg finds out). `file`: an open file that is
    read instead. Raises OpeningError with the cause if it cannot be opened or has no pictures."""
    with av.logging.Capture() as said:
        try:
            container = av.open(file or uri, "r", format=form, options=options, timeout=timeouts_s)
        except (av.FFmpegError, OSError, ValueError) as error:
            messages = [message for _, _, message in said]
            raise explain_failure(uri, error, messages, timeouts_s[0] if timeouts_s else 0.0) from None
    if container.streams.video and getattr(container.streams.video[0], "codec_context", None):  # None: unknown codec
        return WholePictures(container, _is_missed(said))
    has_video = bool(container.streams.video)
    container.close()
    raise OpeningError("a codec that FFmpeg does not know" if has_video else "no video in the stream")


@dataclass(frozen=True, slots=True)
class Fetched:
    """A packet of the stream, and whether it can be trusted. `is_doubtful`: packets before it may be missing."""

    packet: "Packet[Any]"
    is_doubtful: bool


def _is_missed(said: list[tuple[int, str, str]]) -> bool:
    return any(_MISSED in message for _, _, message in said)


class WholePictures:
    """The complete pictures of one stream or file: `fetch` a packet, then `decode` it. A damaged picture is rejected,
    and so are all pictures after it up to the next key frame, which is decoded without others.

    `is_cancelled`: set it to end a `fetch` in another thread with the next packet, be it of sound.
    FFmpeg reads ahead while it opens a stream. `are_missed`: it reported lost packets during that. As it does not say
    which packets are lost, all are rejected until `caught_up` is called."""

    def __init__(self, container: "InputContainer", are_missed: bool) -> None:
        self.container, self.stream = container, container.streams.video[0]
        self.time_base = self.stream.time_base or Fraction(1, 1_000_000)  # unit of the time stamps in seconds
        self.is_stamped = not container.format.flags & _UNSTAMPED
        self._codec = self.stream.codec_context
        self._codec.thread_count = 1  # decoding several pictures in parallel delays them and takes memory
        self._codec.options = {"err_detect": "explode"}  # damaged data is an error, and not filled in
        self.is_cancelled = False
        self._packets = container.demux()
        self._converter = PixelConverter()
        self._is_backlog_doubtful = are_missed
        self._doubtful = 0  # number of packets from now on that are doubtful, if above zero
        self._refusal: Refusal | None = Refusal.LATE  # reason to reject all pictures until the next key frame
        self._has_begun = False

    @property
    def facts(self) -> StreamFacts:
        """What the stream states of its pictures; known once one is decoded."""
        aspect, rate = self._codec.sample_aspect_ratio, self.stream.average_rate
        return StreamFacts(
            width_px=self._codec.width,
            height_px=self._codec.height,
            codec=self._codec.name,
            bits=self._codec.format.components[0].bits if self._codec.format else 8,
            pixel_aspect=float(aspect or 1),
            rate_hz=float(rate) if rate and self.is_stamped else None,
        )

    def caught_up(self) -> None:
        """Trust the packets that are fetched from now on: they were sent after the opening."""
        self._is_backlog_doubtful = False

    def fetch(self) -> Fetched | None:
        """Wait for the next packet and return it; None at the end of the file, or if the stream is lost. One thread may
        fetch while another one decodes."""
        with av.logging.Capture() as said:
            try:
                packet = next((each for each in self._packets if self.is_cancelled or self._is_ours(each)), None)
            except (av.FFmpegError, OSError):
                return None
        if packet is None or self.is_cancelled:
            return None
        if packet.is_corrupt or _is_missed(said):
            # FFmpeg reports a gap while it assembles the picture after the one that it returns.
            self._doubtful = _PACKETS_IN_DOUBT
        self._doubtful -= 1
        return Fetched(packet, self._doubtful >= 0)

    def skip(self) -> Refusal:
        """Reject the packet just fetched without decoding it, and all after it up to the next key frame. Returns the
        reason of the rejection: LATE, or that of an earlier rejection which still lasts."""
        return self._refuse(Refusal.LATE)

    def decode(self, fetched: Fetched) -> "list[VideoFrame] | Refusal":
        """Return the pictures that are complete after this packet (none, one, or at the end several), or the reason why
        it is rejected."""
        packet = fetched.packet
        if not packet.size:
            return [] if self._refusal else self._decoded(packet)
        if fetched.is_doubtful or self._is_backlog_doubtful:
            return self._refuse()
        if self._refusal:
            if not packet.is_keyframe:
                return self._refusal
            if self._has_begun:
                self._codec.flush_buffers()
            self._refusal, self._has_begun = None, True
        # Changed bytes within a JPEG are detected only if they are invalid or data run out. Most are valid and give a
        # picture whose remainder is shifted or brighter, but that contains nothing of an older picture.
        if self._codec.name == "mjpeg" and not jpeg_is_whole(bytes(packet)):
            return self._refuse()
        return self._decoded(packet)

    def look(self, picture: "VideoFrame") -> Image:
        """Return a coarse grey copy of a picture, see `Shot.look`."""
        return self._converter.look(picture)

    def conversion(self, picture: "VideoFrame") -> Callable[[], Image]:
        """Return a function that converts a picture to pixels, uint8 (H, W, 3) BGR or (H, W) grey. Another thread may
        call it. Maps and queries are both converted here, so that equal pictures give equal pixels."""
        aspect = self._codec.sample_aspect_ratio or self.stream.sample_aspect_ratio
        return self._converter.conversion(picture, float(aspect or 1))

    def close(self) -> None:
        """Close the file or the connection."""
        self.container.close()

    def _is_ours(self, packet: "Packet[Any]") -> bool:
        return bool(packet.stream.index == self.stream.index)

    def _decoded(self, packet: "Packet[Any]") -> "list[VideoFrame] | Refusal":
        with av.logging.Capture():
            try:
                pictures = self._codec.decode(packet)
            except av.FFmpegError:
                return self._refuse()
        return self._refuse() if any(picture.is_corrupt for picture in pictures) else pictures

    def _refuse(self, why: Refusal = Refusal.DAMAGED) -> Refusal:
        self._refusal = self._refusal or why
        return self._refusal
