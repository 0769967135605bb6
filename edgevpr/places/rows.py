"""The rows of the table of places: what may stand in one, and the reading of all that can be read.

A row is believed only where each value has its type and range, and each BLOB its size and its checksum. A checksum is
missing (NULL) where another program has moved a place on purpose. The exception is the time, of which other programs
write many forms: what is no time is an unknown time.
"""

import math
import sqlite3
import struct
import zlib
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from edgevpr.core.arrays import Array, LatLon
from edgevpr.core.contract import Descriptor, PartSpec, TechniqueSpec
from edgevpr.core.types import Frame, Place, Pose, Position, Salience
from edgevpr.places import geopackage
from edgevpr.places.sqlite import is_of_one_row

# Columns, as a query of SQL names them.
VALUES = "geom, time, alt_m, heading_deg, source_image, quality"
SALIENCE = "memorability, staticity, entropy, is_low_quality"
POSE = (
    "up_deg, footprint_m, var_east_m2, cov_east_north_m2, var_north_m2, is_surveyed, recorded_lat_deg, recorded_lon_deg"
)
BLOBS = "coarse, fine, landmarks"
CHECKSUMS = "geom_crc32, coarse_crc32, fine_crc32, pose_crc32, landmarks_crc32"
OF_PLACE = f"{VALUES}, {SALIENCE}, {POSE}, geom_crc32, pose_crc32"
ALL = f"{VALUES}, {SALIENCE}, {POSE}, {BLOBS}, {CHECKSUMS}"
MOST_LANDMARK_BYTES = 10_000  # of a place

_POSE = tuple(POSE.split(", "))
_LEAST_ROW_BYTES = 16  # no row of a map is smaller, so a file has no more rows than its size allows
_LOWEST_M, _HIGHEST_M = -1000, 100_000  # above sea level, as in positions.csv
_MOST_METRES = 1e5  # of a footprint, or the standard deviation of a position
_MOST_MISSING = 100_000  # ids one after another of which there is no place

# Values of some columns of a row as SQLite gives them: nothing is known of their types.
Values = tuple[Any, ...]
Content = Mapping[str, Any]  # the same, by their columns


class Unreadable(ValueError):
    """A value of a row that is not to be believed, in a few words."""


def present(row: Values | None) -> Values:
    """Return a row. Raises Unreadable for None."""
    if row is None:
        raise Unreadable("its row is gone")
    return row


def content_of(columns: str, row: Values | None) -> Content:
    """Return the values of a row by their columns. Raises Unreadable for None."""
    return dict(zip(columns.split(", "), present(row), strict=True))


def point_of(geom: object, checksum: object) -> LatLon | None:
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


def part_of(blob: object, spec: PartSpec, checksum: object, name: str) -> Array:
    """Return a part of a descriptor (read-only array of `spec`); `name` it is called by. Raises Unreadable."""
    if not isinstance(blob, bytes) or len(blob) != spec.nbytes:
        raise Unreadable(f"its {name} has a wrong size")
    _hold(blob, checksum, name)
    part: Array = np.frombuffer(blob, spec.dtype).reshape(spec.shape)
    if part.dtype.kind == "f" and not np.isfinite(part).all():
        raise Unreadable(f"its {name} is not finite")
    return part


def landmarks_of(blob: object, checksum: object) -> bytes | None:
    """Return the landmarks of a place, None for one that has none. Raises Unreadable."""
    if blob is None:
        return None
    if not isinstance(blob, bytes) or len(blob) > MOST_LANDMARK_BYTES:
        raise Unreadable("its landmarks have a wrong size")
    _hold(blob, checksum, "set of landmarks")
    return blob


def quality_of(value: object) -> float:
    """Return a quality, 0 to 1. Raises Unreadable."""
    quality = _number(value, "quality")
    if quality is None or not 0 <= quality <= 1:
        raise Unreadable("its quality is not from 0 to 1")
    return quality


