"""Tables of pictures and their positions written by other programs: exiftool (-csv), Pix4D, Metashape, OpenDroneMap
(geo.txt). Separator and columns are detected, and reported to the user."""

import csv
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path, PureWindowsPath

from edgevpr.core.errors import UsageError
from edgevpr.core.files import read_file
from edgevpr.frames.exif import to_nadir_angles
from edgevpr.frames.images import is_image
from edgevpr.frames.positions import GeoTag, is_like_position, parse_time
from edgevpr.tracks.record import Attitude, Record, make_tag

_MAX_FILE_BYTES = 100_000_000
_SEPARATORS = {";": "semicolons", "\t": "tabs", ",": "commas", " ": "spaces"}
_MAX_HEADER_ROWS = 10  # rows that are searched for the column names
# Column names, reduced to letters; the first one that is present is used. Those of exiftool's `Composite` group have a
# sign; others may have it in another column, whose name ends with `Ref`.
_COLUMN_NAMES = {
    "file": ("sourcefile", "filename", "file", "imagename", "image", "label", "photo", "name"),
    "lat": ("compositegpslatitude", "latitude", "lat", "gpslatitude", "ylatitude"),
    "lon": ("compositegpslongitude", "longitude", "lon", "lng", "long", "gpslongitude", "xlongitude"),
    "alt": ("altitude", "alt", "gpsaltitude", "absolutealtitude", "zaltitude", "elevation"),
    "height": ("relativealtitude", "relalt", "heightm", "height"),
    "nose": ("yawdeg", "headingdeg", "yaw", "heading", "flightyawdegree", "gpsimgdirection", "gpsgpsimgdirection"),
    "nose_roll": ("rolldeg",),
    "nose_pitch": ("pitchdeg",),
    "yaw": ("gimbalyawdegree",),
    "pitch": ("gimbalpitchdegree",),
    "roll": ("gimbalrolldegree",),
    "time": ("datetimeoriginal", "time"),
}
_REQUIRED_COLUMNS = ("file", "lat", "lon")
_DEFAULT_COLUMNS = ("file", "lat", "lon", "alt")  # in Pix4D's order
_OPENDRONEMAP_COLUMNS = ("file", "lon", "lat", "alt")
_WGS84 = re.compile(r"epsg:4326|wgs\s?84(?!\s*/?\s*utm)|\+proj=(longlat|latlong)", re.IGNORECASE)
_NON_LETTERS = re.compile(r"\[.*?\]|\(.*?\)|[^a-z]")
_OTHER_UNIT = re.compile(r"(?:\[|\(|_| )(ft|feet|foot|rad|radians?)[\])]?$", re.IGNORECASE)
_NUMBERS = re.compile(r"[-+]?\d+(?:[.,]\d+)?")
_PROJECTION = re.compile(r"epsg:\d+|wgs\s?84|\+proj=", re.IGNORECASE)

Rows = Sequence[Sequence[str]]
Layout = tuple[Mapping[str, int], int, Sequence[str]]  # column of each part, first row of values, and column names


