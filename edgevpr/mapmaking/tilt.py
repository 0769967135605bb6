"""The tilt of a camera that neighbouring images show by themselves, before a map is made of them.

Over flat ground all points of a level camera's image move alike from one image to the next, but for a rotation and a
scale. Seen by a tilted camera the near ground moves farther than the far ground: the motion grows across the image by
its amount times tan(tilt) over the focal length.
"""

import math
from collections.abc import Iterable
from typing import NamedTuple

import cv2
import numpy as np

from edgevpr.core.arrays import Doubles, Image

MAX_UNKNOWN_TILT_DEG = 20.0  # beyond it the ground in the middle lies far from the aircraft: by a third of its height
TYPICAL_FOV_DEG = 66.0
MIN_PAIRS = 8
_WIDTH_PX = 640
FEATURES = 1500
_REPROJECTION_PX = 3.0
_MIN_INLIERS = 40
_MIN_EXTENT = 0.25  # of the longest side, in both directions: points in a corner do not show how motion varies
_MIN_MOTION = 0.1  # of the longest side
_MIN_SIGMA = 3.0  # of the median: hills tilt single pairs by more than cameras are tilted
_MEDIAN_SD = 1.86  # standard deviation of a median of n normal values over their median absolute deviation / sqrt(n)


class Tilt(NamedTuple):
    """Tilt of a camera from straight down in degrees, as `pairs` of images show it: rather too small, by up to a third,
    since the far ground has fewer features."""

    deg: float
    pairs: int


def measure_tilt(images: Iterable[Image], fov_deg: float | None = None) -> Tilt | None:
    """Return the tilt that neighbours among `images` show; None if fewer than MIN_PAIRS overlap well, or show none.

    `images` are uint8 (H, W[, 3]), in the order of flight. `fov_deg` is the field of view of the longest side; None:
    unknown, then TYPICAL_FOV_DEG."""
    orb = cv2.ORB.create(FEATURES)
    slopes: list[Doubles] = []
    reference: Features | None = None
    for features in filter(None, (detect_features(orb, image) for image in images)):
        motion = _measure_motion(reference, features) if reference else None
        if motion and motion.length < _MIN_MOTION:
            continue  # taken in quick succession: the next one shows more
        if motion:
            slopes.append(motion.slope)
        reference = features
    if len(slopes) < MIN_PAIRS:
        return None
    median = np.median(slopes, axis=0)
    deviation = float(np.hypot(*np.median(np.abs(np.array(slopes) - median), axis=0)))
    if np.hypot(*median) < _MIN_SIGMA * _MEDIAN_SD * deviation / math.sqrt(len(slopes)):
        return None
    focal = 0.5 / math.tan(math.radians(fov_deg or TYPICAL_FOV_DEG) / 2)
    return Tilt(math.degrees(math.atan(focal * float(np.hypot(*median)))), len(slopes))


class Features(NamedTuple):
    """Features of an image: `points` (n, 2), shares of its longest side from its middle, and their descriptors."""

    points: Doubles
    descriptors: np.ndarray


def detect_features(orb: cv2.ORB, image: Image) -> Features | None:
    grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    scale = min(1.0, _WIDTH_PX / max(grey.shape))
    small = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    found, descriptors = orb.detectAndCompute(small, None)
    if not found:
        return None
    middle = np.array(small.shape[1::-1]) / 2
    return Features((np.array([point.pt for point in found]) - middle) / max(small.shape), descriptors)


def match_features(before: Features, after: Features) -> tuple[Doubles, Doubles] | None:
    """Return the points (n, 2) of the same ground in two images, both as shares of the longest side from the middle;
    None if they are too few."""
    matches = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True).match(before.descriptors, after.descriptors)
    if len(matches) < _MIN_INLIERS:
        return None
    start = before.points[[match.queryIdx for match in matches]]
    end = after.points[[match.trainIdx for match in matches]]
    homography, inliers = cv2.findHomography(start, end, cv2.RANSAC, _REPROJECTION_PX / _WIDTH_PX)
    if homography is None or inliers.sum() < _MIN_INLIERS:
        return None
    is_inlier = inliers.ravel() > 0
    return start[is_inlier], end[is_inlier]


class _Motion(NamedTuple):
    """Motion from one image to the next: its `length` in the middle, a share of the longest side, and how it varies
    across the image, `slope` (2,): its relative change per longest side to the right and down, which is the tangent of
    the tilt over the focal length."""

    length: float
    slope: Doubles


def _measure_motion(before: Features, after: Features) -> _Motion | None:
    """Return the motion between two images; None if they share too little."""
    pairs = match_features(before, after)
    if pairs is None:
        return None
    start, end = pairs
    if np.ptp(start, axis=0).min() < _MIN_EXTENT:
        return None
    at = np.column_stack([np.ones(len(start)), (start + end) / 2])
    (motion, *slopes), *_ = np.linalg.lstsq(at, end - start, rcond=None)
    # The slope of the motion is the motion times `slope`, a change of scale and a rotation.
    right, down = motion
    parts = [[right, 0, 1, 0], [0, right, 0, -1], [down, 0, 0, 1], [0, down, 1, 0]]
    found, *_ = np.linalg.lstsq(np.array(parts), np.column_stack(slopes).ravel(), rcond=None)
    return _Motion(float(np.hypot(*motion)), np.asarray(found[:2]))
