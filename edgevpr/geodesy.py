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
