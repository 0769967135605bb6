"""Maps damaged in every way, and what becomes of a flight, of the commands and of a repair with each."""

import contextlib
import io
import os
import shutil
import sqlite3
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
from base import Row

from edgevpr.cli.main import main
from edgevpr.core.config import Config, load_config
from edgevpr.core.errors import EdgevprError
from edgevpr.core.types import Frame, Position
from edgevpr.mapmaking.mapping import build_map
from edgevpr.places.geopackage import point_blob
from edgevpr.places.mapfile import PlaceMap
from edgevpr.power.boards import load_board
from edgevpr.runtime.recognise.opening import meter_of, open_learning, open_recogniser
from edgevpr.runtime.recognise.recogniser import Recogniser
from edgevpr.techniques import create

_PLACES = 12
_ASKED = (0, 5, 11)  # numbers of the pictures that each map is asked for
_PAGE = 4096
_ODD = (None, b"", b"\xff", "text", "\0", 10**18, -1.5, float("inf"), b"\xa5" * 40_000)
_COLUMNS = ("geom", "time", "alt_m", "heading_deg", "source_image", "quality", "coarse", "fine")
_ODD_JSON = ("", "null", "7", "[1]", "{}", '{"shape": [1e9], "dtype": "O"}', '{"w1": 1e999}', "[" * 5000, '"\\ud800"')
_SCHEMA = (
    "DROP TABLE places",
    "ALTER TABLE places RENAME TO gone",
    "ALTER TABLE places RENAME COLUMN fine TO fein",
    "DROP TABLE edgevpr_map",
    "DELETE FROM edgevpr_map",
    "DELETE FROM gpkg_contents",
    "UPDATE gpkg_contents SET min_x = NULL, max_y = 'north'",
    "UPDATE gpkg_geometry_columns SET srs_id = 3857",
    "ALTER TABLE places RENAME TO old; CREATE VIEW places AS WITH RECURSIVE n(place_id) AS "
    "(SELECT 1 UNION ALL SELECT place_id + 1 FROM n) SELECT n.place_id, geom, time, alt_m, heading_deg, source_image, "
    "quality, geom_crc32, coarse_crc32, fine_crc32, coarse, fine FROM n, old",
)
# What an owner may do to a map before a flight, and nobody in one.
IN_FLIGHT_ONLY = ("another map", "moved by a program")

Rng = np.random.Generator


def _bits(path: Path, rng: Rng, first: int = 0, end: int | None = None, most: int = 64) -> None:
    data = bytearray(path.read_bytes())
    for at in rng.integers(first, end or len(data), rng.integers(1, most + 1)):
        data[at] ^= 1 << int(rng.integers(8))
    path.write_bytes(data)


