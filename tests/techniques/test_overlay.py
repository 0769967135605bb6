"""The last look: a query laid exactly over a place stands out there, and nowhere where only a part of it agrees."""

from functools import partial

import cv2
import numpy as np
import pytest
from pictures import render_view

from edgevpr.core.contract import FineMatch
from edgevpr.techniques import overlay
from edgevpr.techniques.cohog import CoHog

SIDE_PX = 256
CELLS = 32
REGIONS = 31
ALLOWED = np.ones((SIDE_PX, SIDE_PX), bool)
SEEN = np.ones((REGIONS, REGIONS), bool)

structure = partial(overlay.compute_structure, sd_cells=3.0)


def make_ground(seed):
    coarse = np.random.default_rng(seed).uniform(0, 255, (40, 40)).astype(np.float32)
    return cv2.resize(coarse, (2 * SIDE_PX, 2 * SIDE_PX), interpolation=cv2.INTER_CUBIC).clip(0, 255)


def draw_view(ground, *moved):
    return render_view(ground, SIDE_PX, *moved)


def draw_patterns(seed):
    found = np.random.default_rng(seed).normal(size=(REGIONS**2, 20)).astype(np.float32)
    return found / np.linalg.norm(found, axis=1, keepdims=True)


@pytest.mark.parametrize(("rotation_deg", "right_px", "down_px", "height"), [(0, 24, -16, 1), (40, 8, 30, 1.2)])
def test_overlay_query_follows_the_match(rotation_deg, right_px, down_px, height):
    ground = make_ground(1)
    shift_cells = (right_px * CELLS / SIDE_PX, down_px * CELLS / SIDE_PX)
    match = FineMatch(0.1, shift_cells=shift_cells, rotation_deg=rotation_deg, height_ratio=height)
    view = draw_view(ground, rotation_deg, right_px, down_px, height)
    laid, seen = overlay.overlay_query(view, ALLOWED, match, CELLS)
    assert 0.4 < seen.mean() < 1
    inside = cv2.erode(seen.astype(np.uint8), np.ones((5, 5))).astype(bool)
    assert np.corrcoef(laid[inside], draw_view(ground)[inside])[0, 1] > 0.98


def test_measure_prominence_is_low_for_another_structure():
    place = structure(draw_patterns(0), SEEN)
    assert max(overlay.measure_prominence(structure(draw_patterns(seed), SEEN), place) for seed in range(1, 41)) < 2


def test_measure_prominence_is_low_along_a_linear_structure():
    row = draw_patterns(3)[:REGIONS]
    road = structure(np.repeat(row, REGIONS, axis=0), SEEN)  # each row is of one pattern
    assert overlay.measure_prominence(road, road) < 2
    furrows = structure(np.tile(row[:4], (REGIONS * REGIONS // 4 + 1, 1))[: REGIONS**2], SEEN)
    assert overlay.measure_prominence(furrows, furrows) < 3


def test_measure_prominence_ignores_regions_that_are_not_visible():
    some = np.zeros_like(SEEN)
    some[:4, :4] = True
    place = structure(draw_patterns(1), SEEN)
    assert (
        overlay.measure_prominence(structure(draw_patterns(1), some), place)
        < overlay.measure_prominence(place, place) / 2
    )
    assert overlay.measure_prominence(structure(draw_patterns(1), np.zeros_like(SEEN)), place) == 0


def test_structures_agree_only_at_the_given_shift():
    place = structure(draw_patterns(1), SEEN)
    query = np.roll(place, (3, 9), axis=(0, 1))  # its middle lies to the left of the place's, and above
    there = overlay.compute_agreement(query, place, (-9.0, -3.0))
    assert there > 10 > 3 > overlay.compute_agreement(query, place, (9.0, 3.0))
    assert overlay.compute_agreement(query, place, (-8.0, -1.4)) == pytest.approx(there, rel=0.1)
    assert overlay.compute_agreement(query, place, (400.0, -400.0)) < 3


def test_match_of_changed_ground_is_prominent():
    technique = CoHog(camera="nadir")
    places = [np.dstack([draw_view(make_ground(seed))] * 3).astype(np.uint8) for seed in range(4)]
    changed = draw_view(make_ground(0), 33, 20, -12) * 0.6 + np.random.default_rng(0).normal(40, 12, (SIDE_PX, SIDE_PX))
    query = technique.encode(np.dstack([changed.clip(0, 255)] * 3).astype(np.uint8))
    matches = [technique.match(query, technique.encode(place).fine) for place in places]
    assert matches[0].structure > 4 > 2 > max(match.structure for match in matches[1:])
    assert matches[0].score > 3 * max(match.score for match in matches[1:])
    assert matches[0].rotation_deg == pytest.approx(33, abs=3)


def test_forward_score_is_weighted_by_the_structures():
    technique = CoHog()
    seen = [np.dstack([draw_view(make_ground(seed))] * 3).astype(np.uint8) for seed in (0, 1)]
    places, query = [technique.encode(picture) for picture in seen], technique.encode(seen[0])
    same, other = (technique.match(query, place.fine) for place in places)
    assert same.structure > 6 > 4 > other.structure
    assert same.score == same.votes
    assert other.score < other.votes
