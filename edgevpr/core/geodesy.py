"""Distances on the Earth, for flights of some metres to some kilometres."""

import math

import numpy as np

EARTH_RADIUS_M = 6_371_009.0  # mean radius: over a few kilometres a sphere is within 0.5 % of the ellipsoid


def distance_m(lat_deg, lon_deg, other_lat_deg, other_lon_deg):
    """Return the metres between points given in degrees (scalars, or arrays that broadcast); NaN stays NaN."""
    north_m = np.radians(np.subtract(other_lat_deg, lat_deg)) * EARTH_RADIUS_M
    turn_deg = (np.subtract(other_lon_deg, lon_deg) + 180) % 360 - 180  # the shorter way, also across the date line
    middle_deg = np.add(lat_deg, other_lat_deg) / 2
    east_m = np.radians(turn_deg) * EARTH_RADIUS_M * np.cos(np.radians(middle_deg))
    return np.hypot(north_m, east_m)


def offset_m(lat_deg, lon_deg, other_lat_deg, other_lon_deg):
    """Return the metres (east, north) from a point to others (scalars, or arrays that broadcast), on the plane that
    touches the Earth at the point; NaN stays NaN."""
    north_m = np.radians(np.subtract(other_lat_deg, lat_deg)) * EARTH_RADIUS_M
    turn_deg = (np.subtract(other_lon_deg, lon_deg) + 180) % 360 - 180
    return np.radians(turn_deg) * EARTH_RADIUS_M * np.cos(np.radians(lat_deg)), north_m


def metres(lat_deg: np.ndarray, lon_deg: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Project places (N,), degrees, to metres (east, north) on the plane that touches the Earth at the first known
    place; NaN stays NaN."""
    known = np.flatnonzero(~np.isnan(lat_deg))
    lat_0_deg, lon_0_deg = (lat_deg[known[0]], lon_deg[known[0]]) if len(known) else (0.0, 0.0)
    return offset_m(lat_0_deg, lon_0_deg, lat_deg, lon_deg)


def moved(lat_deg: float, lon_deg: float, east_m: float, north_m: float) -> tuple[float, float]:
    """Return the point (lat_deg, lon_deg) that is so many metres east and north of a point: the reverse of
    `offset_m`."""
    north_deg = math.degrees(north_m / EARTH_RADIUS_M)
    east_deg = math.degrees(east_m / (EARTH_RADIUS_M * max(math.cos(math.radians(lat_deg)), 1e-9)))
    return lat_deg + north_deg, (lon_deg + east_deg + 180) % 360 - 180


def axes_of(up_deg: float) -> np.ndarray:
    """Return the directions on the ground of the right and of the top of a picture, as the columns of a matrix (2, 2):
    east and north of each. The top points to the compass direction `up_deg`."""
    up = math.radians(up_deg)
    return np.array([[math.cos(up), math.sin(up)], [-math.sin(up), math.cos(up)]])
