"""A whole map, row by row: what is damaged in it, what can be copied, and the merging of maps."""

import sqlite3
from collections.abc import Iterator
from dataclasses import dataclass

from edgevpr.core.errors import PlaceError
from edgevpr.places import rows
from edgevpr.places.mapfile import PlaceMap
from edgevpr.places.rows import Content, Unreadable
from edgevpr.places.sqlite import sentences

_MOST_SAID = 20  # faults of the file that SQLite lists


@dataclass(frozen=True, slots=True)
class Examined:
    """One place of a map: `problem` says in a few words what is damaged (None: nothing), and `content` is that of one
    that is whole. `has_checksums` tells whether all that should have one does."""

    place_id: int
    problem: str | None
    content: Content | None
    has_checksums: bool


def examine(place_map: PlaceMap) -> Iterator[Examined]:
    """Read everything of every place, in the order they were added."""
    spec = place_map.spec
    columns = f"{rows.VALUES}, {place_map.salience}, {place_map.pose}, {rows.BLOBS}, {place_map.landmarks}"
    for place_id, row in place_map.scan(f"{columns}, {place_map.checksums}"):
        if row is None:
            yield Examined(place_id, "SQLite cannot read its row", None, False)
            continue
        *parts, coarse, fine, landmarks, geom_sum, coarse_sum, fine_sum, pose_sum, landmarks_sum = row
        values, salience, pose = rows.split(parts)
        held = (
            (row[0], geom_sum),
            (coarse, coarse_sum),
            (fine, fine_sum),
            (pose[0], pose_sum),
            (landmarks, landmarks_sum),
        )
        has_checksums = not any(part is not None and checksum is None for part, checksum in held)
        try:
            rows.place_of(place_id, values, salience, pose, geom_sum, pose_sum)
            rows.part_of(coarse, spec.coarse, coarse_sum, "coarse part")
            if spec.fine:
                rows.part_of(fine, spec.fine, fine_sum, "fine part")
            rows.landmarks_of(landmarks, landmarks_sum)
        except Unreadable as error:
            yield Examined(place_id, str(error), None, has_checksums)
            continue
        content = Content(
            values=tuple(values),
            salience=tuple(salience),
            pose=tuple(pose),
            coarse=coarse,
            fine=fine,
            landmarks=landmarks,
        )
        yield Examined(place_id, None, content, has_checksums)


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
            _, time, _, _, source_image, _ = each.content.values
            part = rows.part_of(each.content.coarse, other.spec.coarse, None, "coarse part")
            if any(place_map.is_of(place_id, part) for place_id in here.get((source_image, time), ())):
                already_here += 1
                continue
            place_map.insert(each.content)
            copied += 1
    return copied, already_here
