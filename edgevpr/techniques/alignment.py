"""Alignment of a query and a place to a fraction of a cell: how the regions that agree in the vote lie on each other.

The vote knows the step in whole cells, and the rotation and the height in steps of the hypotheses. The agreeing regions
say more: together they are a shift, a rotation and a scale, found by least squares. With it more regions agree, since
those far from the middle no longer miss by what the hypothesis is off, and the fit is repeated with these.
"""

from dataclasses import dataclass

import numpy as np

_ROUNDS = 8
_WITHIN_CELLS = 1.5  # as far as a vote may lie off the peak
# Beyond these another hypothesis is nearer, or the pairs are of different places.
_FURTHEST_TURN_DEG = 16.0
_FURTHEST_SCALE = 1.6
_LEAST_PAIRS = 8
_Grid = tuple[np.ndarray, int]  # numbers of regions, row by row, and the regions along one side


@dataclass(frozen=True, slots=True)
class Alignment:
    """The query, turned by `turn_deg` and scaled by `scale` about its middle, lies on the place with its middle at
    `shift_cells` (x, y), in cells from that of the place. `covariance_cells2` (var x, cov xy, var y) is the covariance
    of how far single regions lie off."""

    shift_cells: tuple[float, float]
    turn_deg: float
    scale: float
    covariance_cells2: tuple[float, float, float]


def align(asking: _Grid, best: _Grid, shift_cells: tuple[float, float]) -> Alignment | None:
    """Fit a shift, a rotation and a scale to pairs of a region of the query and the most similar region of the place,
    int (G,) each, some of which agree about this shift. None where too few agree, or on a rotation or scale that is
    none of this hypothesis."""
    # In complex numbers a rotation and a scale are one factor, and least squares one division.
    mine, there = _from_middle(*asking), _from_middle(*best)
    turned, shift = 1 + 0j, complex(*shift_cells)
    for again in range(_ROUNDS + 1):
        off = there - turned * mine - shift
        near = np.maximum(abs(off.real), abs(off.imag)) <= _WITHIN_CELLS
        if np.count_nonzero(near) < _LEAST_PAIRS:
            return None
        if again == _ROUNDS:
            break
        of, to = mine[near], there[near]
        middle_of, middle_to = of.mean(), to.mean()
        spread = np.vdot(of - middle_of, of - middle_of).real
        turned = np.vdot(of - middle_of, to - middle_to) / spread if spread > 0 else 0j
        if not 1 / _FURTHEST_SCALE < abs(turned) < _FURTHEST_SCALE:
            return None
        if abs(np.angle(turned, deg=True)) > _FURTHEST_TURN_DEG:
            return None
        shift = middle_to - turned * middle_of
    x, y = off[near].real, off[near].imag
    # A region is matched to one cell at best: 1/12 is the variance of a uniform distribution over one cell.
    covariance = float(x.var()) + 1 / 12, float(np.mean(x * y) - x.mean() * y.mean()), float(y.var()) + 1 / 12
    return Alignment(
        (float(shift.real), float(shift.imag)), float(np.angle(turned, deg=True)), float(abs(turned)), covariance
    )


def _from_middle(numbers: np.ndarray, side: int) -> np.ndarray:
    """Return where regions are, in cells from the middle of their grid: x + iy, complex (G,)."""
    y, x = np.divmod(numbers, side)
    return x + 1j * y - (1 + 1j) * (side - 1) / 2
