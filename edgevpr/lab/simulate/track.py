"""The track of a flight over an orthophoto: from the lines of a positions.csv, or along the waypoints of a mission."""

from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from edgevpr.core.errors import UsageError
from edgevpr.core.geodesy import distance_m, offset_m
from edgevpr.core.types import Position
from edgevpr.frames.positions import number_in, rows_of, tag_of
from edgevpr.mapmaking.missions import Waypoint, read_area

_HEIGHT_M = (1.0, 10_000.0)
_MOST_PICTURES = 100_000


@dataclass(frozen=True, slots=True, kw_only=True)
class Shot:
    """One picture to be taken: `height_m` over the ground, attitude in degrees as of `camera.Pose` (None: not told),
    and `t_s` from the start of the flight."""

    position: Position
    height_m: float
    t_s: float
    heading_deg: float
    roll_deg: float | None = None
    pitch_deg: float | None = None


def read_shots(path: str | Path, height_m: float | None, every_m: float, speed_m_s: float) -> list[Shot]:
    """Read a track. Each line of a positions.csv is a picture (columns lat and lon, and where present height_m,
    roll_deg, pitch_deg, yaw_deg); along the waypoints of a mission file there is one `every_m`. `height_m` goes before
    the heights of the file. Raises UsageError for a track that cannot be read, has no height or no picture."""
    if Path(path).suffix.lower() == ".csv":
        shots = _of_lines(path, height_m)
    else:
        shots = _of_mission(path, height_m, every_m)
    if not shots:
        raise UsageError(f"{path} has no line with lat and lon: a track needs them.")
    return _flown(shots, speed_m_s)


def _of_lines(path: str | Path, height_m: float | None) -> list[Shot]:
    shots = []
    for where, row in rows_of(path):
        position = tag_of(row, where).position
        over_m = height_m or number_in(row, "height_m", *_HEIGHT_M, where)
        if position and over_m is None:
            raise UsageError(f"{where} has no height_m (metres over the ground): add the column, or give --height-m.")
        if position:
            tilt = {name: number_in(row, name, -60, 60, where) for name in ("roll_deg", "pitch_deg")}
            heading_deg = tag_of(row, where).heading_deg
            heading_deg = np.nan if heading_deg is None else heading_deg
            shots.append(Shot(position=position, height_m=over_m, t_s=0.0, heading_deg=heading_deg, **tilt))
    return shots


def _of_mission(path: str | Path, height_m: float | None, every_m: float) -> list[Shot]:
    waypoints = [way for part in read_area(path).paths for way in part]
    heights_m = [height_m or way.height_m for way in waypoints]
    told = [each for each in heights_m if each is not None]
    if len(waypoints) < 2 or not told:
        lacks = "no path of waypoints" if len(waypoints) < 2 else "no heights over the ground: give --height-m"
        raise UsageError(f"{path} has {lacks}.")
    for at, each in enumerate(heights_m):  # home and landings: the height of the waypoint before, or of the first
        heights_m[at] = told[0] if each is None and at == 0 else heights_m[at - 1] if each is None else each
    lat_deg, lon_deg = (np.array([getattr(way, name) for way in waypoints]) for name in ("lat_deg", "lon_deg"))
    way_m = np.append(0, np.cumsum(distance_m(lat_deg[:-1], lon_deg[:-1], lat_deg[1:], lon_deg[1:])))
    if way_m[-1] / every_m > _MOST_PICTURES:
        raise UsageError(
            f"{path} is {way_m[-1] / 1000:,.0f} km long, and {_MOST_PICTURES:,} pictures are written at most: give a "
            "larger --every-m."
        )
    at_m = np.arange(0, way_m[-1] + 1e-6, every_m)
    columns = (np.interp(at_m, way_m, values) for values in (lat_deg, lon_deg, heights_m))
    legs = np.clip(np.searchsorted(way_m, at_m, side="right") - 1, 0, len(way_m) - 2)
    courses_deg = [_course_deg(one, other) for one, other in pairwise(waypoints)]
    return [
        Shot(position=Position(float(lat), float(lon)), height_m=float(over_m), t_s=0.0, heading_deg=courses_deg[leg])
        for lat, lon, over_m, leg in zip(*columns, legs, strict=True)
    ]


def _flown(shots: list[Shot], speed_m_s: float) -> list[Shot]:
    """Give each picture its time, at a constant speed, and the course as its heading where none is told."""
    flown, t_s, course_deg = [], 0.0, 0.0
    for at, shot in enumerate(shots):
        here, there = (shots[at - 1], shot) if at else (shot, shots[min(1, len(shots) - 1)])
        way_m = _way_m(here.position, there.position)
        if way_m > 0:
            course_deg = _course_deg(here.position, there.position)
        t_s += way_m / speed_m_s if at else 0.0
        flown.append(replace(shot, t_s=t_s, heading_deg=course_deg if np.isnan(shot.heading_deg) else shot.heading_deg))
    return flown


def _way_m(one: Position, other: Position) -> float:
    return float(distance_m(one.lat_deg, one.lon_deg, other.lat_deg, other.lon_deg))


def _course_deg(one: Position | Waypoint, other: Position | Waypoint) -> float:
    east_m, north_m = offset_m(one.lat_deg, one.lon_deg, other.lat_deg, other.lon_deg)
    return float(np.degrees(np.arctan2(east_m, north_m)) % 360)
