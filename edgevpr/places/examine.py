"""Operations on whole maps, for `edgevpr map`: check, repair, merge, copy the best places."""

import os
import sqlite3
from collections.abc import Collection, Iterable, Iterator, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from edgevpr.core.errors import MapError, PlaceError
from edgevpr.core.text import Progress, iterate_silently
from edgevpr.core.types import Place, Position
from edgevpr.places import mapfiles, rows
from edgevpr.places.index import choose_places
from edgevpr.places.mapfile import PlaceMap

_MAX_FAULTS = 20  # to be listed by SQLite
_NO_LANDMARKS: rows.Content = {"landmarks": None, "landmarks_crc32": None}
_LOW_QUALITY_FACTOR = 0.5  # applied to the value of a place that was added only to close a gap


class PlaceCheck(NamedTuple):
    """Result of checking one place. `problem`: the damage in a few words (None: none). `content`: the values of its row
    by column name, without damaged landmarks (empty: unreadable). `is_usable`: nothing but its landmarks is damaged."""

    place_id: int
    problem: str | None
    content: rows.Content
    is_usable: bool


@dataclass(frozen=True, slots=True)
class MapCheck:
    """The result of checking a map. `places` of `total` places are readable. `damaged` has (place id, short problem) of
    each damaged place; one whose landmarks alone are damaged is still readable. `faults` are SQLite's messages about
    the file as a whole."""

    path: str
    places: int
    total: int
    damaged: tuple[tuple[int, str], ...]
    faults: tuple[str, ...]

    @property
    def is_intact(self) -> bool:
        return not (self.damaged or self.faults)


def check_places(place_map: PlaceMap, only: Collection[int] | None = None) -> Iterator[PlaceCheck]:
    """Read and check all values of every place, or of those with the ids `only`, in the order of the map."""
    spec = place_map.spec
    unscanned = ((place_id, None) for place_id in sorted(only or ()))
    for place_id, row in place_map.scan_rows(rows.ALL_COLUMNS) if only is None else unscanned:
        if row is None:  # not scanned, or the scan could not read it
            content, problem = _read_content(place_map, place_id)
        else:
            content, problem = rows.read_columns(rows.ALL_COLUMNS, row), None
        is_usable = False
        try:
            if content:
                rows.parse_place(place_id, content)
                rows.decode_part(content, "coarse", spec.coarse)
                if spec.fine:
                    rows.decode_part(content, "fine", spec.fine)
                is_usable = True
                rows.read_landmarks(content)
        except rows.RowError as error:
            problem = str(error)
            content = {**content, **_NO_LANDMARKS}
        yield PlaceCheck(place_id, problem, content, is_usable)


def _read_content(place_map: PlaceMap, place_id: int) -> tuple[rows.Content, str | None]:
    """Return the row of a place, without landmarks that cannot be read, and the problem (None: none). The row is empty
    if the rest cannot be read either."""
    with suppress(PlaceError):
        return place_map.read_row(place_id, rows.ALL_COLUMNS), None
    with suppress(PlaceError):
        content = place_map.read_row(place_id, rows.COLUMNS_WITHOUT_LANDMARKS)
        return {**content, **_NO_LANDMARKS}, "SQLite cannot read its landmarks"
    return {}, "SQLite cannot read its row"


def merge_maps(
    paths: Sequence[str | Path],
    out: Path,
    progress: Progress = iterate_silently,
    only: Sequence[Collection[int] | None] | None = None,
) -> tuple[list[tuple[int, int]], bool]:
    """Merge the places of several maps into the new map `out`; if that fails, leave no file. `only`: for each map, the
    ids of the places to merge (None: all). Returns (places copied, duplicates) for each map, and True if any map was
    calibrated; `out` never is.

    A place is a duplicate if its image name and time are equal and its coarse part nearly equal to those of another
    (`PlaceMap.has_descriptor`). Mask hash and lens are copied if the same in all maps, attributions always. Raises
    MapError if the techniques differ or a file cannot be read or written, and PlaceError if a place is damaged."""
    with ExitStack() as stack:
        temp_path = stack.enter_context(mapfiles.write_atomically(out))
        maps = [stack.enter_context(PlaceMap.open(path)) for path in paths]
        for other in maps[1:]:
            other.require_technique(maps[0].spec)
        masks, lenses = {source.mask_sha256 for source in maps}, {source.lens for source in maps}
        with PlaceMap.create(temp_path, maps[0].spec) as target:
            if len(masks) == 1:
                target.record_mask(*masks)
            if len(lenses) == 1:
                target.record_lens(*lenses)
            for source in maps:
                target.add_attribution(source.attribution)
            counts = [
                _add_places(target, source, progress, place_ids)
                for source, place_ids in zip(maps, only or [None] * len(maps), strict=True)
            ]
            return counts, any(source.calibration is not None for source in maps)


def _add_places(
    place_map: PlaceMap, source: PlaceMap, progress: Progress, only: Collection[int] | None
) -> tuple[int, int]:
    """Copy the places `only` (None: all) of `source` into `place_map`; return the numbers of copies and duplicates."""
    copied = duplicates = 0
    with place_map.transaction():
        ids_by_picture = place_map.select_ids("source_image, time")
        total = len(source) if only is None else len(only)
        for place in progress(check_places(source, only), total, f"copying {source.path.name}"):
            if place.problem:
                raise PlaceError(source.path, place.place_id, place.problem)
            part = rows.decode_part(place.content, "coarse", source.spec.coarse)
            same_picture = ids_by_picture.get((place.content["source_image"], place.content["time"]), ())
            if any(place_map.has_descriptor(place_id, part) for place_id in same_picture):
                duplicates += 1
            else:
                place_map.insert(place.content)
                copied += 1
    return copied, duplicates


