"""The rows of the table of places: their columns, the check of their values, and a scan that survives damaged pages.

A row is used only if each value has the right type and range, and each BLOB the right size and checksum. A missing
checksum (NULL) is accepted, because it is removed when a place is moved on purpose. The exception is the time, which
other programs write in many formats: a value that is not a time is treated as unknown."""

import math
import sqlite3
import struct
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from typing import Any

import numpy as np

from edgevpr.core.arrays import Array, LatLon
from edgevpr.core.contract import Descriptor, PartSpec, TechniqueSpec
from edgevpr.core.types import Frame, Place, Pose, Position, Salience
from edgevpr.places import geopackage
from edgevpr.places.mapfiles import is_row_error

# Lists of columns, for SQL queries.
VALUES = "geom, time, alt_m, heading_deg, source_image, quality"
SALIENCE = "memorability, staticity, entropy, is_low_quality"
POSE = (
    "up_deg, footprint_m, var_east_m2, cov_east_north_m2, var_north_m2, is_surveyed, recorded_lat_deg, recorded_lon_deg"
)
BLOBS = "coarse, fine, landmarks"
CHECKSUMS = "geom_crc32, coarse_crc32, fine_crc32, pose_crc32, landmarks_crc32"
PLACE_COLUMNS = f"{VALUES}, {SALIENCE}, {POSE}, geom_crc32, pose_crc32"
ALL_COLUMNS = f"{VALUES}, {SALIENCE}, {POSE}, {BLOBS}, {CHECKSUMS}"
COLUMNS_WITHOUT_LANDMARKS = f"{PLACE_COLUMNS}, coarse, fine, coarse_crc32, fine_crc32"
MAX_LANDMARK_BYTES = 10_000  # per place

_POSE = tuple(POSE.split(", "))
_ALTITUDES_M = (-1000, 100_000)  # above sea level, as in positions.csv
_VARIANCES_M2 = (1e-12, 1e10)
_RANGES: dict[str, tuple[float, float]] = {  # minimum and maximum of a column
    "alt_m": _ALTITUDES_M,
    "quality": (0, 1),
    "footprint_m": (1e-6, 1e5),
    "var_east_m2": _VARIANCES_M2,
    "var_north_m2": _VARIANCES_M2,
    "recorded_lat_deg": (-90, 90),
    "recorded_lon_deg": (-180, 180),
}
_MAX_UNREADABLE = 100_000  # a scan ends after this many successive ids without a readable place

# Values of some columns of a row as SQLite returns them, with unchecked types.
Values = tuple[Any, ...]
Content = Mapping[str, Any]  # such values by column name


class RowError(ValueError):
    """Raised if a value of a row is missing or invalid; the message describes the problem in a few words."""


def read_columns(columns: str, row: Values | None) -> Content:
    """Return the values of a row by the names in `columns` ("a, b"). Raises RowError if the row is None."""
    if row is None:
        raise RowError("its row is missing")
    return dict(zip(columns.split(", "), row, strict=True))


def parse_point(content: Content) -> LatLon | None:
    """Decode `geom` as (lat_deg, lon_deg); None for a place without a position. Raises RowError."""
    if content["geom"] is None:
        if content["geom_crc32"] is not None:
            raise RowError("its position is missing")
        return None
    try:
        point = geopackage.decode_point(content["geom"])
    except ValueError as error:
        raise RowError(str(error)) from error
    _require_checksum(content, "geom", "position")
    return point


def decode_part(content: Content, name: str, spec: PartSpec) -> Array:
    """Decode the part `name` ("coarse", "fine") of a descriptor as a read-only array of `spec`. Its checksum is checked
    if it is in `content`. Raises RowError."""
    blob = content[name]
    if not isinstance(blob, bytes) or len(blob) != spec.nbytes:
        raise RowError(f"its {name} part has the wrong size")
    _require_checksum(content, name, f"{name} part")
    part: Array = np.frombuffer(blob, spec.dtype).reshape(spec.shape)
    if part.dtype.kind == "f" and not np.isfinite(part).all():
        raise RowError(f"its {name} part is not finite")
    return part


