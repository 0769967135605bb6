"""Operations on a whole map, for `edgevpr map`: check, repair, merge with another map, copy the best places."""

import os
import sqlite3
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np

from edgevpr.core.errors import MapError, PlaceError
from edgevpr.core.types import Place, Position
from edgevpr.places import mapfiles, rows
from edgevpr.places.mapfile import PlaceMap
from edgevpr.places.rows import Content, Unreadable
from edgevpr.places.thin import best_places

T = TypeVar("T")
Watch = Callable[[Iterable[T], int], Iterable[T]]  # takes items and their number, yields the same items, shows progress

_MOST_FAULTS = 20  # most faults of a file that SQLite lists
_EMPTY_BYTES = 45_056  # size of a map file without places
_LOW = 0.5  # factor on the value of a place that was added only because there would have been too wide a gap


@dataclass(frozen=True, slots=True)
class Examined:
    """The result of checking one place. `problem` says in a few words what is damaged (None: nothing). `content` has
    the values of its row by column name; it is empty if they cannot be read."""

    place_id: int
    problem: str | None
    content: Content

    @property
    def has_checksums(self) -> bool:
        """True if no value of the row lacks its checksum."""
        content, values = self.content, {"pose": "up_deg"}
        names = ("geom", "coarse", "fine", "landmarks", "pose")
        return all(content[values.get(name, name)] is None or content[f"{name}_crc32"] is not None for name in names)


@dataclass(frozen=True, slots=True, kw_only=True)
class MapCheck:
    """The result of checking a map. `places` is the number of readable places. `damaged` has (place id, problem in few
    words) of each other place. `faults` are SQLite's messages about the file as a whole. `without_checksums` is the
    number of readable places that lack a checksum, because another program wrote them: damage to them would not be
    detected."""

    path: str
    places: int
    damaged: tuple[tuple[int, str], ...]
    faults: tuple[str, ...]
    without_checksums: int

    @property
    def is_whole(self) -> bool:
        return not (self.damaged or self.faults)


def examine(place_map: PlaceMap) -> Iterator[Examined]:
    """Read and check all values of every place, and yield the results in the order the places were added."""
    spec = place_map.spec
    for place_id, row in place_map.scan(rows.ALL):
        content: Content = {} if row is None else rows.content_of(rows.ALL, row)
        problem = "SQLite cannot read its row" if row is None else None
        try:
            if content:
                rows.place_of(place_id, content)
                rows.part_of(content, "coarse", spec.coarse)
                rows.landmarks_of(content)
                if spec.fine:
                    rows.part_of(content, "fine", spec.fine)
        except Unreadable as error:
            problem = str(error)
        yield Examined(place_id, problem, content)


def absorb(place_map: PlaceMap, other: PlaceMap) -> tuple[int, int]:
    """Copy all places of `other` into `place_map` in one transaction; return (copied, already there) as numbers.

    A place is already there if image name and time are equal and the coarse parts nearly so (`PlaceMap.is_of`). Raises
    MapError if the techniques differ or a file cannot be read or written, and PlaceError if a place is damaged.
    """
    place_map.require(other.spec)
    copied = already_here = 0
    with place_map.transaction():
        here = place_map.ids_by("source_image, time")
        for each in examine(other):
            if each.problem:
                raise PlaceError(other.path, each.place_id, each.problem)
            part = rows.part_of(each.content, "coarse", other.spec.coarse)
            alike = here.get((each.content["source_image"], each.content["time"]), ())
            if any(place_map.is_of(place_id, part) for place_id in alike):
                already_here += 1
            else:
                place_map.insert(each.content)
                copied += 1
    return copied, already_here


def check(path: str | Path, watch: Watch[Examined]) -> MapCheck:
    """Read and check everything in the map file `path`. `watch` wraps the iteration over its places, to show progress.
    Raises MapError for a file that cannot be opened as a map at all."""
    places = without = 0
    damaged = []
    with PlaceMap.open(path) as place_map:
        for each in watch(examine(place_map), len(place_map)):
            if each.problem:
                damaged.append((each.place_id, each.problem))
            else:
                places += 1
                without += not each.has_checksums
        try:
            found = [str(text) for (text,) in place_map.db.execute(f"PRAGMA integrity_check({_MOST_FAULTS})")]
        except (sqlite3.Error, UnicodeDecodeError) as error:
            found = [str(error)]
    faults = () if found == ["ok"] else tuple(found)
    return MapCheck(path=str(path), places=places, damaged=tuple(damaged), faults=faults, without_checksums=without)


