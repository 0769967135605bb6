"""Decoding with FFmpeg (PyAV), which tells what OpenCV hides: packets that were lost, pictures that are not whole.

Only what opens a stream or a video file imports this: the library takes room.
"""

import logging
from dataclasses import dataclass
from fractions import Fraction
from typing import TYPE_CHECKING, Any

import av
import av.logging
import numpy as np
from av.video.reformatter import VideoReformatter

from edgevpr.frames.images import jpeg_is_whole
from edgevpr.frames.shot import Refusal

if TYPE_CHECKING:
    from av.container import InputContainer
    from av.packet import Packet
    from av.video.frame import VideoFrame

# FFmpeg's messages are listened to for packets that went missing; what else it says is said in edgevpr's own words.
av.logging.set_level(av.logging.WARNING)
av.logging.set_skip_repeated(False)
logging.getLogger("libav").setLevel(logging.CRITICAL + 1)
_MISSED = "missed"  # "RTP: missed 3 packets", the only sign of it

_PACKETS_IN_DOUBT = 2
_UNSTAMPED = 0x80  # AVFMT_NOTIMESTAMPS of FFmpeg: what looks like a time stamp has been made up from a frame rate


def open_pictures(
    uri: str, options: dict[str, str], timeouts_s: tuple[float, float] | None = None
) -> "WholePictures | None":
    """Open a stream or file with FFmpeg's options, and the time-outs for opening and for every reading; None where
    nothing is there that holds pictures."""
    with av.logging.Capture() as said:
        try:
            container = av.open(uri, options=options, timeout=timeouts_s)
        except (av.FFmpegError, OSError, ValueError):
            return None
    if container.streams.video:
        return WholePictures(container, _is_missed(said))
    container.close()
    return None


@dataclass(frozen=True, slots=True)
class Fetched:
    """A packet; `is_doubtful` where others may be missing before it."""

    packet: "Packet[Any]"
    is_doubtful: bool


def _is_missed(said: list[tuple[int, str, str]]) -> bool:
    return any(_MISSED in message for _, _, message in said)


class WholePictures:
    """The pictures of one container that are whole: `fetch` a packet, then `decode` it. A picture that is damaged, and
    all that are predicted from it until the next one that stands alone, are refused before they cost anything.

    FFmpeg reads ahead while it opens a stream. Where packets `are_missed` then, it is not known which, and no packet is
    trusted until `caught_up` is called."""

    def __init__(self, container: "InputContainer", are_missed: bool) -> None:
        self.container, self.stream = container, container.streams.video[0]
        self.time_base = self.stream.time_base or Fraction(1, 1_000_000)  # seconds of a time stamp's unit
        self.is_stamped = not container.format.flags & _UNSTAMPED
        self._codec = self.stream.codec_context
        self._codec.thread_count = 1  # pictures decoded side by side come late, and each takes memory
        self._codec.options = {"err_detect": "explode"}  # what cannot be decoded is not filled in
        self._packets = container.demux(self.stream)
        self._reformatter = VideoReformatter()
        self._is_backlog_doubtful = are_missed
        self._doubtful = 0  # so many packets from now on are not to be trusted, where it is above zero
        self._refusal: Refusal | None = Refusal.LATE  # of all until the next one that stands alone
        self._has_begun = False

    def caught_up(self) -> None:
        """Take note that what is fetched from now on came after the opening."""
        self._is_backlog_doubtful = False

    def fetch(self) -> Fetched | None:
        """Wait for the next packet and return it; None at the end, and where the stream is lost. One thread may do this
        while another one decodes."""
        with av.logging.Capture() as said:
            try:
                packet = next(self._packets, None)
            except (av.FFmpegError, OSError):
                return None
        if packet is None:
            return None
        if packet.is_corrupt or _is_missed(said):
            # FFmpeg notices a gap while it puts together the picture after the one that it hands out.
            self._doubtful = _PACKETS_IN_DOUBT
        self._doubtful -= 1
        return Fetched(packet, self._doubtful >= 0)

    def skip(self) -> Refusal:
        """Leave a packet out, and say why it and those that are built on it are refused."""
        return self._refuse(Refusal.LATE)

    def decode(self, fetched: Fetched) -> "list[VideoFrame] | Refusal":
        """Return the pictures that are ready after this packet: none, one, or at the end several."""
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
        # Bytes that were changed within the data of a JPEG are noticed where they make no sense or data run out. Most
        # make sense: they give a picture whose rest is shifted or of another brightness, but is no older.
        if self._codec.name == "mjpeg" and not jpeg_is_whole(bytes(packet)):
            return self._refuse()
        return self._decoded(packet)

    def pixels(self, picture: "VideoFrame", form: str = "bgr24") -> np.ndarray:
        """Return the pixels of a picture, uint8: (H, W, 3) BGR, or (H, W) for the form "gray". Maps and queries go
        through this alike, so that the same picture gives the same pixels."""
        return self._reformatter.reformat(picture, format=form, interpolation="BICUBIC").to_ndarray()

    def close(self) -> None:
        """Close the file or the connection."""
        self.container.close()

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
