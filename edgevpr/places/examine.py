"""A whole map, row by row: what is damaged in it, what can be copied, and the merging of maps."""

import sqlite3
from collections.abc import Iterator
from dataclasses import dataclass

from edgevpr.errors import PlaceError
from edgevpr.places import rows
from edgevpr.places.mapfile import PlaceMap
from edgevpr.places.rows import Unreadable
from edgevpr.places.sqlite import sentences

_MOST_SAID = 20  # faults of the file that SQLite lists


@dataclass(frozen=True, slots=True)
class Examined:
    """One place of a map: `problem` says in a few words what is damaged (None: nothing), and `row` has the values,
    salience and BLOBs of one that is whole. `has_checksums` tells whether all its BLOBs have one."""

    place_id: int
    problem: str | None
    row: tuple | None
    has_checksums: bool


def examine(place_map: PlaceMap) -> Iterator[Examined]:
    """Read everything of every place, in the order they were added."""
    checksums = place_map.checksums
    for place_id, row in place_map.scan(f"{rows.VALUES}, {place_map.salience}, {rows.BLOBS}, {checksums}"):
        if row is None:
            yield Examined(place_id, "SQLite cannot read its row", None, False)
            continue
        *values, coarse, fine, geom_checksum, coarse_checksum, fine_checksum = row
        values, salience = values[: -rows.SALIENCES], values[-rows.SALIENCES :]
        has_checksums = not any(
            blob is not None and checksum is None
            for blob, checksum in ((row[0], geom_checksum), (coarse, coarse_checksum), (fine, fine_checksum))
        )
        problem, spec = None, place_map.spec
        try:
            rows.place_of(place_id, values, salience, geom_checksum)
            rows.part_of(coarse, spec.coarse, coarse_checksum, "coarse part")
            if spec.fine:
                rows.part_of(fine, spec.fine, fine_checksum, "fine part")
        except Unreadable as error:
            problem = str(error)
        yield Examined(place_id, problem, None if problem else row[:-3], has_checksums)


def faults(place_map: PlaceMap) -> list[str]:
    """Return what SQLite finds wrong with the file as a whole, a sentence each; empty for a sound one."""
    try:
        said = [str(text) for (text,) in place_map.db.execute(f"PRAGMA integrity_check({_MOST_SAID})")]
    except (sqlite3.Error, UnicodeDecodeError) as error:
        said = [str(error)]
    return [] if said == ["ok"] else said


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
            _, time, _, _, source_image, *_, coarse, _ = each.row
            part = rows.part_of(coarse, other.spec.coarse, None, "coarse part")
            if any(place_map.is_of(place_id, part) for place_id in here.get((source_image, time), ())):
                already_here += 1
                continue
            insert(place_map, each.row)
            copied += 1
    return copied, already_here


def insert(place_map: PlaceMap, row: tuple, place_id: int | None = None) -> None:
    """Insert the row of an `Examined`, inside a transaction of the map. Raises sqlite3.Error."""
    *values, coarse, fine = row
    place_map.insert(tuple(values[: -rows.SALIENCES]), tuple(values[-rows.SALIENCES :]), coarse, fine, place_id)