def read_table(path: Path) -> Record:
    """Read a table of pictures. Raises UsageError for a table without columns for picture, latitude and longitude, and
    for an invalid value."""
    try:
        text = read_file(path, _MAX_FILE_BYTES).decode("utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise UsageError(f"{path} cannot be read as text ({error}): save the table as CSV in UTF-8.") from error
    lines, default_columns = [line for line in text.splitlines() if line.strip(" \t;,")], _DEFAULT_COLUMNS
    if lines and _PROJECTION.match(lines[0]):
        if not _WGS84.match(lines[0]):
            raise UsageError(f"{path} uses `{lines[0]:.40}`: export it in latitude and longitude (WGS 84).")
        lines, default_columns = lines[1:], _OPENDRONEMAP_COLUMNS
    for separator, separator_name in _SEPARATORS.items():
        rows = list(csv.reader(lines, delimiter=separator, skipinitialspace=True))
        if layout := _find_columns(rows):
            columns, first, names = layout
        elif (
            rows and len(rows[0]) >= len(_REQUIRED_COLUMNS) and is_image(rows[0][0].strip())
        ):  # no names: the usual order
            columns, first, names = {part: column for column, part in enumerate(default_columns)}, 0, default_columns
        else:
            continue
        used = ", ".join(f"`{names[column]}`" for part, column in columns.items() if part in _REQUIRED_COLUMNS)
        if others := [names[column] for column in columns.values() if _OTHER_UNIT.search(names[column])]:
            raise UsageError(f"{path}: `{others[0]}` must be in metres or degrees: convert it and rename the column.")
        tags = _read_rows(rows[first:], columns, path)
        unused = [name for index, name in enumerate(names) if index not in columns.values()]
        unused = [f"`{name}`" for name in unused if is_like_position(name)]
        ignored = f"; not used: {', '.join(unused)}" if unused else ""
        return Record(kind=f"table of {used}, separated by {separator_name}{ignored}", tags_by_name=tags)
    raise UsageError(f"{path}: no columns for image, latitude and longitude: name them file, lat and lon in line 1.")


def _find_columns(rows: Rows) -> Layout | None:
    """Find the row with the column names."""
    for index, row in enumerate(rows[:_MAX_HEADER_ROWS]):
        names = [_NON_LETTERS.sub("", cell.lower()) for cell in row]
        indices = {part: _find_column(part_names, names) for part, part_names in _COLUMN_NAMES.items()}
        columns = {part: column for part, column in indices.items() if column is not None}
        for part in ("lat", "lon", "nose"):
            if part in columns and (ref := f"{names[columns[part]]}ref") in names:
                columns[f"{part}_ref"] = names.index(ref)
        is_split = not any(separator in cell for cell in row for separator in ",;\t")
        if is_split and columns.keys() >= set(_REQUIRED_COLUMNS):
            return columns, index + 1, row
    return None


def _find_column(choices: Sequence[str], names: Sequence[str]) -> int | None:
    """Return the column of the first of `choices`, else of an angle whose name ends with it (`vehicle latitude`)."""
    exact = [names.index(name) for name in choices if name in names]
    is_angle = choices[1:2] in (("latitude",), ("longitude",))
    angles = [column for column, name in enumerate(names) if is_angle and name.endswith(choices[1])]
    return next(iter([*exact, *angles]), None)


def _read_rows(rows: Rows, columns: Mapping[str, int], path: Path) -> dict[str, GeoTag]:
    """Return the tags by file name; by `FOLDER/NAME` where images of several folders have the same name."""
    tags_by_path: dict[tuple[str, str], GeoTag] = {}
    for row in rows:
        cells = {part: row[column].strip() for part, column in columns.items() if column < len(row)}
        try:
            file, tag = PureWindowsPath(cells["file"]), _parse_row(cells)
        except (KeyError, ValueError) as error:
            raise UsageError(f"{path}: `{' '.join(row):.80}` is invalid ({error}): correct this line.") from error
        if tags_by_path.setdefault((file.parent.name, file.name), tag) != tag:
            raise UsageError(f"{path} has two different rows for `{file.name}`: keep that of the image in this folder.")
    counts = Counter(name for _, name in tags_by_path)
    tags = {f"{folder}/{name}" if counts[name] > 1 else name: tag for (folder, name), tag in tags_by_path.items()}
    if tags and not any(tag.position for tag in tags.values()):
        raise UsageError(f"{path} has no valid position: are latitude and longitude swapped, or not in degrees?")
    return tags


def _parse_row(cells: Mapping[str, str]) -> GeoTag:
    """Make a tag from a row's cells; an impossible position becomes unknown. Raises ValueError for other text."""
    refs = {part: cells.get(f"{part}_ref", "").upper()[:1] for part in ("lat", "lon", "nose")}
    numbers = {part: text for part, text in cells.items() if part not in ("file", "time") and not part.endswith("_ref")}
    values = {part: _parse_angle(text) for part, text in numbers.items() if text}
    for part in ("lat", "lon"):
        if refs[part] in ("S", "W") and part in values:
            values[part] = -abs(values[part])
    if refs["nose"] == "M":  # magnetic north
        values.pop("nose", None)
    attitude: Attitude = (values.get("nose"), values.get("nose_roll"), values.get("nose_pitch"))
    if {"yaw", "pitch"} <= values.keys():
        attitude = to_nadir_angles(values["yaw"], values["pitch"], values.get("roll", 0.0))
    tag = make_tag(values.get("lat"), values.get("lon"), values.get("alt"), attitude, values.get("height"))
    with suppress(KeyError, ValueError, OverflowError):  # no time, or an unreadable one
        return replace(tag, t_utc_s=parse_time(cells["time"]))
    return tag


def _parse_angle(text: str) -> float:
    """Convert `50.05`, `50,05`, `50.05 N`, `50 deg 3' 12.30" N`, or a height `12.3 m`. Raises ValueError otherwise."""
    numbers = _NUMBERS.findall(text)
    if not 1 <= len(numbers) <= 3:
        raise ValueError(f"{text} is not a number")
    value: float = sum(abs(float(part.replace(",", "."))) / 60**power for power, part in enumerate(numbers))
    is_negative = numbers[0].startswith("-") or text.rstrip().upper().endswith(("S", "W", "BELOW SEA LEVEL"))
    return -value if is_negative else value
