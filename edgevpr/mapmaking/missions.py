"""Reading of paths to be flown over, waypoint files and plans of QGroundControl, and of circles. They limit the part of
an orthophoto from which a map is made, and of a map the part that a flight takes."""

import json
import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from edgevpr.core.arrays import Doubles
from edgevpr.core.errors import UsageError
from edgevpr.core.files import read_file
from edgevpr.core.geodesy import Extent, compute_extent, offset_position

try:
    import shapely as shapely
except ModuleNotFoundError as error:
    raise UsageError("Areas and missions are laid out with shapely: run `pip install shapely`.") from error

_MAX_FILE_BYTES = 50_000_000
_WAYPOINT_COLUMNS = 12
# The MAV_CMDs whose position an aircraft flies to: waypoint, loiter (unlimited, turns, time, to altitude), land, take
# off, spline, and take off and land of a VTOL. Others, such as a region of interest, have a position to look at.
_FLOWN_COMMANDS = {16, 17, 18, 19, 21, 22, 31, 82, 84, 85}
_RELATIVE_FRAMES = {3, 6, 10, 11}  # MAV_FRAMEs whose altitude is relative to home or the terrain
_CIRCLE_PATTERN = re.compile(r"\s*-?[\d.]+\s*,\s*-?[\d.]+\s*,\s*-?[\d.]+\s*")  # LAT,LON,RADIUS_M
_MAX_RADIUS_M = 200_000.0
_QUARTER_SEGMENTS = 64  # of a buffer's round corners: exact to 0.01 % of its width
_FAR_M = 1e8
_MALFORMED = (ValueError, KeyError, TypeError, IndexError, AttributeError, OverflowError, RecursionError)

Projection = Callable[[Doubles, Doubles], tuple[Any, Any]]  # latitudes and longitudes, to x and y in metres


@dataclass(frozen=True, slots=True)
class Waypoint:
    """A point of a path in degrees, and its height in metres over home or the ground (None: the file gives none)."""

    lat_deg: float
    lon_deg: float
    height_m: float | None = None


@dataclass(frozen=True, slots=True)
class Area:
    """The ground around the waypoints of a mission, `path`, in the order of flight. A circle has one waypoint, in its
    middle, and a `radius_m` (0: a mission)."""

    path: tuple[Waypoint, ...]
    radius_m: float = 0.0

    @property
    def extent_deg(self) -> Extent:
        """The bounding box of path or circle, see `compute_extent`."""
        sides_m = (-self.radius_m, self.radius_m)
        return compute_extent([offset_position(at.lat_deg, at.lon_deg, m, m) for at in self.path for m in sides_m])

    def project_ground(self, project: Projection, circle_margin_m: float, path_margin_m: float) -> "shapely.Geometry":
        """Return the ground within these margins of the circle or of the path, on a plane."""
        way = (*self.path, self.path[-1])  # a line has two points or more
        points: Doubles = np.column_stack(project(*np.array([(at.lat_deg, at.lon_deg) for at in way]).T))
        # What cannot be projected is far away.
        line = shapely.LineString(np.nan_to_num(points, nan=_FAR_M, posinf=_FAR_M))
        margin_m = self.radius_m + circle_margin_m if self.radius_m else path_margin_m
        ground = shapely.buffer(line, margin_m, quad_segs=_QUARTER_SEGMENTS)
        shapely.prepare(ground)
        return ground


def read_area(path: str | Path) -> Area:
    """Read a waypoint file (QGC WPL 110), a .plan of QGroundControl, or the circle that the text LAT,LON,RADIUS_M
    describes. Raises UsageError for a file that is none of them, holds no position, or has one
    beyond -90..90 or -180..180 degrees."""
    try:
        if _CIRCLE_PATTERN.fullmatch(str(path)):
            return _make_circle(*map(float, str(path).split(",")))
        text = read_file(path, _MAX_FILE_BYTES).decode("utf-8-sig")
        is_list = text.startswith("QGC WPL")
        way = _read_waypoints(text.splitlines()) if is_list else _read_plan(json.loads(text)["mission"]["items"])
    except OSError as error:
        raise UsageError(
            f"{path} cannot be read ({error.strerror}): give a mission file, or LAT,LON,RADIUS_M."
        ) from error
    except _MALFORMED:
        raise UsageError(
            f"{path} is no waypoint file (QGC WPL 110) and no .plan of QGroundControl that can be understood: save it "
            "again."
        ) from None
    if not way:
        raise UsageError(f"{path} holds no position to fly to: save the mission again.")
    if any(abs(at.lat_deg) > 90 or abs(at.lon_deg) > 180 for at in way):
        raise UsageError(f"{path} has positions beyond the globe: they must be degrees of WGS-84.")
    return Area(tuple(way))


def _make_circle(lat_deg: float, lon_deg: float, radius_m: float) -> Area:
    if not (abs(lat_deg) < 90 and abs(lon_deg) <= 180 and 0 < radius_m <= _MAX_RADIUS_M):
        raise UsageError(
            f"--area {lat_deg:g},{lon_deg:g},{radius_m:g}: write LAT,LON,RADIUS_M, in degrees of WGS-84 and metres (at "
            f"most {_MAX_RADIUS_M:,.0f})."
        )
    return Area((Waypoint(lat_deg, lon_deg),), radius_m)


def _read_waypoints(lines: list[str]) -> list[Waypoint]:
    """Read a waypoint file. The first line is a heading; the columns of the others are index, current, frame, command,
    four parameters, lat, lon, alt, autocontinue."""
    path: list[Waypoint] = []
    for values in filter(None, map(str.split, lines[1:])):
        if len(values) != _WAYPOINT_COLUMNS:
            raise ValueError
        path += _parse_waypoint(int(values[3]), int(values[2]), values[8:11])
    return path


def _parse_waypoint(command: int, frame: int, where: Sequence[float | str | None]) -> list[Waypoint]:
    """Return the waypoint of a mission item in a list, empty for an item that is not flown to. `command` is a MAV_CMD,
    `frame` a MAV_FRAME, `where` latitude, longitude and altitude; (0, 0) means the aircraft's present position."""
    lat_deg, lon_deg, alt_m = map(_parse_finite, where)
    if command not in _FLOWN_COMMANDS or lat_deg == lon_deg == 0:
        return []
    # Height 0, as of home and a landing, is not that from which pictures are taken: it counts as not given.
    return [Waypoint(lat_deg, lon_deg, alt_m if frame in _RELATIVE_FRAMES and alt_m > 0 else None)]


def _read_plan(items: list[dict[str, Any]]) -> list[Waypoint]:
    """Read the items of a plan: simple items, and surveys and corridors, which have the waypoints computed from their
    polygon. A plan has null for numbers that it leaves to the autopilot."""
    path: list[Waypoint] = []
    for item in items:
        if item["type"] == "SimpleItem":
            path += _parse_waypoint(int(item["command"]), int(item["frame"]), item["params"][4:7])
            continue
        style = item.get("TransectStyleComplexItem", {})
        height_m = style.get("CameraCalc", {}).get("DistanceToSurface")
        points = style.get("VisualTransectPoints", ())
        path += [Waypoint(_parse_finite(lat_deg), _parse_finite(lon_deg), height_m) for lat_deg, lon_deg, *_ in points]
    return path


def _parse_finite(value: float | str | None) -> float:
    if not math.isfinite(number := float(value or 0)):
        raise ValueError
    return number
