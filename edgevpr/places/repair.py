"""Check of a whole map, and its repair: a copy of all that can be read takes the place of a damaged file."""

import os
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import TypeVar

from edgevpr.core.errors import MapError
from edgevpr.places import mapfiles
from edgevpr.places.examine import Examined, examine, faults
from edgevpr.places.mapfile import PlaceMap
from edgevpr.places.sqlite import sentences

T = TypeVar("T")
Watch = Callable[[Iterable[T], int], Iterable[T]]

_AT_ONCE = 100  # places in a transaction of a copy


@dataclass(frozen=True, slots=True, kw_only=True)
class MapCheck:
    """State of a map: `places` can be read, `damaged` cannot (number and what is wrong, in a few words). `faults` are
    what SQLite finds wrong with the file as a whole. `without_checksums` of the readable places lack some, so that
    damage of those cannot be seen: maps of the first format, and rows that other programs wrote."""

    path: str
    places: int
    damaged: tuple[tuple[int, str], ...]
    faults: tuple[str, ...]
    without_checksums: int

    @property
    def is_whole(self) -> bool:
        return not (self.damaged or self.faults)


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
        said = faults(place_map)
    return MapCheck(
        path=str(path), places=places, damaged=tuple(damaged), faults=tuple(said), without_checksums=without
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
