"""Tables of positions in CSV: position, attitude and time of each image of a folder (positions.csv), or of a video by
video time. The sources of frames read them. In this module, `where` is "FILE, line N" for error messages."""

import csv
import io
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import numpy as np

from edgevpr.core.errors import UsageError
from edgevpr.core.files import read_file, write_atomically
from edgevpr.core.geodesy import wrap_deg
from edgevpr.core.types import Position

ALT_LIMITS_M = (-1000.0, 100_000.0)  # plausible altitudes
# Numeric columns with their limits. heading_deg takes precedence over yaw_deg, and height_m over rel_alt.
_COLUMN_LIMITS = {
    "lat": (-90.0, 90.0),
    "lon": (-180.0, 180.0),
    "alt": ALT_LIMITS_M,
    "heading_deg": (-360.0, 360.0),
    "yaw_deg": (-360.0, 360.0),
    "roll_deg": (-180.0, 180.0),
    "pitch_deg": (-90.0, 90.0),
    "height_m": ALT_LIMITS_M,
    "rel_alt": ALT_LIMITS_M,
}
_SIGN_COLUMN = re.compile(r"(?:gps)?(lat|lon)\w*(?:ref|ns|ew)")
_POSITION_NAME = re.compile(
    r"(lat|latitude|lon|lng|longitude|alt|altitude|height|elevation|yaw|pitch|roll|heading|direction|omega|phi|kappa)"
    r"(deg|degree|degrees|rad|m|ft|ref|ns|ew)?"
)
_PREFIXES = re.compile(r"(gps|gimbal|flight|camera|img|absolute|relative|rel|abs)+")
_TAG_COLUMNS = ("lat", "lon", "alt", "yaw_deg", "roll_deg", "pitch_deg", "height_m")
_REQUIRED_COLUMNS = ("file", "lat", "lon")
_TRACK_COLUMNS = ("time", "lat", "lon")
_MAX_FILE_BYTES = 100_000_000  # a million images
# The years 1900 to 2200. A time in milliseconds, a thousand times too large, is out of range.
_MIN_TIME_S = -2_208_988_800
_MAX_TIME_S = 7_258_118_400
MAX_GAP_S = 5.0  # no interpolation across longer gaps: the aircraft may have turned
_TIME_ROUNDING_S = 0.001  # Matroska stores milliseconds
_ANGLE_INDICES = [1, 3, 4]  # positions in `_to_numbers` of the angles that wrap at 360 degrees


@dataclass(frozen=True, slots=True, kw_only=True)
class GeoTag:
    """Position, heading, time (seconds since 1970), roll, pitch and height of an image, as in `Frame`, or None."""

    position: Position | None = None
    heading_deg: float | None = None
    t_utc_s: float | None = None
    roll_deg: float | None = None
    pitch_deg: float | None = None
    height_m: float | None = None


def find_positions(folder: str | Path) -> Path | None:
    """Return the path of positions.csv in `folder`, else in the folder that contains it, else None."""
    folder = Path(folder).absolute()
    tables = (folder / "positions.csv", folder.parent / "positions.csv")
    return next((table for table in tables if table.is_file()), None)


def find_track(video: str | Path) -> Path | None:
    """Return the path of the position table next to a video (same name with the extension .csv), or None."""
    table = Path(video).with_suffix(".csv")
    return table if table.is_file() else None


def read_positions(csv_path: str | Path) -> dict[str, GeoTag]:
    """Read a positions.csv. Returns the tag of each image by file name.

    Columns: file, lat, lon (degrees) and, optionally, alt (m), heading_deg or yaw_deg, time, roll_deg (right wing down
    is positive), pitch_deg (nose up), and height_m above the ground or rel_alt (DJI: above the take-off point). All
    cells except the name may be empty; other columns are ignored. Raises UsageError for a file that cannot be read, and
    for an invalid value, with its line."""
    return {row["file"]: _parse_tag(row, where) for where, row in _read_rows(csv_path)}


def list_unread_columns(csv_path: str | Path) -> list[str]:
    """List the columns of a table whose names are like those of positions, attitudes and heights, but not read. Raises
    UsageError as `read_positions` does."""
    rows = _read_rows(csv_path, ("lat", "lon"))
    return [name for name in (rows[0][1] if rows else {}) if is_like_position(name) and name not in _COLUMN_LIMITS]


def is_like_position(name: str) -> bool:
    """Return True if the name of a column is like that of a position, angle or height."""
    letters = re.sub("[^a-z]", "", name.rpartition(":")[2].lower())
    return bool(_POSITION_NAME.fullmatch(_PREFIXES.sub("", letters, count=1)))


def write_positions(csv_path: str | Path, tags: Mapping[str, GeoTag]) -> None:
    """Write `tags`, by file name, to a positions.csv. `read_positions` returns exactly the same tags."""
    rows = [(name, *_to_numbers(tag), tag.t_utc_s) for name, tag in tags.items()]
    _write_table(csv_path, ("file", *_TAG_COLUMNS, "time"), rows)


