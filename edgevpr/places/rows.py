"""The rows of the table of places: their columns, the check of their values, and a scan that survives damaged pages.

A row is used only if each value has the right type and range, and each BLOB the right size and checksum. A missing
checksum (NULL) is accepted, since a program that moves a place on purpose removes it. An exception is the time, which
other programs write in many forms: a value that is not a time counts as unknown.
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

# Lists of columns, as SQL queries name them.
VALUES = "geom, time, alt_m, heading_deg, source_image, quality"
SALIENCE = "memorability, staticity, entropy, is_low_quality"
POSE = (
    "up_deg, footprint_m, var_east_m2, cov_east_north_m2, var_north_m2, is_surveyed, recorded_lat_deg, recorded_lon_deg"
)
BLOBS = "coarse, fine, landmarks"
CHECKSUMS = "geom_crc32, coarse_crc32, fine_crc32, pose_crc32, landmarks_crc32"
OF_PLACE = f"{VALUES}, {SALIENCE}, {POSE}, geom_crc32, pose_crc32"
ALL = f"{VALUES}, {SALIENCE}, {POSE}, {BLOBS}, {CHECKSUMS}"
MOST_LANDMARK_BYTES = 10_000  # per place

_POSE = tuple(POSE.split(", "))
_LEAST_ROW_BYTES = 16  # no row of a map is smaller, so a file has no more rows than its size allows
_LOWEST_M, _HIGHEST_M = -1000, 100_000  # allowed altitudes above sea level, as in positions.csv
_MOST_METRES = 1e5  # largest footprint, and largest standard deviation of a position
_MOST_MISSING = 100_000  # successive ids without a place, after which a scan by ids ends

# Values of some columns of a row as SQLite returns them; their types are not checked yet.
Values = tuple[Any, ...]
Content = Mapping[str, Any]  # such values by column name


class Unreadable(ValueError):
    """A value of a row is missing or invalid; the message says which, in a few words."""


def present(row: Values | None) -> Values:
    """Return `row` itself. Raises Unreadable if it is None, that is missing or unreadable."""
    if row is None:
        raise Unreadable("its row is gone")
    return row


def content_of(columns: str, row: Values | None) -> Content:
    """Return the values of a row by the names in `columns`. Raises Unreadable if `row` is None."""
    return dict(zip(columns.split(", "), present(row), strict=True))


def point_of(geom: object, checksum: object) -> LatLon | None:
    """Decode `geom` as (lat_deg, lon_deg); None for a place without a position. Raises Unreadable."""
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
    """Decode a part of a descriptor as a read-only array of `spec`. Raises Unreadable; its message has `name`."""
    if not isinstance(blob, bytes) or len(blob) != spec.nbytes:
        raise Unreadable(f"its {name} has a wrong size")
    _hold(blob, checksum, name)
    part: Array = np.frombuffer(blob, spec.dtype).reshape(spec.shape)
    if part.dtype.kind == "f" and not np.isfinite(part).all():
        raise Unreadable(f"its {name} is not finite")
    return part


def landmarks_of(blob: object, checksum: object) -> bytes | None:
    """Check the encoded landmarks of a place and return them; None if there are none. Raises Unreadable."""
    if blob is None:
        return None
    if not isinstance(blob, bytes) or len(blob) > MOST_LANDMARK_BYTES:
        raise Unreadable("its landmarks have a wrong size")
    _hold(blob, checksum, "set of landmarks")
    return blob


def quality_of(value: object) -> float:
    """Check a quality and return it, 0 to 1. Raises Unreadable."""
    quality = _number(value, "quality")
    if quality is None or not 0 <= quality <= 1:
        raise Unreadable("its quality is not from 0 to 1")
    return quality


def where_of(values: Sequence[Any], geom_checksum: object) -> tuple[LatLon | None, float | None]:
    """Check the `VALUES` of a row; return its (lat_deg, lon_deg), and its heading in degrees, 0 up to 360. Each is
    None if unknown. Raises Unreadable."""
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
    """Make a Place from the columns `OF_PLACE` of its row. Raises Unreadable."""
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
    """Return the row of a new place, by columns, without its checksums.

    A time that is not a date and an altitude outside the allowed range are stored as unknown (NULL).
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
    """Return the columns `POSE` of a row, all None for an unknown pose."""
    if pose is None:
        return dict.fromkeys(_POSE)
    recorded = (pose.recorded.lat_deg, pose.recorded.lon_deg) if pose.recorded else (None, None)
    measured = (pose.up_deg, pose.footprint_m, *pose.covariance_m2)
    return dict(zip(_POSE, (*map(float, measured), int(pose.is_surveyed), *recorded), strict=True))


