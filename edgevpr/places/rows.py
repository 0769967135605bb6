"""The rows of the table of places: what may stand in one, and the reading of all that can be read.

A row is believed only where each value has its type and range, and each BLOB its size and, where the map has one, its
checksum. The exception is the time, of which other programs write many forms: what is no time is an unknown time.
"""

import math
import sqlite3
import struct
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from edgevpr.core.contract import PartSpec
from edgevpr.core.types import Frame, Place, Pose, Position, Salience
from edgevpr.places import geopackage
from edgevpr.places.sqlite import is_of_one_row

CHECKSUMS = "geom_crc32, coarse_crc32, fine_crc32"
NEW_CHECKSUMS = "pose_crc32, landmarks_crc32"  # of what maps of format 4 have
VALUES = "geom, time, alt_m, heading_deg, source_image, quality"
SALIENCE = "memorability, staticity, entropy, is_low_quality"
SALIENCES = 4  # columns
POSE = (
    "up_deg, footprint_m, var_east_m2, cov_east_north_m2, var_north_m2, is_surveyed, recorded_lat_deg, recorded_lon_deg"
)
POSES = 8  # columns
BLOBS = "coarse, fine"
LANDMARKS = "landmarks"
COLUMNS = {"place_id", *f"{VALUES}, {BLOBS}".split(", ")}

_LEAST_ROW_BYTES = 16  # no row of a map is smaller, so a file has no more rows than its size allows
_LOWEST_M, _HIGHEST_M = -1000, 100_000  # above sea level, as in positions.csv
_MOST_METRES = 1e5  # of a footprint, or the standard deviation of a position
MOST_LANDMARK_BYTES = 10_000  # of a place
_MOST_MISSING = 100_000  # ids one after another of which there is no place