def write_track(csv_path: str | Path, track: "Track") -> None:
    """Write the table of positions of a video. `read_track` returns exactly the same track."""
    rows = ((t_s, *_to_numbers(tag)) for t_s, tag in zip(track.t_s, track.tags, strict=True))
    _write_table(csv_path, ("time", *_TAG_COLUMNS), rows)


def _write_table(csv_path: str | Path, header: Sequence[str], rows: Iterable[Sequence[Any]]) -> None:
    text = io.StringIO(newline="")
    table = csv.writer(text)
    table.writerow(header)
    table.writerows(rows)
    write_atomically(Path(csv_path), lambda path: path.write_bytes(text.getvalue().encode()))


def _to_numbers(tag: GeoTag) -> tuple[Any, ...]:
    """Return latitude, longitude, altitude, heading, roll, pitch and height of a tag; None: unknown."""
    position = tag.position
    coordinates = (position.lat_deg, position.lon_deg, position.alt_m) if position else (None, None, None)
    return *coordinates, tag.heading_deg, tag.roll_deg, tag.pitch_deg, tag.height_m


def _read_rows(csv_path: str | Path, required: Sequence[str] = _REQUIRED_COLUMNS) -> list[tuple[str, dict[str, str]]]:
    """Read the rows of a table that must have the columns `required`. Returns "FILE, line N" and the cells by column
    name of each row. If `file` is required, file names must be unique. Raises UsageError as `read_positions` does."""
    try:
        text = read_file(csv_path, _MAX_FILE_BYTES).decode("utf-8-sig")
        table = csv.DictReader(io.StringIO(text, newline=""), skipinitialspace=True)
        table.fieldnames = header = [name.strip().lower() for name in table.fieldnames or ()]
        rows = [(f"{csv_path}, line {table.line_num}", row) for row in table]
    except OSError as error:
        raise UsageError(f"{csv_path} cannot be read ({error.strerror}): choose a readable CSV file.") from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise UsageError(f"{csv_path} is not a CSV text file ({error}): save it as CSV in UTF-8.") from error
    for name in (*required, *_COLUMN_LIMITS, "time"):
        if header.count(name) > 1 or (name in required and name not in header):
            raise UsageError(
                f"{csv_path}, line 1 must name each of the columns {', '.join(required)} exactly once, separated by "
                f"commas; `{name}` is missing or repeated."
            )
    records, names = [], {""}
    for where, row in rows:
        if None in row or None in row.values():  # DictReader marks too many values, and too few, this way
            raise UsageError(f"{where} must have as many values as line 1 has columns.")
        record = {name: value.strip() for name, value in row.items()}
        if "file" in required and record["file"] in names:
            raise UsageError(f"{where}: `file` is `{record['file']}`, but must be a name not used on an earlier line.")
        for name, cell in record.items():
            sign = _SIGN_COLUMN.fullmatch(name)
            if sign and cell[:1].upper() in ("S", "W") and not record[sign[1]].startswith("-"):
                raise UsageError(
                    f"{where}: {sign[1]} is `{record[sign[1]]}`, but {name} is `{cell}`: write south and west as "
                    "negative numbers."
                )
        names.add(record.get("file", ""))
        records.append((where, record))
    return records


def _parse_tag(row: Mapping[str, str], where: str) -> GeoTag:
    """Convert a row (cells by column name) to a GeoTag. Raises UsageError for an invalid value."""
    values = {column: _parse_number(row, column, *limits, where) for column, limits in _COLUMN_LIMITS.items()}
    lat_deg, lon_deg, position = values["lat"], values["lon"], None
    if lat_deg is not None and lon_deg is not None:
        position = make_position(lat_deg, lon_deg, values["alt"])
    elif lat_deg is not None or lon_deg is not None:
        raise UsageError(f"{where} has only one of lat and lon: fill in both, or leave both empty.")
    heading_deg = values["yaw_deg"] if values["heading_deg"] is None else values["heading_deg"]
    return GeoTag(
        position=position,
        heading_deg=None if heading_deg is None else heading_deg % 360,
        t_utc_s=_parse_time_cell(row, where),
        roll_deg=values["roll_deg"],
        pitch_deg=values["pitch_deg"],
        height_m=values["rel_alt"] if values["height_m"] is None else values["height_m"],
    )


def make_position(lat_deg: float, lon_deg: float, alt_m: float | None) -> Position | None:
    """Make a position, or return None for exactly (0, 0), which a receiver without a fix writes."""
    return None if lat_deg == lon_deg == 0 else Position(lat_deg, lon_deg, alt_m)