def where_of(values: Sequence[Any], geom_checksum: object) -> tuple[LatLon | None, float | None]:
    """Check all of a row's `VALUES`; return the position, and the heading as 0 up to 360 degrees. Raises Unreadable."""
    geom, _, alt_m, heading_deg, source_image, quality = values
    point = point_of(geom, geom_checksum)
    if _number(alt_m, "alt_m") != _altitude(alt_m):
        raise Unreadable(f"its alt_m is {alt_m:g}")
    heading_deg = _number(heading_deg, "heading_deg")
    if not isinstance(source_image, str):
        raise Unreadable("its source_image is no text")
    quality_of(quality)
    return point, None if heading_deg is None else heading_deg % 360


def place_of(place_id: int, content: Content) -> Place:
    """Make a place of the `OF_PLACE` of its row. Raises Unreadable."""
    point, _ = where_of([content[name] for name in VALUES.split(", ")], content["geom_crc32"])
    return Place(
        place_id=place_id,
        source_image=content["source_image"],
        position=Position(*point, content["alt_m"]) if point else None,
        t_utc_s=geopackage.utc_seconds(content["time"]),
        heading_deg=content["heading_deg"],
        quality=content["quality"],
        salience=_salience_of([content[name] for name in SALIENCE.split(", ")]),
        pose=_pose_of([content[name] for name in _POSE], content["pose_crc32"]),
    )


def frame_content(
    frame: Frame, descriptor: Descriptor, spec: TechniqueSpec, salience: Salience | None, landmarks: bytes | None
) -> Content:
    """Return the row of a new place, without its checksums.

    A time that is no date is unknown, and so is an altitude at which nothing flies.
    """
    position, scores = frame.position, salience.scores if salience else {}
    return {
        "geom": geopackage.point_blob(position.lat_deg, position.lon_deg) if position else None,
        "time": geopackage.utc_text(frame.t_utc_s),
        "alt_m": _altitude(position.alt_m) if position else None,
        "heading_deg": frame.heading_deg,
        "source_image": readable(frame.name),
        "quality": descriptor.quality,
        **scores,
        "is_low_quality": int(salience.is_low) if salience else None,
        **pose_content(frame.pose),
        "coarse": _blob_of(descriptor.coarse, spec.coarse),
        "fine": _blob_of(descriptor.fine, spec.fine),
        "landmarks": landmarks,
    }


def pose_content(pose: Pose | None) -> Content:
    """Return the `POSE` of a row, by its columns."""
    if pose is None:
        return dict.fromkeys(_POSE)
    recorded = (pose.recorded.lat_deg, pose.recorded.lon_deg) if pose.recorded else (None, None)
    measured = (pose.up_deg, pose.footprint_m, *pose.covariance_m2)
    return dict(zip(_POSE, (*map(float, measured), int(pose.is_surveyed), *recorded), strict=True))


def checksums_of(content: Content) -> dict[str, int | None]:
    """Return the `CHECKSUMS` of a row, by their columns: that of what is NULL is NULL."""
    sums = {f"{name}_crc32": crc32(content[name]) for name in ("geom", "coarse", "fine", "landmarks")}
    return sums | {"pose_crc32": pose_crc32([content[name] for name in _POSE])}


def pose_crc32(values: Sequence[Any]) -> int | None:
    """Return the checksum of a row's `POSE`, None where it says nothing."""
    if all(value is None for value in values):
        return None
    return zlib.crc32(struct.pack("<8d", *(math.nan if value is None else float(value) for value in values)))


def readable(name: str) -> str:
    """Return a name as UTF-8 can have it: bytes that are not UTF-8 are written as escapes."""
    return name.encode("utf-8", "backslashreplace").decode()


def most_rows(file_bytes: int) -> int:
    """Return how many rows a file of this size can hold at most."""
    return file_bytes // _LEAST_ROW_BYTES


