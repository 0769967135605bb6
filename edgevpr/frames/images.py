"""Lists, decodes and encodes image files. An incomplete file is an error and is never partially decoded. OpenCV's log
is off because edgevpr reports each fault once, in its own words; set OPENCV_LOG_LEVEL to turn it on."""

import contextlib
import os
import re
import zlib
from collections.abc import Sequence
from pathlib import Path

import cv2 as cv2  # re-exported: other packages import it from here
import numpy as np

from edgevpr.core.arrays import Image
from edgevpr.core.errors import ImageError, SourceError
from edgevpr.core.files import read_file
from edgevpr.frames.depth import DepthRange

if "OPENCV_LOG_LEVEL" not in os.environ:
    # The function is in `cv2` in OpenCV 4 and in a submodule in OpenCV 5; level 0 is silent in both.
    (getattr(cv2, "setLogLevel", None) or cv2.utils.logging.setLogLevel)(0)
# OpenCV reads this when the first camera is opened, not at import. By default, a hung camera blocks a read for 10 s.
os.environ.setdefault("OPENCV_VIDEOIO_V4L_SELECT_TIMEOUT", "3")  # seconds

EXTENSIONS = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp", ".pgm", ".ppm")
MIN_SIDE_PX = 16
MAX_PIXELS = int(os.environ["OPENCV_IO_MAX_IMAGE_PIXELS"])
_MAX_FILE_BYTES = 4 * MAX_PIXELS  # of an uncompressed image with an alpha channel
_SMALL_QUALITY = 80
_WEBP_QUALITY = 55
_RECORDING_QUALITY = 95

_JPEG_START = b"\xff\xd8\xff"
_PNG_START = b"\x89PNG\r\n\x1a\n"
_START_PATTERN = re.compile(
    rb"\xff\xd8\xff|\x89PNG\r\n\x1a\n|II|MM|BM|RIFF|P[1-6]\s"
)  # JPEG, PNG, TIFF (2), BMP, WebP, PNM
# In the scan data of a JPEG, 0xFF followed by 00 (stuffing) or D0..D7 (restart) is not an end marker.
_MARKER_PATTERN = re.compile(rb"\xff+[^\x00\xd0-\xd7\xff]")
_END_OF_IMAGE = 0xD9


def list_images(folder: str | Path) -> list[Path]:
    """List the paths of the images directly in `folder`, sorted by name, with numbers in numeric order (2 before 10).
    Raises SourceError if the folder cannot be read or contains no images."""
    folder = Path(folder)
    try:
        names = sorted((path.name for path in folder.iterdir()), key=make_sort_key)
    except OSError as error:
        raise SourceError(f"{folder} cannot be read ({error.strerror}): choose a readable folder of images.") from None
    if images := [folder / name for name in names if is_image(name)]:
        return images
    nested = [str(folder / name) for name in names if any(is_image(path.name) for path in (folder / name).glob("*"))]
    advice = " or ".join(nested[:3]) or "one that does"
    raise SourceError(f"The folder {folder} contains no images ({' '.join(EXTENSIONS)}): choose {advice}.")


def is_image(name: str) -> bool:
    """Return True if the file name is that of an image."""
    # Files whose names begin with a dot are metadata of other systems (._IMG_1.jpg), not photographs.
    return name.lower().endswith(EXTENSIONS) and not name.startswith(".")


def make_sort_key(name: str) -> tuple[list[str | int], str]:
    """Return the sort key of a file name; numbers within names sort in numeric order (2 before 10)."""
    return [int(part) if i % 2 else part for i, part in enumerate(re.split(r"(\d+)", name.lower()))], name


def read_image(path: str | Path, depth: DepthRange | None = None, *, upright: bool = True) -> Image:
    """Decode an image file to uint8, (H, W, 3) BGR or (H, W) grey, without alpha channel. With `upright`, it is rotated
    by its EXIF data; without, its top remains that of the camera, to which heading and tilt refer. A
    16-bit image is scaled to the range `depth` of the images before it (None: to its own). Raises ImageError unless the
    file is a complete image of 8 or 16 bits, with at least 16x16 and at most `MAX_PIXELS` pixels."""
    try:
        data = read_file(path, _MAX_FILE_BYTES)
    except OSError as error:
        raise ImageError(f"The image {path} cannot be read ({error.strerror}): choose a readable file.") from error
    except MemoryError:
        raise ImageError(f"{path} does not fit in the free memory: use a smaller image.") from None
    return decode_image(data, str(path), depth, upright=upright)


