"""Measures the tilt of a camera from neighbouring images, before a map is made from them.

Over flat ground, all image points of a level camera move equally between images, apart from a rotation and a scale.
With a tilted camera, near ground moves farther than distant ground: the relative change of the motion across the image
is tan(tilt) / focal length."""

import math
from collections.abc import Iterable
from typing import NamedTuple

import cv2
import numpy as np

from edgevpr.core.arrays import Doubles, Image

MAX_UNKNOWN_TILT_DEG = 20.0  # at this tilt the image centre is a third of the height away from the nadir
TYPICAL_FOV_DEG = 66.0
MIN_PAIRS = 8
_WIDTH_PX = 640
FEATURES = 1500
_REPROJECTION_PX = 3.0
_MIN_INLIERS = 40
_MIN_EXTENT = 0.25  # of the longest side, in both directions; clustered points do not show how motion varies
_MIN_MOTION = 0.1  # of the longest side
_MIN_SIGMA = 3.0  # of the median; in single pairs, hills look like more tilt than cameras have
_MEDIAN_SD = 1.86  # standard deviation of the median of n normal values, in median absolute deviations / sqrt(n)


class Tilt(NamedTuple):
    """Tilt of a camera from straight down in degrees, measured from `pairs` image pairs. It is underestimated by up to
    a third, because distant ground has fewer features."""

    deg: float
    pairs: int


def measure_tilt(images: Iterable[Image], fov_deg: float | None = None) -> Tilt | None:
    """Return the tilt measured from neighbouring `images`; None if fewer than MIN_PAIRS pairs overlap well, or if the
    tilt is not significant.

    `images` are uint8 (H, W[, 3]), in flight order. `fov_deg`: along the longest side (None: TYPICAL_FOV_DEG)."""
    orb = cv2.ORB.create(FEATURES)
    slopes: list[Doubles] = []
    reference: Features | None = None
    for features in filter(None, (detect_features(orb, image) for image in images)):
        if reference and (measured := _measure_motion(reference, features)):
            motion, slope = measured
            if motion < _MIN_MOTION:
                continue  # taken in quick succession, so wait for an image with more motion
            slopes.append(slope)
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
    """Features of an image: `points` (n, 2), offsets from its centre over its longest side, and their descriptors."""

    points: Doubles
    descriptors: np.ndarray


def detect_features(orb: cv2.ORB, image: Image) -> Features | None:
    grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    scale = min(1.0, _WIDTH_PX / max(grey.shape))
    small = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    keypoints, descriptors = orb.detectAndCompute(small, None)
    if not keypoints:
        return None
    middle = np.array(small.shape[1::-1]) / 2
    return Features((np.array([keypoint.pt for keypoint in keypoints]) - middle) / max(small.shape), descriptors)


def match_features(first: Features, second: Features) -> tuple[Doubles, Doubles] | None:
    """Return the matched points (n, 2) of two images, each as in `Features`; None if there are too few."""
    matches = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True).match(first.descriptors, second.descriptors)
    if len(matches) < _MIN_INLIERS:
        return None
    start = first.points[[match.queryIdx for match in matches]]
    end = second.points[[match.trainIdx for match in matches]]
    homography, inliers = cv2.findHomography(start, end, cv2.RANSAC, _REPROJECTION_PX / _WIDTH_PX)
    if homography is None or inliers.sum() < _MIN_INLIERS:
        return None
    is_inlier = inliers.ravel() > 0
    return start[is_inlier], end[is_inlier]


def _measure_motion(first: Features, second: Features) -> tuple[float, Doubles] | None:
    """Return the motion at the centre between two images, as a fraction of the longest side, and the relative change of
    the motion per longest side, (2,) to the right and down, tan(tilt) / focal length; None if they share too little."""
    pairs = match_features(first, second)
    if pairs is None:
        return None
    start, end = pairs
    if np.ptp(start, axis=0).min() < _MIN_EXTENT:
        return None
    locations = np.column_stack([np.ones(len(start)), (start + end) / 2])
    (motion, *slopes), *_ = np.linalg.lstsq(locations, end - start, rcond=None)
    # The gradient of the motion is the sum of motion times `slope`, a change of scale and a rotation.
    right, down = motion
    equations = [[right, 0, 1, 0], [0, right, 0, -1], [down, 0, 0, 1], [0, down, 1, 0]]
    solution, *_ = np.linalg.lstsq(np.array(equations), np.column_stack(slopes).ravel(), rcond=None)
    return float(np.hypot(*motion)), np.asarray(solution[:2])