def scan(db: sqlite3.Connection, columns: str, file_bytes: int) -> Iterator[tuple[int, Values | None]]:
    """Yield (place id, row) of every place in the order they were added; the row is None where SQLite cannot read it.

    A damaged page hides the rows on it, and those after it from a walk through the table. They are then asked for one
    by one. Raises sqlite3.Error where the file cannot be read at all, or has more rows than its size allows.
    """
    left, last = most_rows(file_bytes), -(2**63)
    try:
        for place_id, *row in db.execute(f"SELECT place_id, {columns} FROM places ORDER BY place_id"):
            left -= 1
            if not isinstance(place_id, int) or place_id <= last or left < 0:
                raise sqlite3.DatabaseError("malformed: the table of places does not end")
            last = place_id
            yield place_id, tuple(row)
        return
    except sqlite3.Error as error:
        if left < 0 or not is_of_one_row(error):
            raise
        highest = _highest_id(db, error)
    missing = 0
    for place_id in range(max(last, 0) + 1, highest + 1):
        if missing >= _MOST_MISSING or left <= 0:
            return
        found: Values | None = None
        try:
            found = db.execute(f"SELECT {columns} FROM places WHERE place_id = ?", (place_id,)).fetchone()
            missing += 1
        except sqlite3.Error as error:
            if not is_of_one_row(error):
                raise
            missing, left = 0, left - 1
            yield place_id, None
        if found is not None:
            missing, left = 0, left - 1
            yield place_id, found


def _highest_id(db: sqlite3.Connection, error: sqlite3.Error) -> int:
    """Return the highest id that a place may have. Raises `error`, because of which it is asked, where none can be
    read."""
    for query in ("SELECT max(place_id) FROM places", "SELECT seq FROM sqlite_sequence WHERE name = 'places'"):
        try:
            (highest,) = db.execute(query).fetchone() or (None,)
        except sqlite3.Error:
            continue
        if isinstance(highest, int):
            return highest
    raise error


def _altitude(alt_m: float | None) -> float | None:
    """Return an altitude above sea level, None for one at which nothing flies."""
    return alt_m if alt_m is not None and _LOWEST_M <= alt_m <= _HIGHEST_M else None


def _salience_of(values: Sequence[Any]) -> Salience | None:
    """Return what a row's `SALIENCE` says; None where it says nothing. A score that is none is unknown: nothing depends
    on it in flight."""
    *scores, is_low = values
    if is_low is None:
        return None
    known = (score if isinstance(score, float) and 0 <= score <= 1 else None for score in scores)
    memorability, staticity, entropy = known
    return Salience(memorability, staticity, entropy, is_low=is_low == 1)


def _pose_of(values: Sequence[Any], checksum: object) -> Pose | None:
    """Return what a row's `POSE` says; None where it says nothing. Raises Unreadable: a wrong pose would make a wrong
    position."""
    if checksum is None and all(value is None for value in values):
        return None
    if checksum is not None and checksum != pose_crc32(values):
        raise Unreadable("its pose does not match its checksum")
    *measured, is_surveyed, lat_deg, lon_deg = map(_number, values, _POSE)
    known = [value for value in measured if value is not None]
    if len(known) < len(measured):
        raise Unreadable("its pose is not whole")
    up_deg, footprint_m, var_east, cov, var_north = known
    if not (0 < footprint_m <= _MOST_METRES and 0 < var_east <= _MOST_METRES**2 and 0 < var_north <= _MOST_METRES**2):
        raise Unreadable("its pose is out of range")
    if not cov**2 <= var_east * var_north:
        raise Unreadable("its pose has no covariance")
    recorded = None
    if lat_deg is not None and lon_deg is not None:
        if not (abs(lat_deg) <= 90 and abs(lon_deg) <= 180):
            raise Unreadable("its recorded position is not on the Earth")
        recorded = Position(lat_deg, lon_deg)
    return Pose(
        up_deg=up_deg % 360,
        footprint_m=footprint_m,
        covariance_m2=(var_east, cov, var_north),
        is_surveyed=is_surveyed == 1,
        recorded=recorded,
    )


def _blob_of(part: Array | None, spec: PartSpec | None) -> bytes | None:
    """Return the bytes of a part of a descriptor as the file has them, None for a part that the technique lacks."""
    if spec is None or part is None:
        return None
    return np.ascontiguousarray(part, spec.dtype).reshape(spec.shape).tobytes()


def crc32(blob: Any) -> int | None:
    """Return the checksum of a BLOB, None for one that is NULL."""
    return None if blob is None else zlib.crc32(blob)


def _hold(blob: Any, checksum: object, name: str) -> None:
    if checksum is not None and checksum != zlib.crc32(blob):
        raise Unreadable(f"its {name} does not match its checksum")


def _number(value: object, name: str) -> float | None:
    if value is None:
        return None
    if not isinstance(value, (int, float)) or not math.isfinite(value):
        raise Unreadable(f"its {name} is no number")
    return value
