"""Alignment of a query and a place by the regions that agree, to a fraction of a cell."""

import math

import numpy as np
import pytest

from edgevpr.core.contract import FineMatch
from edgevpr.techniques.displacement import aligned

SIDE = 31


def pairs(shift, turn_deg, scale, side=SIDE, wrong=0.0, seed=0):
    """Numbers of the regions of a query and of those of the place that they lie on, a part of them wrong."""
    numbers = np.arange(side * side)
    y, x = np.divmod(numbers, side)
    at = (x - (side - 1) / 2 + 1j * (y - (side - 1) / 2)) * scale * np.exp(1j * math.radians(turn_deg)) + complex(
        *shift
    )
    to_x, to_y = (np.rint(part + (SIDE - 1) / 2).astype(int) for part in (at.real, at.imag))
    inside = (to_x >= 0) & (to_x < SIDE) & (to_y >= 0) & (to_y < SIDE)
    best = np.where(inside, to_y * SIDE + to_x, 0)
    rng = np.random.default_rng(seed)
    scattered = rng.random(len(best)) < wrong
    best[scattered | ~inside] = rng.integers(0, SIDE * SIDE, np.count_nonzero(scattered | ~inside))
    return (numbers, side), (best, SIDE)


def align(asking, best, shift_cells):
    return aligned(asking, best, FineMatch(0.5, shift_cells=shift_cells, rotation_deg=350.0, height_ratio=2.0))


@pytest.mark.parametrize(
    ("shift", "turn_deg", "scale"), [((0.0, 0.0), 0.0, 1.0), ((3.3, -5.6), 7.0, 1.18), ((-8.2, 2.4), -7.4, 0.84)]
)
@pytest.mark.parametrize("wrong", [0.0, 0.7])
def test_shift_rotation_and_scale_are_found_among_pairs_that_are_wrong(shift, turn_deg, scale, wrong):
    found = align(*pairs(shift, turn_deg, scale, wrong=wrong), shift_cells=tuple(np.rint(shift)))
    assert found.shift_cells == pytest.approx(shift, abs=0.15)
    assert found.rotation_deg == pytest.approx((350 + turn_deg) % 360, abs=0.7)
    assert found.height_ratio == pytest.approx(2 * scale, abs=0.03)


def test_a_smaller_or_larger_view_lies_with_its_middle_at_the_shift():
    for side in (15, 45, 63):
        found = align(*pairs((2.4, 1.3), 5.0, 1.1, side), shift_cells=(2.0, 1.0))
        assert found.shift_cells == pytest.approx((2.4, 1.3), abs=0.15)
        assert found.rotation_deg == pytest.approx(355.0, abs=0.7)


def test_the_covariance_is_that_of_pairs_which_lie_off():
    exact = align(*pairs((0.0, 0.0), 0.0, 1.0), shift_cells=(0.0, 0.0))
    assert exact.covariance_cells2 == pytest.approx((1 / 12, 0, 1 / 12))
    mixed = align(*pairs((0.0, 0.0), 0.0, 1.0, wrong=0.8), shift_cells=(0.0, 0.0))
    assert mixed.covariance_cells2[0] > 1 / 12


def is_as_it_was(match):
    return match.covariance_cells2 is None and (match.rotation_deg, match.height_ratio) == (350.0, 2.0)


def test_pairs_of_different_places_and_too_few_are_not_aligned():
    asking, best = pairs((0.0, 0.0), 0.0, 1.0)
    assert is_as_it_was(align((asking[0][:7], SIDE), (best[0][:7], SIDE), (0.0, 0.0)))
    assert is_as_it_was(align(asking, best, (40.0, 40.0)))
    same = np.zeros(20, int)
    assert is_as_it_was(align((same, SIDE), (same, SIDE), (0.0, 0.0))), "one point has no rotation"