def _pages(path: Path, rng: Rng) -> None:
    data = bytearray(path.read_bytes())
    for page in rng.integers(0, len(data) // _PAGE, rng.integers(1, 6)):
        start = int(page) * _PAGE
        other = int(rng.integers(0, len(data) // _PAGE)) * _PAGE
        data[start : start + _PAGE] = (rng.bytes(_PAGE), bytes(_PAGE), data[other : other + _PAGE])[rng.integers(3)]
    path.write_bytes(data)


def _position(path: Path, rng: Rng) -> None:
    """Flip bits of positions in the file, which no trigger sees."""
    data = bytearray(path.read_bytes())
    number = int(rng.integers(_PLACES))
    at = data.find(point_blob(*_where(number)))
    while at >= 0:  # also where SQLite has left an old copy of the page
        data[at + 13 + int(rng.integers(16))] ^= 1 << int(rng.integers(8))
        at = data.find(point_blob(*_where(number)), at + 1)
    path.write_bytes(data)


def _written(path: Path, *statements: tuple[str, tuple]) -> None:
    with contextlib.closing(sqlite3.connect(path)) as db, db:
        for statement, values in statements:
            with contextlib.suppress(sqlite3.IntegrityError):
                db.execute(statement, values) if values else db.executescript(statement)


def _values(path: Path, rng: Rng) -> None:
    places = [int(each) for each in rng.integers(1, _PLACES + 1, rng.integers(1, _PLACES))]
    changes = [(_COLUMNS[rng.integers(len(_COLUMNS))], _ODD[rng.integers(len(_ODD))], place) for place in places]
    _written(path, *((f"UPDATE places SET {c} = ? WHERE place_id = ?", (value, place)) for c, value, place in changes))


def _swapped(path: Path, rng: Rng) -> None:
    one, other = (int(each) + 1 for each in rng.choice(_PLACES, 2, replace=False))
    column = ("fine", "coarse", "fine_crc32")[rng.integers(3)]
    taken = f"SELECT {column} FROM places WHERE place_id = ?"
    _written(path, (f"UPDATE places SET {column} = ({taken}) WHERE place_id = ?", (one, other)))


def _rows(path: Path, rng: Rng) -> None:
    what = ("DELETE FROM places WHERE place_id % ? = 0", "UPDATE places SET place_id = place_id + 100 * ?")
    _written(path, (what[rng.integers(2)], (int(rng.integers(1, 5)),)))


def _spec(path: Path, rng: Rng) -> None:
    keys = ("format_version", "map_id", "technique", "parameters", "model_sha256", "coarse", "fine", "packed")
    change = (_ODD_JSON[rng.integers(len(_ODD_JSON))], keys[rng.integers(len(keys))])
    _written(path, ("UPDATE edgevpr_map SET value = ? WHERE key = ?", change))


def _another(path: Path, rng: Rng) -> None:
    for place in range(1, _PLACES + 1):
        _moved_to(path, place, 51 + rng.random())
    if rng.random() < 0.5:
        _written(path, ("UPDATE edgevpr_map SET value = ? WHERE key = 'map_id'", (f'"{rng.bytes(4).hex()}"',)))


def _moved_to(path: Path, place: int, lat_deg: float) -> None:
    _written(path, ("UPDATE places SET geom = ? WHERE place_id = ?", (point_blob(lat_deg, 9.0), place)))


KINDS: dict[str, Callable[[Path, Rng], None]] = {
    "bits flipped": _bits,
    "bits of the header flipped": lambda path, rng: _bits(path, rng, 0, 100, most=3),
    "pages overwritten": _pages,
    "cut": lambda path, rng: os.truncate(path, int(rng.random() * path.stat().st_size)),
    "bits of a position flipped": _position,
    "values of a wrong type": _values,
    "parts of places exchanged": _swapped,
    "rows gone or renumbered": _rows,
    "description damaged": _spec,
    "tables changed": lambda path, rng: _written(path, (_SCHEMA[rng.integers(len(_SCHEMA))], ())),
    "another map": _another,
    "moved by a program": lambda path, rng: _moved_to(path, int(rng.integers(1, _PLACES + 1)), 51.0),
}


def damaged_maps(folder: Path, whole_map: Path, count: int, seed: int) -> Iterator[tuple[str, Path]]:
    """Write `count` damaged copies of a map into the folder, one after the other; yield the kind of damage and the path
    of each. The kinds take turns."""
    for number in range(count):
        kind = list(KINDS)[number % len(KINDS)]
        path = folder / f"{number:05d}.gpkg"
        shutil.copyfile(whole_map, path)
        KINDS[kind](path, np.random.default_rng((seed, number)))
        yield kind, path


def run(count: int, seed: int) -> list[Row]:
    """Try `count` damaged maps, at take-off, in flight, with the commands and with a repair; return a row a kind: how
    many commands or flights ended with a traceback, queries that accepted another position than the whole map has, and
    places that could be read, but were lost by a repair."""
    found: dict[str, list[tuple[int, int, int]]] = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        whole = make_whole_map(folder / "whole.gpkg")
        for kind, path in damaged_maps(folder, whole, count, seed):
            with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
                found.setdefault(kind, []).append(_tried(kind, path, whole))
            for each in folder.glob(path.name + "*"):
                each.unlink()
    names = ("tracebacks", "wrong_positions", "places_lost")
    return [
        {"kind": kind, "tried": len(each), **dict(zip(names, map(sum, zip(*each, strict=True)), strict=True))}
        for kind, each in found.items()
    ]


def make_whole_map(path: Path) -> Path:
    """Make the map that is damaged: a few places of random pictures, small and quick."""
    technique = create("cohog", {"w1": 208})
    with PlaceMap.create(path, technique.spec) as place_map:
        build_map(map(_frame, range(_PLACES)), technique, place_map, meter_of(load_config(None), _BOARD))
    return path


def _where(number: int) -> tuple[float, float]:
    return 50 + number / 1000, 8.0


def _frame(number: int) -> Frame:
    noise = np.random.default_rng(number).integers(0, 256, (60, 80), np.uint8)
    image = cv2.resize(noise, (320, 240), interpolation=cv2.INTER_CUBIC)
    return Frame(image=image, name=f"{number}.png", t_mono_s=float(number), position=Position(*_where(number)))


_BOARD = load_board("this")


def _tried(kind: str, path: Path, whole: Path) -> tuple[int, int, int]:
    """Return tracebacks, wrong positions and places lost of one damaged map."""
    config, tracebacks, wrong, lost = load_config(None, {"map": str(path)}), 0, 0, 0
    damaged = path.read_bytes()
    tries: list[Callable[[], int]] = [lambda: _in_flight(config, path, whole, damaged)]
    if kind not in IN_FLIGHT_ONLY:
        tries += [lambda: _at_take_off(config), lambda: _learning(config)]
    for each in tries:
        path.write_bytes(damaged)
        try:
            wrong += each()
        except EdgevprError:
            pass
        except Exception:
            tracebacks += 1
    path.write_bytes(damaged)
    readable = _rows_of(path, whole)
    for words in (("info",), ("check",), ("check", "--json"), ("repair",)):
        try:
            main(["map", words[0], str(path), *words[1:]])
        except Exception:
            tracebacks += 1
    if path.with_name(path.name + ".damaged").exists():
        kept = _rows_of(path, whole)
        lost = len(readable - kept)
    return tracebacks, wrong, lost


def _asked(recogniser: Recogniser) -> int:
    """Ask for some pictures twice; return how many were accepted at a wrong position."""
    wrong = 0
    for number in (*_ASKED, *_ASKED):
        event = recogniser.step(_frame(number))
        here = event.position  # set for an accepted match only; a fix carries no altitude
        wrong += here is not None and (here.lat_deg, here.lon_deg) != _where(number)
        if event.reason.startswith("an unforeseen"):
            raise AssertionError(event.reason)
    return wrong


def _at_take_off(config: Config) -> int:
    recogniser = open_recogniser(config, _BOARD, narrowed=True)
    with recogniser.place_map:
        return _asked(recogniser)


def _learning(config: Config) -> int:
    recogniser, growing = open_learning(config, _BOARD, None)
    with recogniser.place_map as place_map:
        wrong = _asked(recogniser)
        frame = _frame(_PLACES)
        descriptor = recogniser.technique.encode(frame.image)
        growing.add(place_map.add(frame, descriptor), frame.position, descriptor.coarse)
    return wrong


def _in_flight(config: Config, path: Path, whole: Path, damaged: bytes) -> int:
    shutil.copyfile(whole, path)
    recogniser = open_recogniser(config, _BOARD, narrowed=True)
    with recogniser.place_map:
        if not recogniser.step(_frame(3)).accepted:
            raise AssertionError("a whole map must be recognised in")
        path.write_bytes(damaged)
        return _asked(recogniser)


def _rows_of(path: Path, whole: Path) -> set[int]:
    """Return the ids of the places that are in a map as in the whole one, read one by one with plain SQLite."""
    columns = ", ".join((*_COLUMNS, "geom_crc32", "coarse_crc32", "fine_crc32"))
    same = set()
    with contextlib.closing(sqlite3.connect(path)) as db, contextlib.closing(sqlite3.connect(whole)) as right:
        db.set_progress_handler(lambda: 1, 1_000_000)  # a view need not end
        for place_id in range(1, _PLACES + 1):
            asked = f"SELECT {columns} FROM places WHERE place_id = {place_id}"
            with contextlib.suppress(sqlite3.Error, UnicodeDecodeError):
                if db.execute(asked).fetchone() == right.execute(asked).fetchone():
                    same.add(place_id)
    return same
