"""A whole map, row by row: its check, its repair, its merging with another, and a smaller copy of it."""

import os
import sqlite3
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import TypeVar

import numpy as np

from edgevpr.core.arrays import Ints
from edgevpr.core.errors import MapError, PlaceError
from edgevpr.core.types import Place
from edgevpr.places import mapfiles, rows
from edgevpr.places.mapfile import PlaceMap
from edgevpr.places.rows import Content, Unreadable
from edgevpr.places.sqlite import sentences
from edgevpr.places.thin import best_places

T = TypeVar("T")
Watch = Callable[[Iterable[T], int], Iterable[T]]  # passes a number of things through, and shows progress

_MOST_FAULTS = 20  # of the file, that SQLite lists
_AT_ONCE = 100  # places in a transaction of a copy
_EMPTY_BYTES = 45_056  # of a map without places
_LOW = 0.5  # of its worth is left to a place that was kept only to bound a gap


@dataclass(frozen=True, slots=True)
class Examined:
    """One place of a map: `problem` says in a few words what is damaged (None: nothing), `content` is its row, and
    `has_checksums` tells whether all that should have one does."""

    place_id: int
    problem: str | None
    content: Content
    has_checksums: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class MapCheck:
    """State of a map: `places` can be read, `damaged` cannot (number and what is wrong, in a few words). `faults` are
    what SQLite finds wrong with the file as a whole. `without_checksums` of the readable places lack some, so that
    damage of those cannot be seen: rows that other programs wrote."""

    path: str
    places: int
    damaged: tuple[tuple[int, str], ...]
    faults: tuple[str, ...]
    without_checksums: int

    @property
    def is_whole(self) -> bool:
        return not (self.damaged or self.faults)


def examine(place_map: PlaceMap) -> Iterator[Examined]:
    """Read everything of every place, in the order they were added."""
    spec = place_map.spec
    for place_id, row in place_map.scan(rows.ALL):
        if row is None:
            yield Examined(place_id, "SQLite cannot read its row", {}, False)
            continue
        content = rows.content_of(rows.ALL, row)
        held = {name: content[name] for name in ("geom", "coarse", "fine", "landmarks")} | {"pose": content["up_deg"]}
        has_checksums = all(part is None or content[f"{name}_crc32"] is not None for name, part in held.items())
        problem = None
        try:
            rows.place_of(place_id, content)
            rows.part_of(content["coarse"], spec.coarse, content["coarse_crc32"], "coarse part")
            if spec.fine:
                rows.part_of(content["fine"], spec.fine, content["fine_crc32"], "fine part")
            rows.landmarks_of(content["landmarks"], content["landmarks_crc32"])
        except Unreadable as error:
            problem = str(error)
        yield Examined(place_id, problem, content, has_checksums)


def absorb(place_map: PlaceMap, other: PlaceMap) -> tuple[int, int]:
    """Copy every place of another map of the same technique, all or none; return (copied, already here).

    A place is already here when image name and time are the same, and the coarse part nearly (`PlaceMap.is_of`). Raises
    MapError as `PlaceMap.require` does and where a file cannot be read or written, and PlaceError for a damaged place.
    """
    place_map.require(other.spec)
    copied = already_here = 0
    with sentences(place_map.path), place_map.transaction():
        here = place_map.ids_by("source_image, time")
        for each in examine(other):
            if each.problem:
                raise PlaceError(other.path, each.place_id, each.problem)
            part = rows.part_of(each.content["coarse"], other.spec.coarse, None, "coarse part")
            alike = here.get((each.content["source_image"], each.content["time"]), ())
            if any(place_map.is_of(place_id, part) for place_id in alike):
                already_here += 1
                continue
            place_map.insert(each.content)
            copied += 1
    return copied, already_here


def check(path: str | Path, watch: Watch[Examined]) -> MapCheck:
    """Read everything in a map; `watch` passes the places through and shows progress. Raises MapError for a file that
    cannot be opened as a map at all."""
    places = without = 0
    damaged = []
    with PlaceMap.open(path) as place_map:
        for each in watch(examine(place_map), len(place_map)):
            if each.problem:
                damaged.append((each.place_id, each.problem))
            else:
                places += 1
                without += not each.has_checksums
        faults = _faults(place_map)
    return MapCheck(
        path=str(path), places=places, damaged=tuple(damaged), faults=tuple(faults), without_checksums=without
    )