def _parse_number(row: Mapping[str, str], column: str, low: float, high: float, where: str) -> float | None:
    """Return the number in `column` of a row; None if the cell is empty or missing. Raises UsageError for text that is
    not a number from `low` to `high`."""
    if not (text := row.get(column)):
        return None
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not low <= value <= high:
        raise UsageError(f"{where}: {column} is `{text}`, but must be a number from {low:g} to {high:g}.")
    return value


def _parse_time_cell(row: Mapping[str, str], where: str) -> float | None:
    text = row.get("time")
    try:
        return parse_time(text) if text else None
    except (ValueError, OverflowError):
        raise UsageError(
            f"{where}: time is `{text}`, but must be like 2016-06-23T16:31:59Z or 2016:06:23 16:31:59, or be seconds "
            "since 1970, between the years 1900 and 2200."
        ) from None


def parse_time(text: str) -> float:
    """Convert a time to seconds since 1970 (UTC): `2016:06:23 16:31:59` (EXIF), ISO 8601, or seconds. A time without a
    zone is UTC. Raises ValueError for any other text, and for a year outside 1900 to 2200."""
    try:
        seconds = float(text)
    except ValueError:
        if text[4:5] == text[7:8] == ":":
            text = text.replace(":", "-", 2)
        moment = datetime.fromisoformat(text.replace("Z", "+00:00"))  # Python 3.10 does not accept Z
        seconds = (moment if moment.tzinfo else moment.replace(tzinfo=timezone.utc)).timestamp()
    if not _MIN_TIME_S <= seconds < _MAX_TIME_S:  # false for NaN too
        raise ValueError(f"{text} is not a time between 1900 and 2200")
    return seconds


@dataclass(frozen=True, slots=True)
class Track:
    """Positions and attitudes over time. `t_s`: seconds from the first frame of a video, ascending. `tags`: the tag at
    each time, all with a position. `path`: the table's file, for messages."""

    path: Path
    t_s: tuple[float, ...]
    tags: tuple[GeoTag, ...]

    def interpolate_tag(self, t_s: float) -> GeoTag:
        """Return position, attitude and height at the video time `t_s`, interpolated linearly between the rows before
        and after it. The tag is empty outside the table, and if these rows are more than `MAX_GAP_S` apart."""
        nearest = int(np.abs(np.subtract(self.t_s, t_s)).argmin())
        if abs(self.t_s[nearest] - t_s) <= _TIME_ROUNDING_S:
            return self.tags[nearest]
        upper = int(np.searchsorted(self.t_s, t_s))
        if not 0 < upper < len(self.t_s) or self.t_s[upper] - self.t_s[upper - 1] > MAX_GAP_S:
            return GeoTag()
        earlier, later = (np.array(_to_numbers(tag), float) for tag in self.tags[upper - 1 : upper + 1])  # NaN: unknown
        change = later - earlier
        change[_ANGLE_INDICES] = wrap_deg(change[_ANGLE_INDICES])
        weight = (t_s - self.t_s[upper - 1]) / (self.t_s[upper] - self.t_s[upper - 1])
        numbers: list[Any] = [None if math.isnan(number) else number for number in (earlier + weight * change).tolist()]
        lat_deg, lon_deg, alt_m, heading_deg, roll_deg, pitch_deg, height_m = numbers
        position = Position(lat_deg, wrap_deg(lon_deg), alt_m)
        heading_deg = None if heading_deg is None else heading_deg % 360
        return GeoTag(
            position=position, heading_deg=heading_deg, roll_deg=roll_deg, pitch_deg=pitch_deg, height_m=height_m
        )

    def require_overlap(self, video: Path, duration_s: float) -> None:
        """Raise UsageError if the times of the table and of the video, `duration_s` seconds long, do not overlap."""
        if self.t_s[-1] < -_TIME_ROUNDING_S or self.t_s[0] > duration_s:
            raise UsageError(
                f"{self.path} has positions from {self.t_s[0]:.1f} to {self.t_s[-1]:.1f} s, but {video} runs from 0 "
                f"to {duration_s:.1f} s: `time` must be in seconds from the first frame of the video."
            )


def read_track(csv_path: str | Path) -> Track:
    """Read the table of positions of a video: the columns time (seconds from its first frame, ascending), lat, lon and,
    optionally, those of a positions.csv. Rows without a position are ignored. Raises UsageError for a file that cannot
    be read, an invalid value, and a table without any position."""
    tags: dict[float, GeoTag] = {}
    for where, row in _read_rows(csv_path, _TRACK_COLUMNS):
        tag = _parse_tag(row, where)
        if tag.position is None:
            continue
        if tag.t_utc_s is None or (tags and tag.t_utc_s <= next(reversed(tags))):
            raise UsageError(
                f"{where}: time must be in seconds from the first frame of the video, and later than in the line "
                "before."
            )
        tags[tag.t_utc_s] = replace(tag, t_utc_s=None)
    if not tags:
        raise UsageError(f"{csv_path} has no line with time, lat and lon: add one for each known position.")
    return Track(Path(csv_path), tuple(tags), tuple(tags.values()))
