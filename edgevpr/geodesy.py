"""Distances on the Earth, for the metres to kilometres of a flight."""

import numpy as np

EARTH_RADIUS_M = 6_371_009.0  # mean radius: over a few kilometres a sphere is within 0.5 % of the ellipsoid


def distance_m(lat_deg, lon_deg, other_lat_deg, other_lon_deg):
    """Metres between two points (scalars or arrays that broadcast, degrees); NaN where a coordinate is NaN."""
    north_m = np.radians(np.subtract(other_lat_deg, lat_deg)) * EARTH_RADIUS_M
    turn_deg = (np.subtract(other_lon_deg, lon_deg) + 180) % 360 - 180  # the short way round the date line
    middle_deg = np.add(lat_deg, other_lat_deg) / 2
    east_m = np.radians(turn_deg) * EARTH_RADIUS_M * np.cos(np.radians(middle_deg))
    return np.hypot(north_m, east_m)


def metres(lat_deg: np.ndarray, lon_deg: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Places (N,) as metres (east, north) on the plane that touches the Earth at the first known one; NaN stays NaN."""
    known = np.flatnonzero(~np.isnan(lat_deg))
    lat_0_deg, lon_0_deg = (lat_deg[known[0]], lon_deg[known[0]]) if len(known) else (0.0, 0.0)
    north_m = np.radians(lat_deg - lat_0_deg) * EARTH_RADIUS_M
    turn_deg = (lon_deg - lon_0_deg + 180) % 360 - 180
    return np.radians(turn_deg) * EARTH_RADIUS_M * np.cos(np.radians(lat_0_deg)), north_m