def read_landmarks(content: Content) -> bytes | None:
    """Return the encoded landmarks of a place; None if there are none. Raises RowError."""
    blob = content["landmarks"]
    if blob is None:
        return None
    if not isinstance(blob, bytes) or len(blob) > MAX_LANDMARK_BYTES:
        raise RowError("its landmarks have the wrong size")
    _require_checksum(content, "landmarks", "set of landmarks")
    return blob


def parse_quality(content: Content) -> float:
    """Return the quality of a place, 0 to 1. Raises RowError."""
    quality = _parse_number(content, "quality")
    if quality is None:
        raise RowError("its quality is missing")
    return quality


def parse_position(content: Content) -> tuple[LatLon | None, float | None]:
    """Check the `VALUES` of a row; return its (lat_deg, lon_deg), and its heading in degrees, 0 up to 360. Each is
    None if unknown. Raises RowError."""
    point, heading_deg, _ = parse_point(content), _parse_number(content, "heading_deg"), _parse_number(content, "alt_m")
    if not isinstance(content["source_image"], str):
        raise RowError("its source_image is not text")
    parse_quality(content)
    return point, None if heading_deg is None else heading_deg % 360


def parse_place(place_id: int, content: Content) -> Place:
    """Make a Place from the columns `PLACE_COLUMNS` of its row. Raises RowError."""
    point, _ = parse_position(content)
    return Place(
        place_id=place_id,
        source_image=content["source_image"],
        position=Position(*point, content["alt_m"]) if point else None,
        t_utc_s=geopackage.parse_utc(content["time"]),
        heading_deg=content["heading_deg"],
        quality=content["quality"],
        salience=_make_salience([content[name] for name in SALIENCE.split(", ")]),
        pose=_make_pose(content),
    )


def make_content(
    frame: Frame, descriptor: Descriptor, spec: TechniqueSpec, salience: Salience | None, landmarks: bytes | None
) -> Content:
    """Return the row of a new place, by column, without checksums. An impossible time or altitude becomes NULL."""
    position, scores = frame.position, salience.scores if salience else {}
    altitude = position.alt_m if position else None
    return {
        "geom": geopackage.encode_point(position.lat_deg, position.lon_deg) if position else None,
        "time": geopackage.format_utc(frame.t_utc_s),
        "alt_m": altitude if altitude is not None and _ALTITUDES_M[0] <= altitude <= _ALTITUDES_M[1] else None,
        "heading_deg": frame.heading_deg,
        "source_image": escape_name(frame.name),
        "quality": descriptor.quality,
        **scores,
        "is_low_quality": int(salience.is_low) if salience else None,
        **make_pose_content(frame.pose),
        "coarse": _encode_part(descriptor.coarse, spec.coarse),
        "fine": _encode_part(descriptor.fine, spec.fine),
        "landmarks": landmarks,
    }


def make_pose_content(pose: Pose | None) -> Content:
    """Return the columns `POSE` of a row, all None for an unknown pose."""
    if pose is None:
        return dict.fromkeys(_POSE)
    recorded_deg = (pose.recorded.lat_deg, pose.recorded.lon_deg) if pose.recorded else (None, None)
    numbers = (pose.up_deg, pose.footprint_m, *pose.covariance_m2)
    return dict(zip(_POSE, (*map(float, numbers), int(pose.is_surveyed), *recorded_deg), strict=True))


def compute_checksums(content: Content) -> dict[str, int | None]:
    """Return the columns `CHECKSUMS` of a row. The checksum of a value that is None is None."""
    checksums = {f"{name}_crc32": compute_crc32(content[name]) for name in ("geom", "coarse", "fine", "landmarks")}
    return checksums | {"pose_crc32": compute_pose_crc32([content[name] for name in _POSE])}


def compute_pose_crc32(values: Sequence[Any]) -> int | None:
    """Return the checksum of the values of `POSE`, in this order; None if all are None."""
    if all(value is None for value in values):
        return None
    return zlib.crc32(struct.pack("<8d", *(math.nan if value is None else float(value) for value in values)))


def escape_name(name: str) -> str:
    """Return a name in which characters that UTF-8 cannot encode are replaced by escapes."""
    return name.encode("utf-8", "backslashreplace").decode()


