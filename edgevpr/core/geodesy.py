"""Distances and projections on the Earth, for flights of a few metres to a few kilometres. Angles are in degrees."""

import math
from collections.abc import Iterable
from typing import Any, TypeVar, cast

import numpy as np

from edgevpr.core.arrays import Array, Degrees, Doubles, Floats, LatLon
from edgevpr.core.types import Position

Extent = tuple[float, float, float, float]  # south, west, north, east in degrees
D = TypeVar("D", float, Doubles, Floats)
EARTH_RADIUS_M = 6_371_009.0  # mean radius: over a few kilometres a sphere is within 0.5 % of the ellipsoid


def wrap_deg(angle_deg: D) -> D:
    """Wrap an angle, a scalar or an array, to -180..180 degrees."""
    return (angle_deg + 180) % 360 - 180


def distance_m(lat_deg: Degrees, lon_deg: Degrees, other_lat_deg: D, other_lon_deg: D) -> D:
    """Return the distance in metres between points (scalars, or arrays that broadcast); NaN where either is NaN."""
    north_m, longitude_rad = _north_m_and_longitude_rad(lat_deg, lon_deg, other_lat_deg, other_lon_deg)
    middle_deg = np.add(lat_deg, other_lat_deg) / 2
    return cast(D, np.hypot(north_m, longitude_rad * EARTH_RADIUS_M * np.cos(np.radians(middle_deg))))


def offset_m(lat_deg: Degrees, lon_deg: Degrees, other_lat_deg: D, other_lon_deg: D) -> tuple[D, D]:
    """Return the offset (east, north) in metres from the first point to the other (scalars, or arrays that broadcast),
    on the tangent plane at the first point; NaN where either is NaN."""
    north_m, longitude_rad = _north_m_and_longitude_rad(lat_deg, lon_deg, other_lat_deg, other_lon_deg)
    return cast(D, longitude_rad * EARTH_RADIUS_M * np.cos(np.radians(lat_deg))), cast(D, north_m)


def _north_m_and_longitude_rad(
    lat_deg: Degrees, lon_deg: Degrees, other_lat_deg: Degrees, other_lon_deg: Degrees
) -> tuple[Any, Any]:
    north_m = np.radians(np.subtract(other_lat_deg, lat_deg)) * EARTH_RADIUS_M
    return north_m, np.radians(wrap_deg(np.subtract(other_lon_deg, lon_deg)))  # wrapped: valid across the antimeridian


def project_to_metres(lat_deg: Floats, lon_deg: Floats) -> tuple[Floats, Floats]:
    """Project points, float (N,) each, to metres (east, north), float (N,) each, on the tangent plane at the first
    point that is not NaN. NaN stays NaN."""
    valid = np.flatnonzero(~np.isnan(lat_deg))
    lat_0_deg, lon_0_deg = (lat_deg[valid[0]], lon_deg[valid[0]]) if len(valid) else (0.0, 0.0)
    return offset_m(lat_0_deg, lon_0_deg, lat_deg, lon_deg)


def offset_position(lat_deg: float, lon_deg: float, east_m: float, north_m: float) -> tuple[float, float]:
    """Return the point (lat_deg, lon_deg) that lies `east_m` and `north_m` metres from a point (see `offset_m`)."""
    north_deg = math.degrees(north_m / EARTH_RADIUS_M)
    east_deg = math.degrees(east_m / (EARTH_RADIUS_M * max(math.cos(math.radians(lat_deg)), 1e-9)))
    return lat_deg + north_deg, wrap_deg(lon_deg + east_deg)


def offset_between_m(origin: Position, position: Position) -> tuple[float, float]:
    """Return the offset (east, north) in metres from `origin` to `position`, on the tangent plane at `origin`."""
    return offset_m(origin.lat_deg, origin.lon_deg, position.lat_deg, position.lon_deg)


def move_position(origin: Position, east_m: float, north_m: float, alt_m: float | None = None) -> Position:
    """Return the position, at `alt_m`, `east_m` and `north_m` metres from `origin` (see `offset_between_m`)."""
    return Position(*offset_position(origin.lat_deg, origin.lon_deg, east_m, north_m), alt_m)


def compute_extent(points: Iterable[LatLon]) -> Extent:
    """Return the bounding box of points (lat, lon): south, west, north, east. East may exceed 180."""
    lats_deg, lons_deg = zip(*points, strict=True)
    if max(lons_deg) - min(lons_deg) > 180:
        lons_deg = tuple(lon_deg % 360 for lon_deg in lons_deg)
    return min(lats_deg), min(lons_deg), max(lats_deg), max(lons_deg)


def picture_axes(up_deg: float) -> Doubles:
    """Return the axes on the ground, float64 (2, 2), of a picture whose top points in the compass direction `up_deg`.
    The columns are the unit vectors (east, north) towards the picture's right and towards its top."""
    up = math.radians(up_deg)
    return np.array([[math.cos(up), math.sin(up)], [-math.sin(up), math.cos(up)]])


def fit_similarity(points: Array, targets: Array, weights: Doubles | None = None) -> tuple[complex, complex]:
    """Return the factor (rotation and scale) and the offset of the least-squares fit factor * `points` + offset =
    `targets`, complex (N,) each. `weights` (N,) weight the squared errors. The factor is 1 for a single point."""
    if weights is None:
        middle, target = points.mean(), targets.mean()
        spread = np.vdot(points - middle, points - middle).real
        covariance = np.vdot(points - middle, targets - target)
    else:
        middle, target = np.average(points, weights=weights), np.average(targets, weights=weights)
        spread = np.sum(weights * abs(points - middle) ** 2)
        covariance = np.sum(weights * np.conj(points - middle) * (targets - target))
    factor = covariance / spread if spread > 0 else 1.0 + 0j
    return factor, target - factor * middle