def check_map(path: str | Path, progress: Progress = iterate_silently) -> MapCheck:
    """Read and check everything in the map file `path`. Raises MapError for a file that cannot be opened as a map."""
    with PlaceMap.open(path) as place_map:
        checks = progress(check_places(place_map), len(place_map), "checking")
        places = [place._replace(content={}) for place in checks]
        try:
            faults = [str(text) for (text,) in place_map.db.execute(f"PRAGMA integrity_check({_MAX_FAULTS})")]
        except (sqlite3.Error, UnicodeDecodeError) as error:
            faults = [str(error)]
    damaged = tuple((place.place_id, place.problem) for place in places if place.problem)
    usable = sum(place.is_usable for place in places)
    return MapCheck(str(path), usable, len(places), damaged, () if faults == ["ok"] else tuple(faults))


def repair_map(path: str | Path, progress: Progress = iterate_silently) -> Path:
    """Replace the map by a copy of its usable places, which keep their ids and get checksums; keep the original as
    `*.damaged` and return its path. Mask hash and calibration are copied if readable. Raises MapError and leaves the
    map unchanged if no place can be read, if an earlier original exists, or if the copy cannot be written."""
    path = mapfiles.require_map_file(path)
    original = path.with_name(path.name + ".damaged")
    if original.exists():
        raise MapError(f"{original} exists already, from an earlier repair: move that file away first.")
    copy = path.with_name(f".{path.name}.{os.getpid()}")
    lock = mapfiles.lock_map(path)  # until the end, so that no program adds places that the copy would lack
    try:
        with PlaceMap.open(path) as damaged:
            if not _copy_usable(damaged, copy, progress(check_places(damaged), len(damaged), "copying")):
                raise MapError(f"{path}: none of its places can be read: restore a copy, or build it again.")
        for file, backup in zip(mapfiles.list_sqlite_files(path), mapfiles.list_sqlite_files(original), strict=True):
            if file.exists():  # otherwise SQLite would apply the log of the damaged map to the copy
                file.rename(backup)
        try:
            os.link(path, original)  # a link first, so that `path` is a map at all times
        except OSError:
            path.rename(original)  # a FAT file system has no links
        copy.replace(path)
        os.sync()
    finally:
        mapfiles.remove_map(copy)
        os.close(lock)
    return original


def copy_places(path: str | Path, out: Path, place_ids: Collection[int]) -> int:
    """Copy places of a map to the new file `out`, as `shrink_map` does; return their number."""
    with mapfiles.write_atomically(out) as temp_path, PlaceMap.open(path) as place_map:
        return _copy_usable(place_map, temp_path, check_places(place_map, place_ids))


def shrink_map(path: str | Path, out: Path, count: int, progress: Progress = iterate_silently) -> int:
    """Copy the `count` best readable places of a map to the new file `out`: those of high quality that leave small gaps
    (see `choose_places`); return their number. They keep their ids, since the calibration, which is copied like the
    mask hash, refers to them. Raises MapError, and leaves no partial file, if the map cannot be read, or if `out`
    exists or cannot be written."""
    with mapfiles.write_atomically(out) as temp_path, PlaceMap.open(path) as place_map:
        checks = progress(check_places(place_map), len(place_map), "reading")
        places = [rows.parse_place(check.place_id, check.content) for check in checks if check.is_usable]
        points = [place.position or Position(np.nan, np.nan) for place in places]
        lat_deg, lon_deg = np.array([(point.lat_deg, point.lon_deg) for point in points], float).reshape(-1, 2).T
        best = choose_places(lat_deg, lon_deg, np.array([_rate_place(place) for place in places]), count)
        place_ids = [places[row].place_id for row in best.tolist()]
        checks = progress(check_places(place_map, place_ids), len(place_ids), "copying")
        return _copy_usable(place_map, temp_path, checks)


def _rate_place(place: Place) -> float:
    """Return the value of a place, 0..1: its quality, times memorability and staticity if known."""
    salience = place.salience
    if salience is None:
        return place.quality
    scores = [score for score in (salience.memorability, salience.staticity) if score is not None]
    return place.quality * float(np.prod(scores)) * (_LOW_QUALITY_FACTOR if salience.is_low else 1.0)


def _copy_usable(place_map: PlaceMap, out: Path, places: Iterable[PlaceCheck]) -> int:
    """Create the map `out` from the usable `places`, with the same ids, mask hash, lens, attribution and calibration;
    return the number of its places."""
    copied = 0
    with PlaceMap.create(out, place_map.spec) as copy:
        copy.record_mask(place_map.mask_sha256)
        copy.record_lens(place_map.lens)
        copy.add_attribution(place_map.attribution)
        copy.record_calibration(place_map.calibration)
        with copy.transaction():
            for place in places:
                if place.is_usable:
                    copy.insert(place.content, place.place_id)
                    copied += 1
    return copied