def scan_rows(db: sqlite3.Connection, columns: str) -> Iterator[tuple[int, Values | None]]:
    """Yield (place id, values of `columns`) of every place in insertion order; None for values that SQLite cannot read.
    After a damaged page, each place is read by its id. Raises sqlite3.Error if nothing can be read."""
    last = -(2**63)
    try:
        for place_id, *row in db.execute(f"SELECT place_id, {columns} FROM places ORDER BY place_id"):
            if place_id <= last:
                raise sqlite3.DatabaseError("malformed: the table of places does not end")
            last = place_id
            yield place_id, tuple(row)
        return
    except sqlite3.Error as error:
        highest = _find_highest_id(db, error)
    missing = 0
    for place_id in range(max(last, 0) + 1, highest + 1):
        values: Values | None = None
        try:
            values = db.execute(f"SELECT {columns} FROM places WHERE place_id = ?", (place_id,)).fetchone()
            exists = values is not None
        except sqlite3.Error as error:
            if not is_row_error(error):
                raise
            exists = True
        if exists:
            yield place_id, values
        missing = 0 if values else missing + 1
        if missing == _MAX_UNREADABLE:
            return


def _find_highest_id(db: sqlite3.Connection, error: sqlite3.Error) -> int:
    """Return the highest id in a damaged file. Raises `error`, which revealed the damage, if that cannot be read."""
    for query in ("SELECT max(place_id) FROM places", "SELECT seq FROM sqlite_sequence WHERE name = 'places'"):
        with suppress(sqlite3.Error):
            (highest,) = db.execute(query).fetchone() or (None,)
            if is_row_error(error) and isinstance(highest, int):
                return highest
    raise error


def _make_salience(values: Sequence[Any]) -> Salience | None:
    """Make a Salience from the columns `SALIENCE`; None if it is unknown. An invalid score becomes None."""
    *scores, is_low = values
    if is_low is None:
        return None
    valid = (score if isinstance(score, float) and 0 <= score <= 1 else None for score in scores)
    memorability, staticity, entropy = valid
    return Salience(memorability, staticity, entropy, is_low=is_low == 1)


def _make_pose(content: Content) -> Pose | None:
    """Make a Pose from the columns `POSE`; None if unknown. Raises RowError, because a wrong pose would shift fixes."""
    values, checksum = [_parse_number(content, name) for name in _POSE], content["pose_crc32"]
    if checksum is not None and checksum != compute_pose_crc32(values):
        raise RowError("its pose does not match its checksum")
    if all(value is None for value in values):
        return None
    up_deg, footprint_m, var_east, cov, var_north, is_surveyed, lat_deg, lon_deg = values
    if up_deg is None or footprint_m is None or var_east is None or cov is None or var_north is None:
        raise RowError("its pose is incomplete")
    if not cov**2 <= var_east * var_north:
        raise RowError("its pose has an impossible covariance")
    return Pose(
        up_deg=up_deg % 360,
        footprint_m=footprint_m,
        covariance_m2=(var_east, cov, var_north),
        is_surveyed=is_surveyed == 1,
        recorded=None if lat_deg is None or lon_deg is None else Position(lat_deg, lon_deg),
    )


def _encode_part(part: Array | None, spec: PartSpec | None) -> bytes | None:
    """Encode a part of a descriptor as bytes to store; None for a part that the technique does not have."""
    if spec is None or part is None:
        return None
    return np.ascontiguousarray(part, spec.dtype).reshape(spec.shape).tobytes()


def compute_crc32(blob: bytes | None) -> int | None:
    return None if blob is None else zlib.crc32(blob)


def _require_checksum(content: Content, name: str, label: str) -> None:
    checksum = content.get(f"{name}_crc32")
    if checksum is not None and checksum != zlib.crc32(content[name]):
        raise RowError(f"its {label} does not match its checksum")


def _parse_number(content: Content, name: str) -> float | None:
    """Return the number in a column, None for NULL. Raises RowError for any other type or a number out of range."""
    value, (low, high) = content[name], _RANGES.get(name, (-math.inf, math.inf))
    if value is None or (isinstance(value, (int, float)) and math.isfinite(value) and low <= value <= high):
        return value
    raise RowError(f"its {name} is {repr(value)[:20]}")
