"""Fits a homography from a query to a place, from pairs of their most similar regions.

If two cameras look straight down on flat ground, a rotation, a scale and a shift map one picture to the other. If one
camera is tilted, a homography is needed (Hartley and Zisserman 2004, section 13.1): the scale changes across the
picture. At first, only regions near the shift of the match agree. Each round fits a homography to the regions that
agree with the previous one, so that more of the picture is included."""

import numpy as np

from edgevpr.core.arrays import Array, Bools, Doubles

_FIT_ROUNDS = 10
_MAX_RESIDUAL_CELLS = 1.5  # maximum distance of an agreeing region from the fit
_MIN_PAIRS = 12
_SLOPE_PRIOR_SD = 0.17  # of the change of scale per cell; far larger than in any accepted picture
_CORRELATED_REGIONS = 5.0  # neighbouring regions share pixels and relief, so this many are worth one
_MIN_SCALE = 0.05  # smaller scales are at or beyond the horizon of the homography


def fit_perspective(
    query: Array, place: Array, turn_scale: complex, shift: complex
) -> tuple[Doubles, float, int] | None:
    """Fit a homography to the positions of regions of a `query` and of their most similar regions in a `place`, complex
    (n,), in cells right and down of the picture centres. The fit starts from the rotation, scale and shift of a match.
    Returns the homography (3, 3), the standard deviation of its change of scale per cell, and the number of regions
    that agree; None if fewer than 12 do."""
    homography = np.array(
        [turn_scale.real, -turn_scale.imag, shift.real, turn_scale.imag, turn_scale.real, shift.imag, 0, 0]
    )
    normal = np.eye(8)
    for _ in range(_FIT_ROUNDS):
        agrees, _ = _compute_residuals(homography, query, place)
        if np.count_nonzero(agrees) < _MIN_PAIRS:
            return None
        (x, y), (target_x, target_y) = ((points[agrees].real, points[agrees].imag) for points in (query, place))
        zeros = np.zeros_like(x)
        equations = np.concatenate(
            [
                np.column_stack([x, y, zeros + 1, zeros, zeros, zeros, -target_x * x, -target_x * y]),
                np.column_stack([zeros, zeros, zeros, x, y, zeros + 1, -target_y * x, -target_y * y]),
            ]
        )
        weight = np.tile(1 / (1 + homography[6] * x + homography[7] * y), 2)
        equations *= weight[:, None]
        normal = equations.T @ equations + np.diag([0.0] * 6 + [_SLOPE_PRIOR_SD**-2] * 2)
        homography = np.linalg.solve(normal, equations.T @ (weight * np.concatenate([target_x, target_y])))
    agrees, errors = _compute_residuals(homography, query, place)
    if np.count_nonzero(agrees) < _MIN_PAIRS:
        return None
    # A region is matched to one cell at best: 1/12 is the variance of a uniform distribution over one cell.
    variance = float((np.abs(errors[agrees]) ** 2).mean()) / 2 + 1 / 12
    covariance = _CORRELATED_REGIONS * variance * np.linalg.inv(normal)[6:, 6:]
    homography = np.append(homography, 1.0).reshape(3, 3)
    return homography, float(np.sqrt(np.trace(covariance) / 2)), int(np.count_nonzero(agrees))


def _compute_residuals(homography: Doubles, query: Array, place: Array) -> tuple[Bools, Array]:
    """Return whether each region agrees with a homography, bool (n,), and its residual, complex (n,)."""
    x, y = query.real, query.imag
    scale = 1 + homography[6] * x + homography[7] * y
    right = homography[0] * x + homography[1] * y + homography[2]
    down = homography[3] * x + homography[4] * y + homography[5]
    errors = place - (right + 1j * down) / np.maximum(scale, _MIN_SCALE)
    agrees: Bools = (np.maximum(np.abs(errors.real), np.abs(errors.imag)) <= _MAX_RESIDUAL_CELLS) & (scale > _MIN_SCALE)
    return agrees, errors