def checksums_of(content: Content) -> dict[str, int | None]:
    """Return the columns `CHECKSUMS` of a row. The checksum of a value that is None is None."""
    sums = {f"{name}_crc32": crc32(content[name]) for name in ("geom", "coarse", "fine", "landmarks")}
    return sums | {"pose_crc32": pose_crc32([content[name] for name in _POSE])}


def pose_crc32(values: Sequence[Any]) -> int | None:
    """Return the checksum of the values of `POSE`, in this order; None if all are None."""
    if all(value is None for value in values):
        return None
    return zlib.crc32(struct.pack("<8d", *(math.nan if value is None else float(value) for value in values)))


def readable(name: str) -> str:
    """Return a name in which characters that UTF-8 cannot encode are replaced by escapes."""
    return name.encode("utf-8", "backslashreplace").decode()


def most_rows(file_bytes: int) -> int:
    """Return the largest number of rows that a file of this size can hold."""
    return file_bytes // _LEAST_ROW_BYTES


def scan(db: sqlite3.Connection, columns: str, file_bytes: int) -> Iterator[tuple[int, Values | None]]:
    """Yield (place id, values of `columns`) of every place in the order added; None for values SQLite cannot read.

    A query of the whole table ends at the first damaged page. The rows after it are then read one by one, by id. Raises
    sqlite3.Error if the file cannot be read at all, or yields more rows than fit into `file_bytes`.
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
    """Return the highest id that a place of a damaged file may have. Raises `error`, the one that showed the damage, if
    that cannot be read."""
    for query in ("SELECT max(place_id) FROM places", "SELECT seq FROM sqlite_sequence WHERE name = 'places'"):
        try:
            (highest,) = db.execute(query).fetchone() or (None,)
        except sqlite3.Error:
            continue
        if isinstance(highest, int):
            return highest
    raise error


def _altitude(alt_m: float | None) -> float | None:
    """Return an altitude above sea level, or None if it is outside the allowed range."""
    return alt_m if alt_m is not None and _LOWEST_M <= alt_m <= _HIGHEST_M else None


def _salience_of(values: Sequence[Any]) -> Salience | None:
    """Make a Salience from the values of `SALIENCE`; None if they are unknown. An invalid score becomes None, since no
    decision in flight depends on it."""
    *scores, is_low = values
    if is_low is None:
        return None
    known = (score if isinstance(score, float) and 0 <= score <= 1 else None for score in scores)
    memorability, staticity, entropy = known
    return Salience(memorability, staticity, entropy, is_low=is_low == 1)


def _pose_of(values: Sequence[Any], checksum: object) -> Pose | None:
    """Make a Pose from the values of `POSE`; None if they are unknown. Raises Unreadable for invalid values: a wrong
    pose would give wrong positions in flight."""
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
    """Encode a part of a descriptor as the bytes to store; None for a part that the technique does not have."""
    if spec is None or part is None:
        return None
    return np.ascontiguousarray(part, spec.dtype).reshape(spec.shape).tobytes()


def crc32(blob: Any) -> int | None:
    """Return the CRC-32 of a BLOB; None for None."""
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