def repair(path: str | Path, watch: Watch[Examined]) -> Path:
    """Put a copy of all whole places in the place of a map, and return the path of the original, which is kept.

    The places keep their numbers, and all get checksums. Mask and calibration are kept where they can be read. Raises
    MapError where no place can be read, where the file of an earlier repair is there, and where the copy cannot be
    written: the map is then as it was.
    """
    path = mapfiles.existing(path)
    original = path.with_name(path.name + ".damaged")
    if original.exists():
        raise MapError(f"{original} is there already, from an earlier repair: move it away first.")
    copy = path.with_name(f".{path.name}.{os.getpid()}")
    lock = mapfiles.lock(path)  # nobody adds places that the copy would lack
    try:
        with PlaceMap.open(path) as damaged, PlaceMap.create(copy, damaged.spec) as repaired:
            whole = (each for each in watch(examine(damaged), len(damaged)) if not each.problem)
            with sentences(copy):
                while block := list(islice(whole, _AT_ONCE)):
                    with repaired.transaction():
                        for each in block:
                            repaired.insert(each.content, each.place_id)
            repaired.record_mask(damaged.mask_sha256)
            repaired.record_calibration(damaged.calibration)
            if not len(repaired):
                raise MapError(f"{path}: no place of it can be read: restore a copy, or build it again.")
        _exchange(path, copy, original)
    finally:
        mapfiles.remove(copy)
        os.close(lock)
    return original


def places_in(file_bytes: int, place_map: PlaceMap) -> int:
    """Return how many places like those of a map a file of this size holds."""
    places = len(place_map)
    each = (place_map.path.stat().st_size - _EMPTY_BYTES) / max(places, 1)
    return places if each <= 0 else min(places, max(0, int((file_bytes - _EMPTY_BYTES) / each)))


def worth_of(place: Place) -> float:
    """Return what a place is worth, 0..1: its quality, times its memorability and staticity where they are known."""
    salience = place.salience
    if salience is None:
        return place.quality
    scores = [score for score in (salience.memorability, salience.staticity) if score is not None]
    return place.quality * float(np.prod(scores)) * (_LOW if salience.is_low else 1.0)


def shrink(path: str | Path, out: Path, count: int) -> tuple[int, int]:
    """Copy the `count` best places of a map to a new one, all or none; return how many were kept, of how many.

    The places keep their numbers, and the map its calibration, which knows places by number. A place that cannot be
    read is left behind. Raises MapError for a map that cannot be read, or an `out` that is there already or cannot be
    written.
    """
    with mapfiles.whole_or_none(out) as unfinished, PlaceMap.open(path) as place_map:
        whole = [each.place_id for each in examine(place_map) if not each.problem]
        places = list(place_map.places(whole))
        kept = {whole[number] for number in chosen(places, count)}
        with PlaceMap.create(unfinished, place_map.spec) as smaller:
            smaller.record_mask(place_map.mask_sha256)
            smaller.record_calibration(place_map.calibration)
            with sentences(unfinished), smaller.transaction():
                for each in examine(place_map):
                    if each.place_id in kept:
                        smaller.insert(each.content, each.place_id)
    return len(kept), len(whole)


def chosen(places: list[Place], count: int) -> Ints:
    """Choose `count` of the places by worth and coverage; return their numbers in the list, ascending."""
    points = [
        (place.position.lat_deg, place.position.lon_deg) if place.position else (np.nan, np.nan) for place in places
    ]
    lat_deg, lon_deg = np.array(points, float).reshape(-1, 2).T
    return best_places(lat_deg, lon_deg, np.array([worth_of(place) for place in places]), count)


def _exchange(path: Path, copy: Path, original: Path) -> None:
    """Rename the map to `original`, with what SQLite has beside it, and the copy to the map."""
    for left, kept in zip(mapfiles.beside(path), mapfiles.beside(original), strict=True):
        if left.exists():  # the log of the damaged map must not be taken for one of the copy
            left.rename(kept)
    try:
        os.link(path, original)  # so that there is a map under its name at every moment
    except OSError:
        path.rename(original)  # FAT has no links
    copy.replace(path)
    with suppress(OSError):
        folder = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)


def _faults(place_map: PlaceMap) -> list[str]:
    """Return what SQLite finds wrong with the file as a whole, a sentence each; empty for a sound one."""
    try:
        found = [str(text) for (text,) in place_map.db.execute(f"PRAGMA integrity_check({_MOST_FAULTS})")]
    except (sqlite3.Error, UnicodeDecodeError) as error:
        found = [str(error)]
    return [] if found == ["ok"] else found
