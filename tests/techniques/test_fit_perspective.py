"""The perspective between two pictures, from pairs of their regions."""

import numpy as np
import pytest

from edgevpr.techniques.perspective import fit_perspective

CELLS = 32.0
GRID = np.add.outer(1j * np.arange(-15.0, 16.0), np.arange(-15.0, 16.0)).ravel()


def make_perspective_pairs(points, slope, turn_scale, shift):
    """The pairs that regions of a query with this slope, of the longest side, lie over, to whole cells."""
    scale = 1 - (slope[0] * points.real + slope[1] * points.imag) / CELLS
    there = turn_scale * points / scale + shift
    return np.round(there.real) + 1j * np.round(there.imag)


@pytest.mark.parametrize("slope", [(0.0, 0.0), (0.3, 0.0), (-0.2, 0.4)])
def test_fit_perspective_finds_the_slope_among_wrong_pairs(slope):
    turn_scale, shift, rng = 1.05 * np.exp(0.1j), 2 - 3j, np.random.default_rng(1)
    known = make_perspective_pairs(GRID, slope, turn_scale, shift)
    wrong = rng.random(len(GRID)) < 0.5
    known[wrong] = rng.permutation(GRID)[wrong]
    homography, sd, regions = fit_perspective(GRID, known, turn_scale, shift)
    assert np.hypot(*(CELLS * homography[2, :2] + slope)) < 4 * CELLS * sd < 0.3
    assert regions == pytest.approx(np.count_nonzero(~wrong), abs=20)


def test_fit_perspective_is_none_for_few_pairs():
    known = np.full(len(GRID), 40 + 40j)
    known[:11] = GRID[:11]
    assert fit_perspective(GRID, known, 1 + 0j, 0j) is None
