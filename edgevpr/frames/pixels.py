"""Converts decoded pictures of any pixel format to the pixels that edgevpr uses: 8 bits per channel, square."""

import re
import threading
from collections.abc import Callable
from typing import Any

import numpy as np
from av.video.frame import VideoFrame
from av.video.reformatter import VideoReformatter
from numpy.typing import NDArray

from edgevpr.core.arrays import Image
from edgevpr.frames.depth import DepthRange, make_counts_thumbnail, to_8_bits
from edgevpr.frames.shot import make_thumbnail

# Formats whose first plane is luma. Groups: grey, bits per channel (none: 8), byte order.
_LUMA_FORMATS = re.compile(r"(?:(gray)|yuv[aj]?\d{3}p|nv12|nv21|nv16)(?:(9|1\d)(le|be))?")
_SQUARE_TOLERANCE = 0.01  # of the aspect ratio of square pixels: its effect on positions is smaller than other errors
_MAX_ASPECT = 4.0  # the widest in use is 2.2; a claim of more than 4, or less than 1/4, is wrong


class PixelConverter:
    """Converts the pictures of one stream or file. The decoding thread calls `make_thumbnail` and `prepare_conversion`
    for every picture, in order; any thread may call the functions that `prepare_conversion` returns.

    Grey pictures of more than 8 bits hold counts, which are scaled to their own range (`frames.depth`). In colour video
    of more than 8 bits, the levels are standardised, as with 8 bits."""

    def __init__(self) -> None:
        self._local = threading.local()  # FFmpeg's converter hangs or crashes if two threads share it
        self._depth = DepthRange()

    def make_thumbnail(self, picture: VideoFrame) -> Image:
        """Return a coarse grey copy of a picture, uint8 (h, w), see `Shot.thumbnail`."""
        layout = _match_layout(picture)
        if layout is None:
            return make_thumbnail(np.asarray(self._reformat(picture, "gray").to_ndarray(), np.uint8))
        plane = _read_luma(picture, layout)
        if layout[1] and layout[2]:
            return make_counts_thumbnail(plane)
        return np.asarray(make_thumbnail(plane) >> (int(layout[2] or 8) - 8), np.uint8)

    def prepare_conversion(self, picture: VideoFrame, aspect: float) -> Callable[[], Image]:
        """Return a function that converts a picture to uint8 (H, W, 3) BGR, or (H, W) grey for counts, with square
        pixels of the same height. `aspect`: width of its pixels divided by their height."""
        is_usable = abs(aspect - 1) > _SQUARE_TOLERANCE and 1 / _MAX_ASPECT <= aspect <= _MAX_ASPECT
        width_px = round(picture.width * aspect) if is_usable else picture.width
        layout = _match_layout(picture)
        if not (layout and layout[1] and layout[2]):
            return lambda: np.asarray(self._reformat(picture, "bgr24", width_px).to_ndarray(), np.uint8)
        limits = self._depth.update(_read_luma(picture, layout))
        return lambda: to_8_bits(_read_luma(self._reformat(picture, picture.format.name, width_px), layout), limits)

    def _reformat(self, picture: VideoFrame, format_name: str, width_px: int | None = None) -> VideoFrame:
        converter: VideoReformatter | None = getattr(self._local, format_name, None)
        if converter is None:
            converter = VideoReformatter()
            setattr(self._local, format_name, converter)
        return converter.reformat(picture, width=width_px, format=format_name, interpolation="BICUBIC")


def _match_layout(picture: VideoFrame) -> re.Match[str] | None:
    """Return the match of `_LUMA_FORMATS` that describes the luma in the first plane; None if luma must be computed.
    Rows stored from bottom to top cannot be read in place."""
    return None if picture.planes[0].line_size < 0 else _LUMA_FORMATS.fullmatch(picture.format.name)


def _read_luma(picture: VideoFrame, layout: re.Match[str]) -> NDArray[Any]:
    """Return the first plane of a picture, uint8 or uint16 (H, W), without a copy."""
    dtype = np.dtype({"le": "<u2", "be": ">u2"}[layout[3]] if layout[2] else np.uint8)
    plane = picture.planes[0]
    rows = np.frombuffer(memoryview(plane), dtype).reshape(-1, plane.line_size // dtype.itemsize)
    return rows[: picture.height, : picture.width]
