"""Queries from other heights: their views, and that `cohog` finds the place, the height and the rotation."""

import numpy as np
import pytest
from pictures import draw_rough_ground, render_view

from edgevpr.core.contract import find_nearest_height
from edgevpr.techniques import create
from edgevpr.techniques.views import HEIGHT_RATIOS, ROTATIONS, decode_hypothesis

pytestmark = pytest.mark.slow

SIDE_PX = 384


def draw_view(seed, height_ratio=1.0, rotation_deg=0.0, right_px=0.0):
    return render_view(draw_rough_ground(1100, seed), SIDE_PX, rotation_deg, right_px, height=height_ratio)


@pytest.fixture(scope="module")
def town():
    technique = create("cohog", {"camera": "nadir"})
    places = [technique.encode(draw_view(seed)) for seed in range(6)]
    return technique, places, np.stack([place.coarse for place in places])


def test_decode_hypothesis_gives_a_height_and_a_rotation():
    assert decode_hypothesis(0) == (0.5, 0)
    assert decode_hypothesis(2 * ROTATIONS + 7) == (1.0, 7)
    nearest = [find_nearest_height(HEIGHT_RATIOS, ratio) for ratio in (0.1, 0.58, 0.6, 0.9, 1.3, 5)]
    assert nearest == [0.5, 0.5, 0.7, 1.0, 1.42, 2.0]


@pytest.mark.parametrize(("height_ratio", "rotation_deg"), [(0.5, 0), (0.6, 130), (1.42, 0), (2.0, 130)])
def test_cohog_finds_a_query_from_another_height_with_its_height_rotation_and_shift(town, height_ratio, rotation_deg):
    technique, places, rows = town
    query = technique.encode(draw_view(3, height_ratio, rotation_deg, right_px=24))
    matches = {}
    for ratio in technique.spec.height_ratios:
        _, by_hypothesis = technique.score_places(query, rows, None, height_ratio=ratio)
        for at in np.argsort(-by_hypothesis.ravel())[:8].tolist():  # of 144
            slot, chosen = divmod(at, by_hypothesis.shape[1])
            matches[slot, chosen] = technique.match(query, places[slot].fine, [chosen])
    (slot, _), match = max(matches.items(), key=lambda found: found[1].score)
    assert slot == 3
    assert match.score > technique.min_score
    assert match.height_ratio == pytest.approx(height_ratio, rel=0.04)
    assert abs((match.rotation_deg - rotation_deg + 180) % 360 - 180) < 2
    assert match.shift_cells == pytest.approx((24 / 12, 0), abs=0.4)


@pytest.mark.parametrize("height_ratio", [0.5, 1.0, 2.0])
def test_match_accepts_no_other_ground_at_any_height(town, height_ratio):
    technique, places, _ = town
    query = technique.encode(draw_view(11, height_ratio))
    for place in places[:2]:
        assert technique.match(query, place.fine).score < technique.min_score


def test_score_places_searches_only_the_given_height(town):
    technique, _, rows = town
    query = technique.encode(draw_view(2, 0.7))
    for expected, number in ((None, 2), (0.66, 1), (1.1, 2), (3.0, 4)):
        scores, known = technique.score_places(query, rows, None, None, expected)
        of_height = np.arange(5 * ROTATIONS) // ROTATIONS == number
        assert np.isfinite(known[:, of_height]).all()
        assert np.isneginf(known[:, ~of_height]).all()
        assert (scores >= 0).all()


def test_thesis_score_is_searched_at_one_height():
    technique = create("cohog", {"camera": "nadir", "matching": "thesis"})
    assert not technique.spec.height_ratios
    query = technique.encode(draw_view(1))
    _, by_hypothesis = technique.score_places(query, query.coarse[None], None)
    assert np.flatnonzero(np.isfinite(by_hypothesis[0])).tolist() == list(range(48, 72))
    assert technique.match(query, query.fine).height_ratio == 1.0
