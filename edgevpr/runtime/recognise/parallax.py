"""Measures how the height above ground changes between steps of visual odometry, by the parallax of landmarks.

A step over ground that lies a third lower looks like one a quarter shorter. But a landmark keeps its depth below the
camera as long as it is in view: between two pictures it shifts by the camera's motion divided by this depth. If the
landmarks below the camera shifted less than others in the last step, and as much as they do in this one, the ground
here is lower. A fit to the whole picture cannot show that: at a cliff it follows the larger part, and over a slope its
scale changes in the wrong direction.
"""

import math
from dataclasses import dataclass

import numpy as np

from edgevpr.core.arrays import Array, Doubles

_MIN_LANDMARKS = 8
_MIN_BASELINE = 0.04  # fraction of the longest side: a shorter shift shows no depths
_TOLERANCE = 0.01  # fraction of the longest side
_MIN_NEARNESS, _MAX_NEARNESS = 0.4, 2.5
_MAX_ZOOM_ERROR = 1.2  # of the scale that a fit to the whole picture has
# Standard deviation of a measured change: a part of it, and the scatter of the landmarks, of which so many neighbours
# have a common error.
_CHANGE_SD = 0.25
_DEPENDENT_LANDMARKS = 10.0
# Standard deviation of a change that is not seen, over half a picture: a valley 30 m deep below 100 m.
_UNSEEN_SD = 0.3
_UNSEEN_SHIFT = 0.5


@dataclass(frozen=True, slots=True)
class HeightChange:
    """Natural logarithm of the ratio of two heights above ground, and its standard deviation."""

    log_ratio: float
    sd: float


@dataclass(frozen=True, slots=True)
class _Tracked:
    """Landmarks that were followed to the last picture: `points` (n,), complex; `nearness` (n,), the height above
    ground divided by the depth of each (nan: unknown; None: no baseline yet); `shifts` (n,), complex, by how much each
    moved since the baseline began, and `shift`, by how much the point below the camera did."""

    points: Array
    nearness: Doubles | None
    shifts: Array
    shift: complex


class ParallaxChain:
    """Follows landmarks from step to step. Points are as in `agreement`: complex, fractions of the longest side."""

    def __init__(self) -> None:
        self._tracked: _Tracked | None = None
        self._log_zoom = 0.0  # of the last step

    def add_step(
        self,
        matched: tuple[Array, Array],
        nadirs: tuple[complex, complex],
        factor: complex,
        shift: complex,
        expected_scale: float,
    ) -> HeightChange:
        """Return by how much the height above ground at this step differs from that at the last one, beyond what the
        reported heights explain. `matched`: landmarks of this picture and the previous one that match, complex (n,)
        each; `nadirs`: the points below the camera. By their agreement this picture is rotated and scaled by `factor`,
        and its point below the camera lies `shift` from that of the previous one; `expected_scale`: by the reported
        heights."""
        axis = shift / abs(shift) if shift else 1 + 0j
        turn = factor / abs(factor)
        points, before = matched
        turned, start = turn * (points - nadirs[0]) / axis, (before - nadirs[1]) / axis
        scale = _fit_scale(turned, start, abs(factor))
        shifts = start - scale * turned
        is_plausible = np.abs(shifts.imag) <= _TOLERANCE
        is_plausible &= shifts.real >= _MIN_NEARNESS * abs(shift) - _TOLERANCE
        is_plausible &= shifts.real <= _MAX_NEARNESS * abs(shift) + _TOLERANCE
        shifts *= axis
        change = self._follow(points[is_plausible], before[is_plausible], shifts[is_plausible], shift, turn)
        log_ratio = change.log_ratio + self._log_zoom
        self._log_zoom = math.log(scale / expected_scale)
        return HeightChange(log_ratio, math.hypot(change.sd, _CHANGE_SD * log_ratio))

    def _follow(self, points: Array, before: Array, shifts: Array, shift: complex, turn: complex) -> HeightChange:
        """Follow landmarks to this picture, and return the change of height that they show once the baseline is long
        enough. The shifts are in the axes of the previous picture, from which this one is rotated by `turn`."""
        last, nearness = self._tracked, None
        if last is not None:
            _, here, there = np.intersect1d(before, last.points, return_indices=True)
            if last.nearness is not None:
                nearness = np.full(len(points), np.nan)
                nearness[here] = last.nearness[there]
            if last.shift:  # in the middle of a baseline
                points, shifts, shift = points[here], shifts[here] + last.shifts[there], shift + last.shift
                nearness = None if nearness is None else nearness[here]
        if abs(shift) < _MIN_BASELINE:
            self._tracked = _Tracked(points, nearness, shifts / turn, shift / turn)
            return HeightChange(0.0, 0.0)
        now = (shifts / shift).real
        self._tracked = _Tracked(points, now, np.zeros_like(points), 0j)
        if nearness is None:
            return HeightChange(0.0, 0.0)  # of the first baseline: there is nothing to compare with
        return _compare(nearness, now, abs(shift))


def _fit_scale(points: Array, targets: Array, scale: float) -> float:
    """Return the scale from `points` to `targets`, complex (n,) each, `scale` at first, by their imaginary parts only:
    across the motion there is no parallax."""
    matrix = np.stack([points.imag, points.real, np.ones(len(points))], axis=1)
    factors = np.array([scale, 0.0, 0.0])
    for _ in range(3):
        is_used = np.abs(matrix @ factors - targets.imag) <= _TOLERANCE
        if np.count_nonzero(is_used) < _MIN_LANDMARKS:
            return scale
        factors = np.linalg.lstsq(matrix[is_used], targets.imag[is_used], rcond=None)[0]
    return float(np.clip(factors[0], scale / _MAX_ZOOM_ERROR, scale * _MAX_ZOOM_ERROR))


def _compare(before: Doubles, now: Doubles, baseline: float) -> HeightChange:
    """Return the change of height that landmarks show by their nearness in two baselines, (n,) each (nan: unknown)."""
    is_known = (before > 0) & (now > 0)  # False for nan
    ratios = np.log(now[is_known] / before[is_known])
    if len(ratios) < _MIN_LANDMARKS:
        return HeightChange(0.0, _UNSEEN_SD * math.sqrt(min(1.0, baseline / _UNSEEN_SHIFT)))
    log_ratio = float(np.median(ratios))
    scatter = 1.5 * float(np.median(np.abs(ratios - log_ratio)))
    return HeightChange(log_ratio, scatter * math.sqrt(_DEPENDENT_LANDMARKS / len(ratios)))
