"""Damage the bytes of maps at random, and try each in flight, with the commands and with a repair. Wrong content that a
program may write into a map is tried in tests/places and tests/runtime/flight."""

import contextlib
import io
import os
import shutil
import sqlite3
import tempfile
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from base import Row

from edgevpr.cli.main import main
from edgevpr.core.config import Config, load_config
from edgevpr.core.errors import EdgevprError
from edgevpr.core.reasons import ReasonCode
from edgevpr.core.types import Frame, Position
from edgevpr.mapmaking.mapping import build_map
from edgevpr.places.geopackage import encode_point
from edgevpr.places.mapfile import PlaceMap
from edgevpr.power.boards import load_board
from edgevpr.runtime.recognise.encoder import FrameEncoder
from edgevpr.runtime.recognise.opening import open_recogniser
from edgevpr.techniques import create

_PLACES = 12
_QUERY_NUMBERS = (0, 5, 11)  # pictures that are matched in each map
_PAGE_BYTES = 4096
_COLUMNS = ("geom", "time", "alt_m", "heading_deg", "source_image", "quality", "coarse", "fine")

Rng = np.random.Generator


def _flip_bits(path: Path, rng: Rng, end: int | None = None, max_bits: int = 64) -> None:
    """Flip up to `max_bits` bits of the bytes before `end` (None: of all)."""
    data = bytearray(path.read_bytes())
    for offset in rng.integers(0, end or len(data), rng.integers(1, max_bits + 1)):
        data[offset] ^= 1 << int(rng.integers(8))
    path.write_bytes(data)


def _overwrite_pages(path: Path, rng: Rng) -> None:
    """Overwrite up to five pages of SQLite with random bytes, zeros or another page."""
    data = path.read_bytes()
    pages = [data[start : start + _PAGE_BYTES] for start in range(0, len(data), _PAGE_BYTES)]
    for number in rng.integers(0, len(pages), rng.integers(1, 6)):
        other = pages[rng.integers(0, len(pages))]
        pages[number] = (rng.bytes(_PAGE_BYTES), bytes(_PAGE_BYTES), other)[rng.integers(3)]
    path.write_bytes(b"".join(pages))


def _flip_position_bits(path: Path, rng: Rng) -> None:
    """Flip a bit of the position of a place in the file itself, so that no trigger of SQLite notices it."""
    data = bytearray(path.read_bytes())
    number = int(rng.integers(_PLACES))
    offset = data.find(encode_point(*_locate(number)))
    while offset >= 0:  # also where SQLite has left an old copy of the page
        data[offset + 13 + int(rng.integers(16))] ^= 1 << int(rng.integers(8))
        offset = data.find(encode_point(*_locate(number)), offset + 1)
    path.write_bytes(data)


KINDS: dict[str, Callable[[Path, Rng], None]] = {
    "bits flipped": _flip_bits,
    "bits of the header flipped": lambda path, rng: _flip_bits(path, rng, 100, max_bits=3),
    "pages overwritten": _overwrite_pages,
    "cut": lambda path, rng: os.truncate(path, int(rng.random() * path.stat().st_size)),
    "bits of a position flipped": _flip_position_bits,
}


def run(count: int, seed: int) -> list[Row]:
    """Try `count` damaged maps, the kinds in turn, in flight, at take-off, with the commands and with a repair. Returns
    a row a kind: tracebacks, queries accepted at a wrong position, and readable places that a repair lost."""
    rows = [{"kind": kind, "tried": 0, "tracebacks": 0, "wrong_positions": 0, "places_lost": 0} for kind in KINDS]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        intact = make_intact_map(folder / "intact.gpkg")
        for number in range(count):
            row, path = rows[number % len(rows)], folder / f"{number:05d}.gpkg"
            shutil.copyfile(intact, path)
            KINDS[row["kind"]](path, np.random.default_rng((seed, number)))
            with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
                counts = _try_map(path, intact)
            for key, value in {"tried": 1, **counts}.items():
                row[key] += value
            for file in folder.glob(path.name + "*"):
                file.unlink()
    return rows


def make_intact_map(path: Path) -> Path:
    """Make the map to damage, of a few places with random pictures."""
    technique = create("cohog", {"w1": 208})
    with PlaceMap.create(path, technique.spec) as place_map:
        build_map(map(_make_frame, range(_PLACES)), FrameEncoder(technique=technique), place_map)
    return path


def _locate(number: int) -> tuple[float, float]:
    return 50 + number / 1000, 8.0


def _make_frame(number: int) -> Frame:
    noise = np.random.default_rng(number).integers(0, 256, (60, 80), np.uint8)
    image = cv2.resize(noise, (320, 240), interpolation=cv2.INTER_CUBIC)
    return Frame(image=image, name=f"{number}.png", t_mono_s=float(number), position=Position(*_locate(number)))


_BOARD = load_board("this")


def _try_map(path: Path, intact: Path) -> Row:
    """Return the numbers of tracebacks, wrong positions and lost places with one damaged map."""
    config, damaged = load_config(None, {"map": str(path)}), path.read_bytes()
    tracebacks = wrong = lost = 0
    for is_flying in (True, False):
        shutil.copyfile(intact, path)
        try:
            wrong += _count_wrong_positions(config, path, damaged, is_flying)
        except EdgevprError:
            pass
        except Exception:
            tracebacks += 1
    path.write_bytes(damaged)
    readable = _read_intact_ids(path, intact)
    for words in (("info",), ("check",), ("check", "--json"), ("repair",)):
        try:
            main(["map", words[0], str(path), *words[1:]])
        except Exception:
            tracebacks += 1
    if path.with_name(path.name + ".damaged").exists():
        lost = len(readable - _read_intact_ids(path, intact))
    return {"tracebacks": tracebacks, "wrong_positions": wrong, "places_lost": lost}


def _count_wrong_positions(config: Config, path: Path, damaged: bytes, is_flying: bool) -> int:
    """Damage an intact map, before take-off or in flight, and match some pictures twice. Returns how many were accepted
    at a wrong position."""
    if not is_flying:
        path.write_bytes(damaged)
    recogniser, wrong = open_recogniser(config, _BOARD, uses_hints=True), 0
    with recogniser.place_map:
        if is_flying:
            if not recogniser.step(_make_frame(3)).accepted:
                raise AssertionError("an intact map must accept its own picture")
            path.write_bytes(damaged)
        for number in (*_QUERY_NUMBERS, *_QUERY_NUMBERS):
            event = recogniser.step(_make_frame(number))
            position = event.position  # None unless accepted; has no altitude
            wrong += position is not None and (position.lat_deg, position.lon_deg) != _locate(number)
            if event.reason.code is ReasonCode.UNEXPECTED_ERROR:
                raise AssertionError(str(event.reason))
    return wrong


def _read_intact_ids(path: Path, intact: Path) -> set[int]:
    """Return the ids of the places that a map has unchanged from the intact one, read one by one with plain SQLite."""
    columns = ", ".join((*_COLUMNS, "geom_crc32", "coarse_crc32", "fine_crc32"))
    same = set()
    with contextlib.closing(sqlite3.connect(path)) as db, contextlib.closing(sqlite3.connect(intact)) as original:
        db.set_progress_handler(lambda: 1, 1_000_000)  # stop a damaged view that would never end
        for place_id in range(1, _PLACES + 1):
            query = f"SELECT {columns} FROM places WHERE place_id = {place_id}"
            with contextlib.suppress(sqlite3.Error, UnicodeDecodeError):
                if db.execute(query).fetchone() == original.execute(query).fetchone():
                    same.add(place_id)
    return same
