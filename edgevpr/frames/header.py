"""The header of an image file: its size and depth, so that the cost of decoding is known before any pixel is read."""

import re
import struct
from dataclasses import dataclass

# The markers of a JPEG (ITU-T T.81, table B.1). These have no length behind them: TEM, restart, start and end of image.
_BARE_MARKERS = frozenset((0x00, 0x01, *range(0xD0, 0xDA)))
_FRAME_MARKERS = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}  # SOF0..SOF15 without DHT, JPG, DAC
_MARKER = re.compile(rb"\xff+([^\xff])")
_GAP = rb"\s+(?:#[^\n]*\n\s*)*"
_PNM = re.compile(rb"P[1-6]" + _GAP + rb"(\d{1,9})" + _GAP + rb"(\d{1,9})(?:" + _GAP + rb"(\d{1,9}))?\s")
_PNM_HEADER_BYTES = 4096
_WIDTH, _HEIGHT, _BITS, _TILE_WIDTH, _TILE_HEIGHT = 256, 257, 258, 322, 323  # tags of TIFF
_NUMBERS = {1: "B", 3: "H", 4: "I", 16: "Q"}  # of a TIFF: BYTE, SHORT, LONG, LONG8
_MOST_TAGS = 4096  # of a TIFF's directory


@dataclass(frozen=True, slots=True)
class Header:
    """Width and height in pixels, and bits a channel, as promised by a file."""

    width: int
    height: int
    bits: int = 8


def read_header(data: bytes) -> Header | None:
    """Read the header of a JPEG, PNG, TIFF, BMP, WebP or PNM file; None for any other file, and for a broken header.

    Of a TIFF in tiles, a tile that is larger than the picture counts instead.
    """
    for start, read in _READERS.items():
        if data.startswith(start):
            try:
                return read(data)
            except (struct.error, IndexError, KeyError):  # cut, or senseless
                return None
    return None


def _jpeg(data: bytes) -> Header | None:
    position = 2
    while marker := _MARKER.search(data, position):
        code, position = marker[1][0], marker.end()
        if code in _FRAME_MARKERS:
            bits, height, width = struct.unpack_from(">BHH", data, position + 2)
            return Header(width, height, bits)
        if code not in _BARE_MARKERS:
            position += int.from_bytes(data[position : position + 2], "big")
    return None


def _png(data: bytes) -> Header | None:
    width, height, bits = struct.unpack_from(">IIB", data, 16)
    return Header(width, height, bits) if data[12:16] == b"IHDR" else None


def _bmp(data: bytes) -> Header:
    (header_bytes,) = struct.unpack_from("<I", data, 14)
    if header_bytes == 12:  # of OS/2
        return Header(*struct.unpack_from("<HH", data, 18))
    width, height = struct.unpack_from("<ii", data, 18)
    return Header(abs(width), abs(height))  # a negative height: the first row is the top one


def _webp(data: bytes) -> Header | None:
    kind = data[8:16]
    if kind == b"WEBPVP8 " and data[23:26] == b"\x9d\x01\x2a":
        width, height = struct.unpack_from("<HH", data, 26)
        return Header(width & 0x3FFF, height & 0x3FFF)
    if kind == b"WEBPVP8L" and data[20] == 0x2F:
        (packed,) = struct.unpack_from("<I", data, 21)
        return Header((packed & 0x3FFF) + 1, (packed >> 14 & 0x3FFF) + 1)
    if kind == b"WEBPVP8X" and len(data) >= 30:
        return Header(int.from_bytes(data[24:27], "little") + 1, int.from_bytes(data[27:30], "little") + 1)
    return None


def _pnm(data: bytes) -> Header | None:
    found = _PNM.match(data[:_PNM_HEADER_BYTES])
    if found is None:
        return None
    is_bitmap = data[1:2] in b"14"  # which has no largest value: its pixels begin there
    return Header(int(found[1]), int(found[2]), 16 if not is_bitmap and int(found[3] or 0) > 255 else 8)


def _tiff(data: bytes) -> Header | None:
    order = "<" if data[:2] == b"II" else ">"
    (version,) = struct.unpack_from(order + "H", data, 2)
    if version not in (42, 43):
        return None
    # Version 43 is BigTIFF, whose counts and offsets have 8 bytes.
    offset, count_form, entry_bytes = ("I", "H", 12) if version == 42 else ("Q", "Q", 20)
    room_bytes = struct.calcsize(offset)
    (directory_at,) = struct.unpack_from(order + offset, data, 4 if version == 42 else 8)
    (tags,) = struct.unpack_from(order + count_form, data, directory_at)
    said: dict[int, int] = {}
    for number in range(min(tags, _MOST_TAGS)):
        at = directory_at + struct.calcsize(order + count_form) + number * entry_bytes
        tag, kind, values = struct.unpack_from(order + "HH" + offset, data, at)
        if tag in (_WIDTH, _HEIGHT, _BITS, _TILE_WIDTH, _TILE_HEIGHT):
            value_at = at + entry_bytes - room_bytes
            if values * struct.calcsize(_NUMBERS[kind]) > room_bytes:  # too many for the entry: they lie elsewhere
                (value_at,) = struct.unpack_from(order + offset, data, value_at)
            (value,) = struct.unpack_from(order + _NUMBERS[kind], data, value_at)
            said[tag] = max(value, said.get(tag, 0))  # which of two of the same tag counts is up to the decoder
    width, height = (max(said[side], said.get(tile, 0)) for side, tile in _SIDES)
    return Header(width, height, max(8, said.get(_BITS, 1)))


_SIDES = ((_WIDTH, _TILE_WIDTH), (_HEIGHT, _TILE_HEIGHT))
_READERS = {
    b"\xff\xd8\xff": _jpeg,
    b"\x89PNG\r\n\x1a\n": _png,
    b"II": _tiff,
    b"MM": _tiff,
    b"BM": _bmp,
    b"RIFF": _webp,
    b"P": _pnm,
}
