"""The perspective by which a query lies over a place, from the regions of both that resemble each other most.

Pictures of flat ground by two cameras that look straight down lie over each other by a rotation, a scale and a shift.
If one is tilted, they lie over each other by a homography (Hartley and Zisserman 2004, section 13.1): the scale changes
across the picture. Only regions near the shift of the match agree at first. Each round fits a homography to those that
agree with the last one, so that more of the picture follows.
"""

import numpy as np

from edgevpr.core.arrays import Array, Bools, Doubles

_FIT_ROUNDS = 10
_MAX_RESIDUAL_CELLS = 1.5  # largest distance of an agreeing region from the fit
_MIN_PAIRS = 12
_SLOPE_PRIOR_SD = 0.17  # of the change of scale from cell to cell: far more than a picture that is taken bears
_CORRELATED_REGIONS = 5.0  # neighbouring regions share pixels and relief: so many count as one
_MIN_SCALE = 0.05  # nearer to the horizon of a homography, nothing lies anywhere


def fit_perspective(
    asked: Array, known: Array, turn_scale: complex, shift: complex
) -> tuple[Doubles, float, int] | None:
    """Fit a homography to regions of a query and the most similar ones of a place, `asked` and `known`, complex (n,),
    in cells from the middles of the pictures, right and down. It begins with the rotation, scale and shift of a match.
    Returns it (3, 3), the standard deviation of its change of scale from cell to cell, and how many regions agree; None
    if fewer than 12 do."""
    homography = np.array(
        [turn_scale.real, -turn_scale.imag, shift.real, turn_scale.imag, turn_scale.real, shift.imag, 0, 0]
    )
    normal = np.eye(8)
    for _ in range(_FIT_ROUNDS):
        agrees, _ = _compute_residuals(homography, asked, known)
        if np.count_nonzero(agrees) < _MIN_PAIRS:
            return None
        (x, y), (to_x, to_y) = ((points[agrees].real, points[agrees].imag) for points in (asked, known))
        none = np.zeros_like(x)
        equations = np.concatenate(
            [
                np.column_stack([x, y, none + 1, none, none, none, -to_x * x, -to_x * y]),
                np.column_stack([none, none, none, x, y, none + 1, -to_y * x, -to_y * y]),
            ]
        )
        weight = np.tile(1 / (1 + homography[6] * x + homography[7] * y), 2)
        equations *= weight[:, None]
        normal = equations.T @ equations + np.diag([0.0] * 6 + [_SLOPE_PRIOR_SD**-2] * 2)
        homography = np.linalg.solve(normal, equations.T @ (weight * np.concatenate([to_x, to_y])))
    agrees, off = _compute_residuals(homography, asked, known)
    if np.count_nonzero(agrees) < _MIN_PAIRS:
        return None
    # A region is matched to one cell at best: 1/12 is the variance of a uniform distribution over one cell.
    variance = float((np.abs(off[agrees]) ** 2).mean()) / 2 + 1 / 12
    covariance = _CORRELATED_REGIONS * variance * np.linalg.inv(normal)[6:, 6:]
    homography = np.append(homography, 1.0).reshape(3, 3)
    return homography, float(np.sqrt(np.trace(covariance) / 2)), int(np.count_nonzero(agrees))


def _compute_residuals(homography: Doubles, asked: Array, known: Array) -> tuple[Bools, Array]:
    """Return which regions agree with a homography, bool (n,), and by how much each misses, complex (n,)."""
    x, y = asked.real, asked.imag
    scale = 1 + homography[6] * x + homography[7] * y
    expected = (
        homography[0] * x
        + homography[1] * y
        + homography[2]
        + 1j * (homography[3] * x + homography[4] * y + homography[5])
    ) / np.maximum(scale, _MIN_SCALE)
    off = known - expected
    agrees: Bools = (np.maximum(np.abs(off.real), np.abs(off.imag)) <= _MAX_RESIDUAL_CELLS) & (scale > _MIN_SCALE)
    return agrees, off
