"""Operations on whole maps, for `edgevpr map`: check, repair, merge, copy the best places."""

import os
import sqlite3
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from edgevpr.core.arrays import Doubles, Ints
from edgevpr.core.errors import MapError, PlaceError
from edgevpr.core.types import Place, Position
from edgevpr.places import mapfiles, rows
from edgevpr.places.index import best_places
from edgevpr.places.mapfile import PlaceMap
from edgevpr.places.rows import Content, Unreadable, Values

_MAX_FAULTS = 20  # most faults of a file that SQLite lists
_NO_LANDMARKS: Content = {"landmarks": None, "landmarks_crc32": None}
_LOW = 0.5  # factor on the value of a place that was added only because there would have been too wide a gap


class Examined(NamedTuple):
    """The result of checking one place. `problem` says in a few words what is damaged (None: nothing). `content` has
    the values of its row by column name, without landmarks that are damaged; it is empty if they cannot be read.
    `is_usable`: nothing else than its landmarks is damaged."""

    place_id: int
    problem: str | None
    content: Content
    is_usable: bool


def read_place_positions(place_map: PlaceMap) -> tuple[Ints, Doubles, Doubles]:
    """Return the ids, int (N,), and the positions, float64 (N,) each, of the readable places; NaN: unknown."""
    place_ids, lat_deg, lon_deg, _ = np.array(list(place_map.outlines())).reshape(-1, 4).T
    return place_ids.astype(int), lat_deg, lon_deg


# Called with the places that are read, their number and a label; yields the places unchanged and shows the progress.
Watch = Callable[[Iterable[Examined], int, str], Iterable[Examined]]


def iterate_silently(places: Iterable[Examined], total: int, label: str) -> Iterable[Examined]:
    return places


@dataclass(frozen=True, slots=True)
class MapCheck:
    """The result of checking a map. `places` is the number of readable places, of `total`. `damaged` has (place id,
    problem in few words) of each place with damage; one of which only the landmarks are damaged can still be read.
    `faults` are SQLite's messages about the file as a whole."""

    path: str
    places: int
    total: int
    damaged: tuple[tuple[int, str], ...]
    faults: tuple[str, ...]

    @property
    def is_whole(self) -> bool:
        return not (self.damaged or self.faults)


def examine(place_map: PlaceMap, only: Collection[int] | None = None) -> Iterator[Examined]:
    """Read and check all values of every place, or of those with the ids `only`, and yield the results in the order the
    places were added."""
    spec = place_map.spec
    for place_id, row in place_map.scan(rows.ALL) if only is None else _read_rows(place_map, only):
        if row is not None:
            problem, content = None, rows.read_columns(rows.ALL, row)
        else:
            content = _read_but_landmarks(place_map, place_id)
            problem = "SQLite cannot read its landmarks" if content else "SQLite cannot read its row"
        is_usable = False
        try:
            if content:
                rows.parse_place(place_id, content)
                rows.decode_part(content, "coarse", spec.coarse)
                if spec.fine:
                    rows.decode_part(content, "fine", spec.fine)
                is_usable = True
                rows.read_landmarks(content)
        except Unreadable as error:
            problem = str(error)
            content = {**content, **_NO_LANDMARKS}
        yield Examined(place_id, problem, content, is_usable)


def _read_but_landmarks(place_map: PlaceMap, place_id: int) -> Content:
    """Return what is left of a row whose end, the landmarks, cannot be read; empty if it cannot be read either."""
    with suppress(PlaceError):
        return {**place_map.row(place_id, rows.BUT_LANDMARKS), **_NO_LANDMARKS}
    return {}


def _read_rows(place_map: PlaceMap, place_ids: Collection[int]) -> Iterator[tuple[int, Values | None]]:
    for place_id in sorted(place_ids):
        try:
            yield place_id, tuple(place_map.row(place_id, rows.ALL).values())
        except PlaceError:
            yield place_id, None


def merge(
    paths: Sequence[str | Path],
    out: Path,
    watch: Watch = iterate_silently,
    only: Sequence[Collection[int] | None] | None = None,
) -> tuple[list[tuple[int, int]], bool]:
    """Make the new map `out` of the places of several maps, or of those with the ids `only`, a collection for each map;
    if that fails, leave no file. Returns for each map (places copied, places that were there already) as numbers, and
    True if one was calibrated: `out` is not.

    A place is there already if image name and time are equal and the coarse parts nearly so (`PlaceMap.is_of`). Mask
    hash and lens are copied if all have the same; attributions are all copied. Raises MapError if the techniques differ
    or a file cannot be read or written, and PlaceError if a place is damaged."""
    with ExitStack() as stack:
        unfinished = stack.enter_context(mapfiles.whole_or_none(out))
        maps = [stack.enter_context(PlaceMap.open(path)) for path in paths]
        for other in maps[1:]:
            other.require(maps[0].spec)
        masks, lenses = {each.mask_sha256 for each in maps}, {each.lens for each in maps}
        with PlaceMap.create(unfinished, maps[0].spec) as merged:
            if len(masks) == 1:
                merged.record_mask(*masks)
            if len(lenses) == 1:
                merged.record_lens(*lenses)
            for each in maps:
                merged.add_attribution(each.attribution)
            counts = [
                _absorb(merged, other, watch, place_ids)
                for other, place_ids in zip(maps, only or [None] * len(maps), strict=True)
            ]
            return counts, any(each.calibration is not None for each in maps)