def decode_image(data: bytes, path: str, depth: DepthRange | None = None, *, upright: bool = True) -> Image:
    """Decode the content of an image file, as `read_image` does; `path` is its name in error messages."""
    if _is_incomplete(data):
        raise ImageError(f"{path} is empty, truncated or damaged: copy it again from the camera.")
    image, flags = None, cv2.IMREAD_ANYCOLOR | cv2.IMREAD_ANYDEPTH
    if not upright:
        flags |= cv2.IMREAD_IGNORE_ORIENTATION
    with contextlib.suppress(cv2.error):  # raised if there are too many pixels
        if _START_PATTERN.match(data):
            image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    # OpenCV has a different limit if a program imported it before edgevpr, so the size is checked here too.
    if image is None or image.dtype not in (np.uint8, np.uint16) or image.shape[0] * image.shape[1] > MAX_PIXELS:
        raise ImageError(
            f"{path} is not an image that edgevpr can decode: use a JPEG, PNG, TIFF, BMP or WebP file with 8 or 16 "
            f"bits per channel and at most {MAX_PIXELS / 1e6:.0f} megapixels."
        )
    height, width = image.shape[:2]
    if min(height, width) < MIN_SIDE_PX:
        raise ImageError(
            f"{path} is {width}x{height} pixels, but must be at least {MIN_SIDE_PX}x{MIN_SIDE_PX}: use a larger image."
        )
    if image.dtype == np.uint16:
        return (depth or DepthRange()).to_8_bits(image.astype(np.uint16, copy=False))
    return image  # type: ignore[return-value]  # its dtype has been checked


def decode_jpeg(jpeg: bytes) -> Image:
    """Decode a JPEG written by edgevpr. Returns uint8, (H, W, 3) BGR or (H, W) grey."""
    return cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_ANYCOLOR)  # type: ignore[return-value]  # uint8


def encode_jpeg(image: Image) -> bytes:
    """Encode an image, uint8 (H, W, 3) BGR or (H, W) grey, as a JPEG in the quality of flight recordings."""
    return _encode(".jpg", image, (cv2.IMWRITE_JPEG_QUALITY, _RECORDING_QUALITY))


def encode_small_jpeg(image: Image, longest_px: int) -> bytes:
    """Encode an image, uint8 (H, W[, 3]), as a JPEG for viewing, its longest side at most `longest_px`."""
    return _encode(".jpg", limit_size(image, longest_px), (cv2.IMWRITE_JPEG_QUALITY, _SMALL_QUALITY))


def encode_small_webp(image: Image, longest_px: int) -> bytes:
    """Encode an image, uint8 (H, W[, 3 or 4]), as a WebP, which is half as large and can have an alpha channel."""
    return _encode(".webp", limit_size(image, longest_px), (cv2.IMWRITE_WEBP_QUALITY, _WEBP_QUALITY))


def limit_size(image: Image, longest_px: int) -> Image:
    """Scale an image, uint8 (H, W[, C]), down until its longest side has at most `longest_px` pixels."""
    if (scale := longest_px / max(image.shape[:2])) >= 1:
        return image
    width, height = (max(1, round(scale * side)) for side in image.shape[1::-1])
    return resize(image, (width, height))


def resize(image: Image, size_px: tuple[int, int]) -> Image:
    """Scale an image to `size_px` (width, height). When downscaling, each pixel is the mean of those it covers."""
    return cv2.resize(image, size_px, interpolation=cv2.INTER_AREA)  # type: ignore[return-value]  # of the same dtype


def shrink_image(image: Image, shrink: float) -> Image:
    """Downscale an image by the factor `shrink` before a warp, because interpolation alone would skip most pixels. Up
    to a factor of 2, the image is returned unchanged."""
    if shrink <= 2:
        return image
    height, width = image.shape[:2]
    return resize(image, (max(1, round(width / shrink)), max(1, round(height / shrink))))


def _encode(extension: str, image: Image, options: Sequence[int] = ()) -> bytes:
    return cv2.imencode(extension, image, options)[1].tobytes()


def _is_incomplete(data: bytes) -> bool:
    # OpenCV 4 fills the missing part of a JPEG with grey and ignores the checksums of a PNG; its decoders for other
    # formats detect damage. Bytes after the end marker are allowed.
    if data.startswith(_JPEG_START):
        return not is_whole_jpeg(data)
    return not data or (data.startswith(_PNG_START) and not _is_whole_png(data))


def is_whole_jpeg(data: bytes) -> bool:
    """Return True if a JPEG has its end marker (ITU-T T.81, annex B). Segments are skipped by their length, so that the
    end marker of an EXIF thumbnail is not mistaken for the image's."""
    position = 2
    while marker := _MARKER_PATTERN.search(data, position):
        if data[marker.end() - 1] == _END_OF_IMAGE:
            return True
        position = marker.end() + int.from_bytes(data[marker.end() : marker.end() + 2], "big")
    return False


def _is_whole_png(data: bytes) -> bool:
    """Return True if all chunks (length, type, data, checksum) of a PNG are intact up to IEND."""
    position = len(_PNG_START)
    while position + 12 <= len(data):
        end = position + 8 + int.from_bytes(data[position : position + 4], "big")
        if zlib.crc32(data[position + 4 : end]) != int.from_bytes(data[end : end + 4], "big"):
            return False
        if data[position + 4 : position + 8] == b"IEND":
            return True
        position = end + 4
    return False
