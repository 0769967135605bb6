"""Reads the area of a flight: the path in a waypoint file or QGroundControl plan, or a circle. The area limits the part
of an orthophoto that becomes a map, and the part of a map that is cut out for a flight."""

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
    raise UsageError("Areas and missions need shapely, which is not installed: run `pip install shapely`.") from error

_MAX_FILE_BYTES = 50_000_000
_WAYPOINT_COLUMNS = 12
# The MAV_CMDs that fly to their position: waypoint, loiter (unlimited, turns, time, to altitude), land, takeoff, spline
# waypoint, VTOL takeoff and VTOL land. With other commands, such as a region of interest, the camera only points at it.
_NAV_COMMANDS = {16, 17, 18, 19, 21, 22, 31, 82, 84, 85}
_RELATIVE_FRAMES = {3, 6, 10, 11}  # MAV_FRAMEs with altitude relative to home or the terrain
_CIRCLE_PATTERN = re.compile(r"\s*-?[\d.]+\s*,\s*-?[\d.]+\s*,\s*-?[\d.]+\s*")  # LAT,LON,RADIUS_M
_MAX_RADIUS_M = 200_000.0
_QUARTER_SEGMENTS = 64  # segments per quarter circle of a buffer: accurate to 0.01 % of its width
_FAR_M = 1e8
_MALFORMED = (ValueError, KeyError, TypeError, IndexError, AttributeError, OverflowError, RecursionError)

Projection = Callable[[Doubles, Doubles], tuple[Any, Any]]  # from latitudes and longitudes to x and y in metres


@dataclass(frozen=True, slots=True)
class Waypoint:
    """A point of a path in degrees, and its height in metres above home or the terrain (None: not in the file)."""

    lat_deg: float
    lon_deg: float
    height_m: float | None = None


@dataclass(frozen=True, slots=True)
class Area:
    """The ground of a flight: along the waypoints of a mission, `path`, in the order of flight, or inside a circle. A
    circle has one waypoint, its centre, and a `radius_m` above 0."""

    path: tuple[Waypoint, ...]
    radius_m: float = 0.0

    @property
    def extent_deg(self) -> Extent:
        """The bounding box of the path or circle (see `compute_extent`)."""
        sides_m = (-self.radius_m, self.radius_m)
        return compute_extent([offset_position(wp.lat_deg, wp.lon_deg, m, m) for wp in self.path for m in sides_m])

    def project_ground(self, project: Projection, circle_margin_m: float, path_margin_m: float) -> "shapely.Geometry":
        """Return the ground within these margins of the circle or path, projected to a plane by `project`."""
        waypoints = (*self.path, self.path[-1])  # a LineString needs at least two points
        points: Doubles = np.column_stack(project(*np.array([(wp.lat_deg, wp.lon_deg) for wp in waypoints]).T))
        # A point that cannot be projected is far away.
        line = shapely.LineString(np.nan_to_num(points, nan=_FAR_M, posinf=_FAR_M))
        margin_m = self.radius_m + circle_margin_m if self.radius_m else path_margin_m
        ground = shapely.buffer(line, margin_m, quad_segs=_QUARTER_SEGMENTS)
        shapely.prepare(ground)
        return ground


def read_area(path: str | Path) -> Area:
    """Read a waypoint file (QGC WPL 110), a QGroundControl .plan, or a circle in the form LAT,LON,RADIUS_M.
    Raises UsageError if the file has neither format, contains no waypoints, or has a position outside -90..90 or
    -180..180 degrees."""
    try:
        if _CIRCLE_PATTERN.fullmatch(str(path)):
            return _make_circle(*map(float, str(path).split(",")))
        text = read_file(path, _MAX_FILE_BYTES).decode("utf-8-sig")
        is_wpl = text.startswith("QGC WPL")
        waypoints = _read_waypoints(text.splitlines()) if is_wpl else _read_plan(json.loads(text)["mission"]["items"])
    except OSError as error:
        raise UsageError(
            f"{path} cannot be read ({error.strerror}): pass a mission file, or LAT,LON,RADIUS_M."
        ) from error
    except _MALFORMED:
        raise UsageError(
            f"{path} is not a valid waypoint file (QGC WPL 110) or QGroundControl .plan: save the mission again."
        ) from None
    if not waypoints:
        raise UsageError(f"{path} contains no waypoints: save the mission again.")
    if any(abs(wp.lat_deg) > 90 or abs(wp.lon_deg) > 180 for wp in waypoints):
        raise UsageError(f"{path} has invalid coordinates: positions must be WGS-84 degrees (-90..90, -180..180).")
    return Area(tuple(waypoints))


def _make_circle(lat_deg: float, lon_deg: float, radius_m: float) -> Area:
    if not (abs(lat_deg) < 90 and abs(lon_deg) <= 180 and 0 < radius_m <= _MAX_RADIUS_M):
        raise UsageError(
            f"--area is {lat_deg:g},{lon_deg:g},{radius_m:g}, but a circle must be LAT,LON,RADIUS_M, in WGS-84 degrees "
            f"and metres (at most {_MAX_RADIUS_M:,.0f})."
        )
    return Area((Waypoint(lat_deg, lon_deg),), radius_m)


def _read_waypoints(lines: list[str]) -> list[Waypoint]:
    """Read the lines of a waypoint file. The first is a header; the columns of the others are index, current, frame,
    command, four parameters, lat, lon, alt, autocontinue."""
    path: list[Waypoint] = []
    for values in filter(None, map(str.split, lines[1:])):
        if len(values) != _WAYPOINT_COLUMNS:
            raise ValueError
        path += _parse_waypoint(int(values[3]), int(values[2]), values[8:11])
    return path


def _parse_waypoint(command: int, frame: int, location: Sequence[float | str | None]) -> list[Waypoint]:
    """Return a list with the waypoint of a mission item; empty if the aircraft does not fly to it. `command` is a
    MAV_CMD, `frame` a MAV_FRAME, `location` latitude, longitude and altitude; (0, 0) is the aircraft's own position."""
    lat_deg, lon_deg, alt_m = map(_parse_finite, location)
    if command not in _NAV_COMMANDS or lat_deg == lon_deg == 0:
        return []
    # No pictures are taken from height 0, as at home or on landing, so this height counts as missing.
    return [Waypoint(lat_deg, lon_deg, alt_m if frame in _RELATIVE_FRAMES and alt_m > 0 else None)]


def _read_plan(items: list[dict[str, Any]]) -> list[Waypoint]:
    """Read the items of a plan: simple items, surveys and corridor scans, which store the waypoints computed from their
    polygon, and structure scans, which have only a polygon. Values that are left to the autopilot are null."""
    path: list[Waypoint] = []
    for item in items:
        if item["type"] == "SimpleItem":
            path += _parse_waypoint(int(item["command"]), int(item["frame"]), item["params"][4:7])
            continue
        style = item.get("TransectStyleComplexItem", {})
        height_m = style.get("CameraCalc", {}).get("DistanceToSurface")
        outline = item.get("polygon", ())  # the path of a structure scan
        points = style.get("VisualTransectPoints") or (*outline, *outline[:1])
        path += [Waypoint(_parse_finite(lat_deg), _parse_finite(lon_deg), height_m) for lat_deg, lon_deg, *_ in points]
    return path


def _parse_finite(value: float | str | None) -> float:
    if not math.isfinite(number := float(value or 0)):
        raise ValueError
    return number
