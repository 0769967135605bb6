"""The ground that a picture straight down shows, and how much of it two pictures share."""

import math
from dataclasses import dataclass

import numpy as np

from edgevpr.frames.opencv import cv2


@dataclass(frozen=True, slots=True)
class Footprint:
    """A rectangle on flat ground: its middle (east, north), metres from a common point, the lengths of its sides from
    left to right and from top to bottom of the picture, and the direction of the top of the picture (0..360)."""

    middle_m: tuple[float, float]
    sides_m: tuple[float, float]
    up_deg: float


def footprint(
    middle_m: tuple[float, float], height_m: float, fov_deg: float, size_px: tuple[int, int], up_deg: float
) -> Footprint:
    """Make the footprint of a picture of this size (width, height), taken from `height_m` above flat ground with a
    field of view of `fov_deg` across its longest side."""
    longest_m = 2 * height_m * math.tan(math.radians(fov_deg) / 2)
    width_m, depth_m = (longest_m * each / max(size_px) for each in size_px)
    return Footprint(middle_m, (width_m, depth_m), up_deg)


def shared(one: Footprint, other: Footprint) -> float:
    """Return the share of the smaller footprint that lies in the other, 0..1."""
    _, corners = cv2.rotatedRectangleIntersection(_rectangle(one), _rectangle(other))
    if corners is None:
        return 0.0
    area_m2 = cv2.contourArea(cv2.convexHull(np.asarray(corners, np.float32)))
    return min(1.0, float(area_m2) / min(math.prod(one.sides_m), math.prod(other.sides_m)))


def _rectangle(print_: Footprint) -> tuple[tuple[float, float], tuple[float, float], float]:
    east_m, north_m = print_.middle_m
    return (east_m, -north_m), print_.sides_m, print_.up_deg  # of a picture whose rows go south