def repair(path: str | Path, watch: Watch[Examined]) -> Path:
    """Replace the map by a copy of its undamaged places; keep the original as `*.damaged` and return its path.

    The places keep their ids, and all get checksums. Mask hash and calibration are copied if they can be read. Raises
    MapError if no place can be read, if the original of an earlier repair exists, or if the copy cannot be written. The
    map is then unchanged. `watch` shows progress.
    """
    path = mapfiles.existing(path)
    original = path.with_name(path.name + ".damaged")
    if original.exists():
        raise MapError(f"{original} is there already, from an earlier repair: move it away first.")
    copy = path.with_name(f".{path.name}.{os.getpid()}")
    lock = mapfiles.lock(path)  # meanwhile no program can add places, which the copy would lack
    try:
        with PlaceMap.open(path) as damaged:
            if not _copy(damaged, copy, watch(examine(damaged), len(damaged))):
                raise MapError(f"{path}: no place of it can be read: restore a copy, or build it again.")
        for left, kept in zip(mapfiles.beside(path), mapfiles.beside(original), strict=True):
            if left.exists():  # else SQLite would apply the log of the damaged map to the copy
                left.rename(kept)
        try:
            os.link(path, original)  # a link first, so that there is a map at `path` at every moment
        except OSError:
            path.rename(original)  # a FAT file system has no links
        copy.replace(path)
        os.sync()
    finally:
        mapfiles.remove(copy)
        os.close(lock)
    return original


def places_in(file_bytes: int, place_map: PlaceMap) -> int:
    """Return how many places of a map fit into a file of `file_bytes`, at most all; computed from the mean size that a
    place takes in the map's file."""
    places = len(place_map)
    each = (place_map.path.stat().st_size - _EMPTY_BYTES) / max(places, 1)
    return places if each <= 0 else min(places, max(0, int((file_bytes - _EMPTY_BYTES) / each)))


def shrink(path: str | Path, out: Path, count: int) -> tuple[int, int]:
    """Copy the `count` best places of a map to the new file `out`: those of high quality that leave small gaps (see
    `thin`). Returns (number of places copied, number of readable places of the map).

    The places keep their ids. Mask hash and calibration are copied; the calibration refers to places by id. Places that
    cannot be read are not copied. Raises MapError if the map cannot be read, or if `out` exists or cannot be written;
    no part of a file is then left.
    """
    with mapfiles.whole_or_none(out) as unfinished, PlaceMap.open(path) as place_map:
        whole = [each.place_id for each in examine(place_map) if not each.problem]
        places = list(place_map.places(whole))
        points = [place.position or Position(np.nan, np.nan) for place in places]
        lat_deg, lon_deg = np.array([(point.lat_deg, point.lon_deg) for point in points], float).reshape(-1, 2).T
        best = best_places(lat_deg, lon_deg, np.array([_worth_of(place) for place in places]), count)
        kept = {whole[number] for number in best.tolist()}
        _copy(place_map, unfinished, (each for each in examine(place_map) if each.place_id in kept))
    return len(kept), len(whole)


def _worth_of(place: Place) -> float:
    """Return the value of keeping a place, 0..1: quality, times memorability and staticity as far as known."""
    salience = place.salience
    if salience is None:
        return place.quality
    scores = [score for score in (salience.memorability, salience.staticity) if score is not None]
    return place.quality * float(np.prod(scores)) * (_LOW if salience.is_low else 1.0)


def _copy(place_map: PlaceMap, out: Path, places: Iterable[Examined]) -> int:
    """Make the map `out` from the undamaged ones of `places`, with the same ids, mask hash and calibration; return how
    many places it has."""
    copied = 0
    with PlaceMap.create(out, place_map.spec) as copy:
        copy.record_mask(place_map.mask_sha256)
        copy.record_calibration(place_map.calibration)
        with copy.transaction():
            for each in places:
                if not each.problem:
                    copy.insert(each.content, each.place_id)
                    copied += 1
    return copied
