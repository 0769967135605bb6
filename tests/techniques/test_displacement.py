"""The displacement vote, against a count by hand."""

import math

import numpy as np
import pytest
from pictures import draw_texture

from edgevpr.core.contract import FineMatch
from edgevpr.techniques import create
from edgevpr.techniques.displacement import find_displacement, fit_alignment, measure_support


def count_votes(asking, best, side, counts):
    """Every possible step in turn, every vote in turn: the most that the votes about any step count for."""
    steps = [(b % side - a % side, b // side - a // side) for a, b in zip(asking, best, strict=True)]
    worth, most = dict(enumerate(counts)), 0
    for x in range(-side + 1, side):
        for y in range(-side + 1, side):
            most = max(most, sum(worth.get(max(abs(dx - x), abs(dy - y)), 0) for dx, dy in steps))
    return most / len(steps)


@pytest.mark.parametrize("counts", [(1.0,), (1.0, 1.0), (1.0, 0.5), (1.0, 1.0, 0.75, 0.5)])
def test_find_displacement_counts_votes_around_the_most_frequent_displacement(counts):
    rng = np.random.default_rng(len(counts))
    asking = np.sort(rng.choice(49, 40, replace=False))
    best = rng.integers(0, 49, 40)
    assert find_displacement(asking, best, (7, 7), counts).score == pytest.approx(count_votes(asking, best, 7, counts))


def test_find_displacement_refines_the_peak_within_a_cell():
    asking = np.arange(900)[np.arange(900) % 30 < 25]
    moved = np.where(np.arange(len(asking)) % 4, 1, 2)  # three of four moved by one cell, one by two
    found = find_displacement(asking, asking + moved, (30, 30), (1.0, 0.5))
    assert found.score == pytest.approx(0.75 + 0.25 * 0.5, abs=0.01)
    assert found.shift_cells == pytest.approx(((0.75 * 1 + 0.125 * 2) / 0.875, 0), abs=0.01)
    assert found.covariance_cells2[2] == pytest.approx(1 / 12)
    assert found.covariance_cells2[0] > found.covariance_cells2[2]


def test_cohog_finds_how_far_a_picture_has_moved():
    technique = create("cohog")
    scene = draw_texture(1, 640, 704)
    reference = technique.encode(scene[:512, :512])
    moved = technique.encode(scene[32:544, 64:576])  # 4 cells to the right, 2 down
    match = technique.match(moved, reference.fine)
    assert match.shift_cells == pytest.approx((4.0, 2.0), abs=0.3)
    stranger = technique.encode(draw_texture(2, 512, 512))
    assert match.score > 0.4 > 0.2 > technique.match(stranger, reference.fine).score


def test_find_displacement_counts_a_region_that_resembles_many_once():
    asking, best = np.arange(20, 27), np.array([120, 121, 121, 121, 121, 121, 150])
    found = find_displacement(asking, best, (31, 31), (1.0, 1.0, 1.0, 1.0))
    assert found.coverage == 2 / 31**2, "120 and 121; 150 has moved by another step"
    assert found.score == pytest.approx(6 / 7)


def compute_support(asking, regions, reference, step):
    """Every region in turn: back, likeness and log rank of a step."""
    side = math.isqrt(len(reference))
    best = [max(range(len(reference)), key=lambda r: float(regions[q] @ reference[r])) for q in range(len(asking))]
    back = [max(range(len(asking)), key=lambda q: float(regions[q] @ reference[r])) for r in range(len(reference))]

    def is_shifted(q, r):
        off_x = r % side - asking[q] % side - round(step[0])
        off_y = r // side - asking[q] // side - round(step[1])
        return max(abs(off_x), abs(off_y)) <= 3

    log_ranks = []
    for q in range(0, len(asking), 4):
        x, y = asking[q] % side + round(step[0]), asking[q] // side + round(step[1])
        if not (0 <= x < side and 0 <= y < side):
            continue
        around = [(j, i) for j in (y - 1, y, y + 1) for i in (x - 1, x, x + 1) if 0 <= i < side and 0 <= j < side]
        there = max(float(regions[q] @ reference[j * side + i]) for j, i in around)
        log_ranks.append(math.log(1 + sum(float(regions[q] @ each) > there for each in reference)))
    return (
        sum(is_shifted(back[r], r) for r in range(len(reference))) / len(reference),
        sum(float(regions[q] @ reference[best[q]]) for q in range(len(asking))) / len(asking),
        sum(log_ranks) / len(log_ranks) if log_ranks else math.log(len(reference)),
    )


@pytest.mark.parametrize("step", [(0.0, 0.0), (2.3, -1.2), (-4.0, 3.6), (9.0, 9.0), (30.0, 0.0)])
@pytest.mark.parametrize("asked", [1, 40, 100])
def test_support_is_computed_from_all_regions(step, asked):
    rng = np.random.default_rng(asked)
    # Integers, so that sums are exact in any order; the query is the place, moved, with other regions among it.
    reference = rng.integers(-9, 10, (100, 8)).astype(np.float32)
    asking = np.sort(rng.choice(100, asked, replace=False))
    regions = np.where(rng.random((asked, 1)) < 0.7, np.roll(reference, 11, axis=0)[asking], reference[asking][::-1])
    regions = (regions + rng.integers(-2, 3, regions.shape)).astype(np.float32)
    found = measure_support(asking, regions, reference, (regions @ reference.T).argmax(axis=1), step)
    expected = compute_support(asking.tolist(), regions, reference, step)
    assert (found.back, found.likeness, found.log_rank) == pytest.approx(expected, rel=1e-6)


def test_measure_support_compares_surroundings_with_the_middle():
    technique = create("cohog")
    scene, other = draw_texture(1, 640, 704), draw_texture(2, 512, 512)
    other[80:432, 80:432] = scene[80:432, 80:432]
    for picture, low, high in ((scene[:512, :512], 0.9, 1.1), (other, 0.0, 0.2)):
        place = technique.encode(picture).fine
        for x in (0, 64, 128):  # pixels that the query has moved to the right, out of view of a part of the ring
            match = technique.match(technique.encode(scene[:512, x : x + 512]), place)
            assert low < match.support.surroundings < high


SIDE = 31


def make_pairs(shift, turn_deg, scale, side=SIDE, wrong=0.0, seed=0):
    """Numbers of the regions of a query and of those of the place that they lie on, a part of them wrong."""
    numbers = np.arange(side * side)
    y, x = np.divmod(numbers, side)
    centred = x - (side - 1) / 2 + 1j * (y - (side - 1) / 2)
    at = centred * scale * np.exp(1j * math.radians(turn_deg)) + complex(*shift)
    to_x, to_y = (np.rint(part + (SIDE - 1) / 2).astype(int) for part in (at.real, at.imag))
    inside = (to_x >= 0) & (to_x < SIDE) & (to_y >= 0) & (to_y < SIDE)
    best = np.where(inside, to_y * SIDE + to_x, 0)
    rng = np.random.default_rng(seed)
    scattered = rng.random(len(best)) < wrong
    best[scattered | ~inside] = rng.integers(0, SIDE * SIDE, np.count_nonzero(scattered | ~inside))
    return (numbers, side), (best, SIDE)


def align(asking, best, shift_cells):
    return fit_alignment(asking, best, FineMatch(0.5, shift_cells=shift_cells, rotation_deg=350.0, height_ratio=2.0))


@pytest.mark.parametrize(
    ("shift", "turn_deg", "scale"), [((0.0, 0.0), 0.0, 1.0), ((3.3, -5.6), 7.0, 1.18), ((-8.2, 2.4), -7.4, 0.84)]
)
@pytest.mark.parametrize("wrong", [0.0, 0.7])
def test_align_finds_shift_rotation_and_scale_despite_outliers(shift, turn_deg, scale, wrong):
    found = align(*make_pairs(shift, turn_deg, scale, wrong=wrong), shift_cells=tuple(np.rint(shift)))
    assert found.shift_cells == pytest.approx(shift, abs=0.15)
    assert found.rotation_deg == pytest.approx((350 + turn_deg) % 360, abs=0.7)
    assert found.height_ratio == pytest.approx(2 * scale, abs=0.03)


def test_fit_alignment_takes_the_covariance_from_residuals():
    exact = align(*make_pairs((0.0, 0.0), 0.0, 1.0), shift_cells=(0.0, 0.0))
    assert exact.covariance_cells2 == pytest.approx((1 / 12, 0, 1 / 12))
    mixed = align(*make_pairs((0.0, 0.0), 0.0, 1.0, wrong=0.8), shift_cells=(0.0, 0.0))
    assert mixed.covariance_cells2[0] > 1 / 12


def is_unaligned(match):
    return match.covariance_cells2 is None and (match.rotation_deg, match.height_ratio) == (350.0, 2.0)


def test_align_refuses_too_few_pairs_and_those_of_different_places():
    asking, best = make_pairs((0.0, 0.0), 0.0, 1.0)
    assert is_unaligned(align((asking[0][:7], SIDE), (best[0][:7], SIDE), (0.0, 0.0)))
    assert is_unaligned(align(asking, best, (40.0, 40.0)))
    same = np.zeros(20, int)
    assert is_unaligned(align((same, SIDE), (same, SIDE), (0.0, 0.0))), "one point has no rotation"