def _absorb(place_map: PlaceMap, other: PlaceMap, watch: Watch, only: Collection[int] | None) -> tuple[int, int]:
    """Copy what is new of `other`, or of its places with the ids `only`, into `place_map`; return (copied, already
    there) as numbers."""
    copied = already_here = 0
    with place_map.transaction():
        here = place_map.select_ids("source_image, time")
        total = len(other) if only is None else len(only)
        for each in watch(examine(other, only), total, f"copying {other.path.name}"):
            if each.problem:
                raise PlaceError(other.path, each.place_id, each.problem)
            part = rows.decode_part(each.content, "coarse", other.spec.coarse)
            alike = here.get((each.content["source_image"], each.content["time"]), ())
            if any(place_map.has_descriptor(place_id, part) for place_id in alike):
                already_here += 1
            else:
                place_map.insert(each.content)
                copied += 1
    return copied, already_here


def check(path: str | Path, watch: Watch = iterate_silently) -> MapCheck:
    """Read and check everything in the map file `path`. Raises MapError for a file that cannot be opened as a map."""
    with PlaceMap.open(path) as place_map:
        examined = [each._replace(content={}) for each in watch(examine(place_map), len(place_map), "checking")]
        try:
            found = [str(text) for (text,) in place_map.db.execute(f"PRAGMA integrity_check({_MAX_FAULTS})")]
        except (sqlite3.Error, UnicodeDecodeError) as error:
            found = [str(error)]
    damaged = tuple((each.place_id, each.problem) for each in examined if each.problem)
    usable = sum(each.is_usable for each in examined)
    return MapCheck(str(path), usable, len(examined), damaged, () if found == ["ok"] else tuple(found))


def repair(path: str | Path, watch: Watch = iterate_silently) -> Path:
    """Replace the map by a copy of its usable places, which keep their ids and get checksums; keep the original as
    `*.damaged` and return its path. Mask hash and calibration are copied if they can be read. Raises MapError, and
    leaves the map as it is, if no place can be read, if the original of an earlier repair exists, or if the copy cannot
    be written."""
    path = mapfiles.existing(path)
    original = path.with_name(path.name + ".damaged")
    if original.exists():
        raise MapError(f"{original} is there already, from an earlier repair: move it away first.")
    copy = path.with_name(f".{path.name}.{os.getpid()}")
    lock = mapfiles.lock(path)  # meanwhile no program can add places, which the copy would lack
    try:
        with PlaceMap.open(path) as damaged:
            if not _copy(damaged, copy, watch(examine(damaged), len(damaged), "copying")):
                raise MapError(f"{path}: no place of it can be read: restore a copy, or build it again.")
        for left, kept in zip(mapfiles.list_sqlite_files(path), mapfiles.list_sqlite_files(original), strict=True):
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


def select(path: str | Path, out: Path, place_ids: Collection[int]) -> int:
    """Copy places of a map to the new file `out`, as `shrink` does; return how many there are."""
    with mapfiles.whole_or_none(out) as unfinished, PlaceMap.open(path) as place_map:
        return _copy(place_map, unfinished, examine(place_map, place_ids))


def shrink(path: str | Path, out: Path, count: int, watch: Watch = iterate_silently) -> tuple[int, int]:
    """Copy the `count` best readable places of a map to the new file `out`: those of high quality that leave small gaps
    (see `best_places`). They keep their ids, to which the calibration, copied like the mask hash, refers. Returns
    (number of places copied, number of readable places). Raises MapError if the map cannot be read, or if `out` exists
    or cannot be written; no part of a file is then left."""
    with mapfiles.whole_or_none(out) as unfinished, PlaceMap.open(path) as place_map:
        usable = (each for each in watch(examine(place_map), len(place_map), "reading") if each.is_usable)
        places = [rows.parse_place(each.place_id, each.content) for each in usable]
        points = [place.position or Position(np.nan, np.nan) for place in places]
        lat_deg, lon_deg = np.array([(point.lat_deg, point.lon_deg) for point in points], float).reshape(-1, 2).T
        best = best_places(lat_deg, lon_deg, np.array([_rate_place(place) for place in places]), count)
        kept = [places[number].place_id for number in best.tolist()]
        return _copy(place_map, unfinished, watch(examine(place_map, kept), len(kept), "copying")), len(places)


def _rate_place(place: Place) -> float:
    """Return the value of keeping a place, 0..1: quality, times memorability and staticity as far as known."""
    salience = place.salience
    if salience is None:
        return place.quality
    scores = [score for score in (salience.memorability, salience.staticity) if score is not None]
    return place.quality * float(np.prod(scores)) * (_LOW if salience.is_low else 1.0)


def _copy(place_map: PlaceMap, out: Path, places: Iterable[Examined]) -> int:
    """Make the map `out` from the usable ones of `places`, with the same ids and the same texts beside them;
    return how many places it has."""
    copied = 0
    with PlaceMap.create(out, place_map.spec) as copy:
        copy.record_mask(place_map.mask_sha256)
        copy.record_lens(place_map.lens)
        copy.add_attribution(place_map.attribution)
        copy.record_calibration(place_map.calibration)
        with copy.transaction():
            for each in places:
                if each.is_usable:
                    copy.insert(each.content, each.place_id)
                    copied += 1
    return copied
