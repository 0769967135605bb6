"""Image files: the list of a folder, and the pixels of one file. An incomplete file is refused, never half decoded."""

import re
import zlib
from pathlib import Path

import numpy as np

from edgevpr.core.errors import ImageError, SourceError
from edgevpr.core.files import read_file
from edgevpr.frames.header import Header, read_header
from edgevpr.frames.opencv import cv2

EXTENSIONS = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp", ".pgm", ".ppm")
MIN_SIDE_PX = 16
_NAMED = 3  # folders, in a sentence
# The largest survey cameras that are flown have 100 megapixels (11664 x 8750); decoded that is 300 MB. Without a limit
# a file of 1 MB, which compresses well, takes gigabytes.
MAX_PIXELS = 102_100_000
_MAX_FILE_BYTES = 4 * MAX_PIXELS  # such a picture with transparency, not compressed at all

_JPEG_START = b"\xff\xd8\xff"
_PNG_START = b"\x89PNG\r\n\x1a\n"
# In the scan data of a JPEG, 0xFF followed by 00 (stuffing) or D0..D7 (restart) does not end the data.
_MARKER = re.compile(rb"\xff+[^\x00\xd0-\xd7\xff]")
_START_OF_SCAN, _END_OF_IMAGE = 0xDA, 0xD9
_MOST_SCANS = 100  # of a progressive JPEG, which has about ten; each costs the decoder a pass over the whole picture


def list_images(folder: str | Path) -> list[Path]:
    """List the images that lie in `folder`, sorted by name, with numbers in counting order (2 before 10).

    Raises SourceError for a folder that is missing, cannot be read or holds no images.
    """
    folder = Path(folder)
    try:
        names = [path.name for path in folder.iterdir()]
    except FileNotFoundError:
        raise SourceError(f"The folder {folder} does not exist: give the folder that holds the images.") from None
    except OSError as error:
        raise SourceError(f"{folder} cannot be listed ({error.strerror}): give a folder of images.") from error
    images = [name for name in names if is_image(name)]
    if not images:
        inner = [path for path in map(folder.joinpath, sorted(names, key=counting_order)) if _holds_images(path)]
        advice = f"give {' or '.join(map(str, inner[:_NAMED]))}" if inner else "give the one that does"
        raise SourceError(f"The folder {folder} holds no images ({' '.join(EXTENSIONS)}): {advice}.")
    return [folder / name for name in sorted(images, key=counting_order)]


def read_image(path: str | Path) -> np.ndarray:
    """Decode an image file to uint8, (H, W, 3) BGR or (H, W) grey; turned as its EXIF says, without transparency.

    Raises ImageError for a file that is missing, no regular file, cut short, no image, not 8 bit, smaller than 16x16
    pixels, or larger than `MAX_PIXELS`. Size and depth are those of the header: nothing is decoded in vain.
    """
    try:
        data = read_file(path, _MAX_FILE_BYTES)
    except FileNotFoundError:
        raise ImageError(f"The image {path} does not exist: check the name.") from None
    except OSError as error:
        raise ImageError(f"The image {path} cannot be read ({error.strerror}): give a readable file.") from error
    except MemoryError:
        raise ImageError(f"{path} does not fit in the memory that is left: give a smaller image.") from None
    if not data:
        raise ImageError(f"{path} is empty: copy it again from the camera.")
    if _is_incomplete(data):
        raise ImageError(f"{path} is cut short or damaged: copy it again from the camera.")
    header = read_header(data)
    if header:
        _require_usual(path, header)
    image = decoded(data) if header else None
    if image is None:
        raise ImageError(f"{path} is not an image edgevpr can decode: give a JPEG, PNG, TIFF, BMP or WebP file.")
    if image.dtype != np.uint8:
        raise _other_depth(path, 8 * image.dtype.itemsize)
    height, width = image.shape[:2]
    if min(height, width) < MIN_SIDE_PX:
        raise ImageError(
            f"{path} is {width}x{height} pixels; at least {MIN_SIDE_PX}x{MIN_SIDE_PX} are needed: give a larger image."
        )
    return image


def write_png(path: Path, image: np.ndarray) -> None:
    """Write a picture, uint8, (H, W, 3) BGR or (H, W) grey, without losses. Raises OSError where the disk does not take
    it."""
    _, png = cv2.imencode(".png", image)
    path.write_bytes(png.tobytes())


def _require_usual(path: str | Path, header: Header) -> None:
    if header.width * header.height > MAX_PIXELS:
        raise ImageError(
            f"{path} is {header.width}x{header.height} pixels; edgevpr reads up to {MAX_PIXELS / 1e6:.0f} megapixels: "
            "give a smaller image."
        )
    if header.bits > 8:
        raise _other_depth(path, header.bits)


def _other_depth(path: str | Path, bits: int) -> ImageError:
    return ImageError(f"{path} has {bits} bits a channel; edgevpr reads 8-bit images: convert it first.")


def is_image(name: str) -> bool:
    """Tell whether a file of this name is taken for an image."""
    # Files that begin with a dot are metadata of other systems (._IMG_1.jpg), not photographs.
    return name.lower().endswith(EXTENSIONS) and not name.startswith(".")


def _holds_images(folder: Path) -> bool:
    try:
        return any(is_image(path.name) for path in folder.iterdir())
    except OSError:
        return False  # no folder, or one that may not be listed


def counting_order(name: str) -> tuple[list[str | int], str]:
    """Return the key that sorts names with their numbers in counting order (2 before 10)."""
    parts = re.split(r"(\d+)", name.lower())
    return [int(part) if i % 2 else part for i, part in enumerate(parts)], name


def decoded(data: bytes) -> np.ndarray | None:
    """Decode an image file, (H, W, 3) BGR or (H, W) grey; None where it cannot be."""
    try:
        return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_ANYCOLOR | cv2.IMREAD_ANYDEPTH)
    except cv2.error:  # a header that promises more pixels than OpenCV is willing to hold
        return None


def _is_incomplete(data: bytes) -> bool:
    """Tell whether a JPEG ends before its end mark, or a PNG does not have all its chunks intact.

    OpenCV 4 fills the missing part of a JPEG with grey without an error, and does not check the checksums of a PNG. The
    decoders of the other formats detect damage themselves. Bytes after the end mark are harmless.
    """
    if data.startswith(_JPEG_START):
        return not jpeg_is_whole(data)
    if data.startswith(_PNG_START):
        return not _png_is_whole(data)
    return False


def jpeg_is_whole(data: bytes) -> bool:
    """Walk from marker to marker (ITU-T T.81, annex B); return True where the end mark of the image is reached.

    Segments are skipped by their length, so that the end mark of an EXIF thumbnail is not taken for the image's.
    """
    position, scans = 2, 0
    while marker := _MARKER.search(data, position):
        code = data[marker.end() - 1]
        if code == _END_OF_IMAGE:
            return True
        scans += code == _START_OF_SCAN
        if scans > _MOST_SCANS:
            return False
        position = marker.end() + int.from_bytes(data[marker.end() : marker.end() + 2], "big")
    return False


def _png_is_whole(data: bytes) -> bool:
    """Walk from chunk to chunk (length, kind, content, checksum); return True where the end chunk is reached."""
    position = len(_PNG_START)
    while position + 12 <= len(data):
        end = position + 8 + int.from_bytes(data[position : position + 4], "big")
        if zlib.crc32(data[position + 4 : end]) != int.from_bytes(data[end : end + 4], "big"):
            return False
        if data[position + 4 : position + 8] == b"IEND":
            return True
        position = end + 4
    return False