Point = tuple[float, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class Content:
    """All that the file has of a place, in the forms of SQLite: its `VALUES`, `SALIENCE` and `POSE`, and its BLOBs."""

    values: tuple
    salience: tuple
    pose: tuple
    coarse: bytes
    fine: bytes | None
    landmarks: bytes | None


class Unreadable(ValueError):
    """A value of a row that is not to be believed, in a few words."""


def there(row: tuple | None) -> tuple:
    """Return a row. Raises Unreadable for None."""
    if row is None:
        raise Unreadable("its row is gone")
    return row


def split(parts: Sequence) -> tuple[Sequence, Sequence, Sequence]:
    """Split what was read as `VALUES`, `SALIENCE`, `POSE` into the three."""
    return parts[: -SALIENCES - POSES], parts[-SALIENCES - POSES : -POSES], parts[-POSES:]


def crc32(blob: bytes | None) -> int | None:
    """Return the checksum of a BLOB, None for one that is NULL."""
    return None if blob is None else zlib.crc32(blob)


def point_of(geom: object, checksum: object) -> Point | None:
    """Return (lat_deg, lon_deg), None for a place without a position. Raises Unreadable."""
    if geom is None:
        if checksum is not None:
            raise Unreadable("its position is gone")
        return None
    try:
        point = geopackage.read_point(geom)
    except ValueError as error:
        raise Unreadable(str(error)) from error
    _hold(geom, checksum, "position")
    return point


def part_of(blob: object, spec: PartSpec, checksum: object, name: str) -> np.ndarray:
    """Return a part of a descriptor (read-only array of `spec`); `name` it is called by. Raises Unreadable."""
    if not isinstance(blob, bytes) or len(blob) != spec.nbytes:
        raise Unreadable(f"its {name} has a wrong size")
    _hold(blob, checksum, name)
    part = np.frombuffer(blob, spec.dtype).reshape(spec.shape)
    if part.dtype.kind == "f" and not np.isfinite(part).all():
        raise Unreadable(f"its {name} is not finite")
    return part


def quality_of(value: object) -> float:
    """Return a quality, 0 to 1. Raises Unreadable."""
    quality = _number(value, "quality")
    if quality is None or not 0 <= quality <= 1:
        raise Unreadable("its quality is not from 0 to 1")
    return quality


def altitude(alt_m: float | None) -> float | None:
    """Return an altitude above sea level, None for one at which nothing flies."""
    return alt_m if alt_m is not None and _LOWEST_M <= alt_m <= _HIGHEST_M else None


def where_of(values: Sequence, geom_checksum: object) -> tuple[Point | None, float | None]:
    """Check all of a row's `VALUES`; return the position, and the heading as 0 up to 360 degrees. Raises Unreadable."""
    geom, _, alt_m, heading_deg, source_image, quality = values
    point = point_of(geom, geom_checksum)
    alt_m = _number(alt_m, "alt_m")
    if alt_m != altitude(alt_m):
        raise Unreadable(f"its alt_m is {alt_m:g}")
    heading_deg = _number(heading_deg, "heading_deg")
    if not isinstance(source_image, str):
        raise Unreadable("its source_image is no text")
    quality_of(quality)
    return point, None if heading_deg is None else heading_deg % 360


def salience_of(values: Sequence) -> Salience | None:
    """Return what a row's `SALIENCE` says; None where it says nothing. A score that is none is unknown: nothing depends
    on it in flight."""
    *scores, is_low = values
    if is_low is None:
        return None
    known = (isinstance(each, float) and 0 <= each <= 1 for each in scores)
    return Salience(*(each if ok else None for each, ok in zip(scores, known, strict=True)), is_low=is_low == 1)


def salience_values(salience: Salience | None) -> tuple:
    """Return a row's `SALIENCE`."""
    if salience is None:
        return None, None, None, None
    return *salience.scores.values(), int(salience.is_low)


def pose_of(values: Sequence, checksum: object) -> Pose | None:
    """Return what a row's `POSE` says; None where it says nothing. Raises Unreadable: a wrong pose would make a wrong
    position."""
    if checksum is None and all(each is None for each in values):
        return None
    if checksum is not None and checksum != pose_crc32(values):
        raise Unreadable("its pose does not match its checksum")
    names = POSE.split(", ")
    up_deg, footprint_m, var_east, cov, var_north, is_surveyed, *recorded = map(_number, values, names)
    if None in (up_deg, footprint_m, var_east, cov, var_north):
        raise Unreadable("its pose is not whole")
    if not (0 < footprint_m <= _MOST_METRES and 0 < var_east <= _MOST_METRES**2 and 0 < var_north <= _MOST_METRES**2):
        raise Unreadable("its pose is out of range")
    if not cov**2 <= var_east * var_north:
        raise Unreadable("its pose has no covariance")
    lat_deg, lon_deg = recorded
    if None not in recorded and not (abs(lat_deg) <= 90 and abs(lon_deg) <= 180):
        raise Unreadable("its recorded position is not on the Earth")
    return Pose(
        up_deg=up_deg % 360,
        footprint_m=footprint_m,
        covariance_m2=(var_east, cov, var_north),
        is_surveyed=is_surveyed == 1,
        recorded=None if None in recorded else Position(lat_deg, lon_deg),
    )


def pose_values(pose: Pose | None) -> tuple:
    """Return a row's `POSE`."""
    if pose is None:
        return (None,) * POSES
    recorded = (pose.recorded.lat_deg, pose.recorded.lon_deg) if pose.recorded else (None, None)
    return (
        float(pose.up_deg),
        float(pose.footprint_m),
        *map(float, pose.covariance_m2),
        int(pose.is_surveyed),
        *recorded,
    )


def pose_crc32(values: Sequence) -> int | None:
    """Return the checksum of a row's `POSE`, None where it says nothing."""
    if all(each is None for each in values):
        return None
    return zlib.crc32(struct.pack(f"<{POSES}d", *(math.nan if each is None else float(each) for each in values)))


def landmarks_of(blob: object, checksum: object) -> bytes | None:
    """Return the landmarks of a place, None for one that has none. Raises Unreadable."""
    if blob is None:
        return None
    if not isinstance(blob, bytes) or len(blob) > MOST_LANDMARK_BYTES:
        raise Unreadable("its landmarks have a wrong size")
    _hold(blob, checksum, "set of landmarks")
    return blob


def place_of(
    place_id: int, values: Sequence, salience: Sequence, pose: Sequence, geom_checksum: object, pose_checksum: object
) -> Place:
    """Make a place of its row's `VALUES`, `SALIENCE` and `POSE`. Raises Unreadable."""
    point, _ = where_of(values, geom_checksum)
    _, time, alt_m, heading_deg, source_image, quality = values
    return Place(
        place_id=place_id,
        source_image=source_image,
        position=Position(*point, alt_m) if point else None,
        t_utc_s=geopackage.utc_seconds(time),
        heading_deg=heading_deg,
        quality=quality,
        salience=salience_of(salience),
        pose=pose_of(pose, pose_checksum),
    )


def values_of(frame: Frame, quality: float) -> tuple:
    """Return the `VALUES` of a frame's row.

    A time that is no date is unknown, and so is an altitude at which nothing flies.
    """
    position = frame.position
    return (
        geopackage.point_blob(position.lat_deg, position.lon_deg) if position else None,
        geopackage.utc_text(frame.t_utc_s),
        altitude(position.alt_m) if position else None,
        frame.heading_deg,
        readable(frame.name),
        quality,
    )


def blob_of(part: np.ndarray | None, spec: PartSpec | None) -> bytes | None:
    """Return the bytes of a part of a descriptor as the file has them, None for a part that the technique lacks."""
    if spec is None:
        return None
    return np.ascontiguousarray(part, spec.dtype).reshape(spec.shape).tobytes()


def readable(name: str) -> str:
    """Return a name as UTF-8 can have it: bytes that are not UTF-8 are written as escapes."""
    return name.encode("utf-8", "backslashreplace").decode()


def most_rows(file_bytes: int) -> int:
    """Return how many rows a file of this size can hold at most."""
    return file_bytes // _LEAST_ROW_BYTES


def scan(db: sqlite3.Connection, columns: str, file_bytes: int) -> Iterator[tuple[int, tuple | None]]:
    """Yield (place id, row) of every place in the order they were added; the row is None where SQLite cannot read it.

    A damaged page hides the rows on it, and those after it from a walk through the table. They are then asked for one
    by one. Raises sqlite3.Error where the file cannot be read at all, or has more rows than its size allows.
    """
    left = most_rows(file_bytes)
    last, highest = -(2**63), None
    while True:
        try:
            walk = db.execute(f"SELECT place_id, {columns} FROM places WHERE place_id > ? ORDER BY place_id", (last,))
            for place_id, *row in walk:
                left -= 1
                if not isinstance(place_id, int) or place_id <= last or left < 0:
                    raise sqlite3.DatabaseError("malformed: the table of places does not end")
                last = place_id
                yield place_id, tuple(row)
            return
        except sqlite3.Error as error:
            if left < 0 or not is_of_one_row(error):
                raise
            highest = _highest_id(db, error) if highest is None else highest
        last, missing, row = max(last, 0), 0, None
        while row is None and last < highest and missing < _MOST_MISSING and left > 0:
            last += 1
            try:
                row = db.execute(f"SELECT {columns} FROM places WHERE place_id = ?", (last,)).fetchone()
                missing += 1
            except sqlite3.Error as error:
                if not is_of_one_row(error):
                    raise
                missing, left = 0, left - 1
                yield last, None
        if row is None:
            return
        left -= 1
        yield last, row


def _highest_id(db: sqlite3.Connection, error: sqlite3.Error) -> int:
    """Return the highest id that a place may have. Raises `error`, because of which it is asked, where none can be
    read."""
    for asked in ("SELECT max(place_id) FROM places", "SELECT seq FROM sqlite_sequence WHERE name = 'places'"):
        try:
            (highest,) = db.execute(asked).fetchone() or (None,)
        except sqlite3.Error:
            continue
        if isinstance(highest, int):
            return highest
    raise error


def _hold(blob: bytes, checksum: object, name: str) -> None:
    if checksum is not None and checksum != zlib.crc32(blob):
        raise Unreadable(f"its {name} does not match its checksum")


def _number(value: object, name: str) -> float | None:
    if value is None:
        return None
    if not isinstance(value, (int, float)) or not math.isfinite(value):
        raise Unreadable(f"its {name} is no number")
    return value
