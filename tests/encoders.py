"""Pictures that FFmpeg encodes and sends as they come: to an address, or to a function that takes the bytes."""

import io
from collections.abc import Callable
from fractions import Fraction

import av
import numpy as np

_RTP = {"libx264": (96, "H264"), "libx265": (96, "H265"), "mpeg2video": (32, "MPV"), "mjpeg": (26, "JPEG")}


class _Writer(io.RawIOBase):
    """A file of which everything written goes to a function at once."""

    def __init__(self, give: Callable[[bytes], object]) -> None:
        self._give = give

    def writable(self) -> bool:
        return True

    def write(self, data) -> int:
        self._give(bytes(data))
        return len(data)


class Encoder:
    """Encodes pictures uint8 (H, W, 3) BGR of one size by a codec of FFmpeg, and muxes them in the format `form` (None:
    that of the name). `options` are of the codec; `box` is the container of PyAV, and `more` are its options."""

    def __init__(
        self,
        target: str | Callable[[bytes], object],
        form: str | None,
        codec: str,
        rate_hz: float,
        size_px: tuple[int, int],
        options: dict[str, str] | None = None,
        **more: str,
    ) -> None:
        target = target if isinstance(target, str) else _Writer(target)
        at_once = {"flush_packets": "1", "max_interleave_delta": "1", "packetsize": "1200", **more}
        self.box = av.open(target, "w", format=form, container_options=at_once)
        self._stream = self.box.add_stream(codec, rate=Fraction(rate_hz), options=options or {})
        self._stream.width, self._stream.height = size_px
        self._stream.pix_fmt = "yuvj420p" if codec == "mjpeg" else "yuv420p"

    def write(self, number: int, picture: np.ndarray) -> None:
        frame = av.VideoFrame.from_ndarray(picture, "bgr24").reformat(format=self._stream.pix_fmt)
        frame.pts = number
        self.box.mux(self._stream.encode(frame))

    def close(self) -> None:
        self.box.mux(self._stream.encode(None))
        self.box.close()


def describe_rtp(codec: str, port: int) -> str:
    """Return the SDP of a codec that is sent by RTP to a port of this machine."""
    payload, name = _RTP[codec]
    head = "v=0\r\no=- 0 0 IN IP4 127.0.0.1\r\ns=camera\r\nc=IN IP4 127.0.0.1\r\nt=0 0\r\n"
    return f"{head}m=video {port} RTP/AVP {payload}\r\na=rtpmap:{payload} {name}/90000\r\n"
