"""Measures how the height above ground changes between steps of visual odometry, by the parallax of landmarks.

A step over ground that lies a third lower looks a quarter shorter. But in view, a landmark keeps its depth below the
camera: between two pictures it shifts by the camera's motion divided by this depth. If the landmarks below the camera
shifted less than others in the last step, and as much as they do in this one, the ground here is lower."""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from edgevpr.core.arrays import Array, Doubles

_MIN_LANDMARKS = 8
_MIN_COMMON = 4  # landmarks that three pictures share
_MAX_SPREAD = 0.15  # of the changes that these show
_TOLERANCE = 0.01  # fraction of the longest side
_MAX_DEPTH_RATIO = 2.5  # of a landmark's depth and the height above ground
_PIXEL = 0.002  # fraction of the longest side
# Standard deviation of a measured change: a part of it, and the scatter of landmarks, of which so many err alike.
_CHANGE_SD = 0.25
_DEPENDENT_LANDMARKS = 5.0
_SCALE_SD = 0.01  # by how much the scale across the motion is expected to differ from that of the whole picture
_UNSEEN_SD = 0.3  # of a change that is not seen: a valley 30 m deep below 100 m
UNLINKED_SHIFT = 2.0  # fraction of the longest side over which any change is possible between pictures that agree


class HeightChange(NamedTuple):
    """Natural logarithm of the ratio of two heights above ground, measured or assumed, and its standard deviation."""

    log_ratio: float = 0.0
    sd: float = 0.0
    is_measured: bool = True


@dataclass(frozen=True, slots=True)
class ImageMotion:
    """The motion between two images, the new one first. `pairs`: matching landmarks, complex (n,) each, fractions of
    the longest side as in `agreement`; `nadirs`: the points below the camera. By the `inliers` of them, the image is
    rotated and scaled by `factor`, and its nadir lies `offset` away (`offset_sd`: of each axis); `scale`: reported."""

    pairs: tuple[Array, Array]
    nadirs: tuple[complex, complex]
    factor: complex
    offset: complex
    offset_sd: float
    inliers: int
    scale: float


def claim_unseen_change(part: float) -> HeightChange:
    """Return the change of height to claim where nothing shows it: over this `part` of the way that allows any."""
    return HeightChange(sd=_UNSEEN_SD * min(1.0, part), is_measured=False)


class ParallaxChain:
    """Follows the height above ground over successive motions, each of which starts at the image of the last one."""

    def __init__(self) -> None:
        self._last: tuple[Array, Doubles] | None = None  # landmarks of the last image, and their inverse depths

    def add(self, motion: ImageMotion) -> tuple[HeightChange, HeightChange]:
        """Return the height above ground at this motion relative to that at the last one, and the climb during it,
        beyond what the reported heights explain. An unreported tilt changes both, by opposite amounts."""
        length, rotation = abs(motion.offset), motion.factor / abs(motion.factor)
        axis = motion.offset / length
        points = rotation * (motion.pairs[0] - motion.nadirs[0]) / axis
        start = (motion.pairs[1] - motion.nadirs[1]) / axis
        zoom, zoom_sd = _fit_scale(points, start, abs(motion.factor))
        moved = start - zoom * points
        inverse_depth = moved.real / length
        is_valid = (inverse_depth >= 1 / _MAX_DEPTH_RATIO) & (inverse_depth <= _MAX_DEPTH_RATIO)
        is_valid &= np.abs(moved.imag) <= _TOLERANCE
        now, before, inverse_depth = (values[is_valid] for values in (*motion.pairs, inverse_depth))
        last, self._last = self._last, (now, inverse_depth)
        log_zoom = math.log(zoom / motion.scale)
        climb = HeightChange(log_zoom, math.hypot(zoom_sd / zoom, _CHANGE_SD * log_zoom))
        if last is None:
            return HeightChange(), climb
        _, rows, last_rows = np.intersect1d(before, last[0], return_indices=True)
        return _compare_depths(last[1][last_rows], inverse_depth[rows], length), climb


def _fit_scale(points: Array, targets: Array, scale: float) -> tuple[float, float]:
    """Return the scale from `points` to `targets`, complex (n,) each, and its standard deviation, by their imaginary
    parts: across the motion there is no parallax. In a narrow band it is near `scale`, that of the whole picture."""
    across = np.stack([points.imag, targets.imag], axis=1)
    matrix = np.stack([points.real, np.ones(len(points))], axis=1)
    is_used, fit = np.abs(across @ (scale, -1.0)) <= _TOLERANCE, scale
    for _ in range(3):
        if np.count_nonzero(is_used) < _MIN_LANDMARKS:
            return scale, _SCALE_SD
        turned = across - matrix @ np.linalg.lstsq(matrix[is_used], across[is_used], rcond=None)[0]
        spread2 = (turned[is_used] ** 2).sum(axis=0) + 1e-9
        fit = math.sqrt(spread2[1] / spread2[0])
        residuals = turned @ (fit, -1.0)
        variance = max(float(np.mean(residuals[is_used] ** 2)), _PIXEL**2 / 12) * _DEPENDENT_LANDMARKS / spread2[0]
        is_used = np.abs(residuals) <= _TOLERANCE
    weight = _SCALE_SD**2 / (_SCALE_SD**2 + variance)
    return scale + weight * (fit - scale), math.sqrt(weight * variance)


def _compare_depths(before: Doubles, now: Doubles, length: float) -> HeightChange:
    """Return the change of height that landmarks show by their inverse depths (n,) in two motions."""
    unseen = claim_unseen_change(length / UNLINKED_SHIFT)
    if len(before) < _MIN_COMMON:
        return unseen
    ratios = np.log(now / before)
    middle = float(np.median(ratios))
    spread = max(1.5 * float(np.median(np.abs(ratios - middle))), _PIXEL / length)
    if spread > _MAX_SPREAD:
        return unseen
    # Their positions are whole pixels, so the median would not see a change of less than one.
    kept = ratios[np.abs(ratios - middle) <= 2.5 * spread]
    scatter = max(float(kept.std()), 0.5 * spread)
    sd = math.hypot(scatter * math.sqrt(_DEPENDENT_LANDMARKS / len(kept)), _CHANGE_SD * float(kept.mean()))
    return HeightChange(float(kept.mean()), sd)
