"""`cohog` looking down, where the heading is known: the rotation to expect, the three possible, and no less recall."""

import cv2
import numpy as np
import pytest
from pictures import textured

from edgevpr.techniques import create

pytestmark = pytest.mark.slow

SIDE_PX = 256
PLACES = 8


def view(seed, heading_deg):
    """The ground of a place under an aircraft with this heading: turned clockwise, it sees it turned the other way."""
    ground = textured(seed, 2 * SIDE_PX, 2 * SIDE_PX)
    middle = SIDE_PX - 0.5
    turn = cv2.getRotationMatrix2D((middle, middle), heading_deg, 1)  # counter-clockwise
    turned = cv2.warpAffine(ground, turn, ground.shape[::-1])
    return turned[SIDE_PX // 2 : -SIDE_PX // 2, SIDE_PX // 2 : -SIDE_PX // 2]


@pytest.fixture(scope="module")
def town():
    """A technique, the headings that its places were mapped with, their descriptors and rows."""
    technique = create("cohog", {"camera": "nadir"})
    headings_deg = np.arange(PLACES) * 75.0 % 360
    places = [technique.encode(view(seed, heading_deg)) for seed, heading_deg in enumerate(headings_deg)]
    return technique, headings_deg, places, np.stack([place.coarse for place in places])


AS_MAPPED = {"height_ratio": 1.0}


def possible(by_hypothesis):
    """Degrees of the rotations that are not out of the question, place by place."""
    return [sorted({15 * int(at) % 360 for at in np.flatnonzero(np.isfinite(scores))}) for scores in by_hypothesis]


def test_only_the_rotation_expected_and_those_beside_it_are_possible(town):
    technique, _, places, rows = town
    turned_deg = np.array([0, 7, 8, 100, 352, 353, 359.9, np.nan])
    scores, by_rotation = technique.coarse_scores(places[0], rows, None, turned_deg, **AS_MAPPED)
    sets = possible(by_rotation)
    assert sets[:3] == [[0, 15, 345], [0, 15, 345], [0, 15, 30]]
    assert sets[3:7] == [[90, 105, 120], [0, 330, 345], [0, 15, 345], [0, 15, 345]]
    everything, by_rotation = technique.coarse_scores(places[0], rows, None, **AS_MAPPED)
    assert sets[7] == possible(by_rotation)[7] == list(range(0, 360, 15))
    assert (scores <= everything + 1e-6).all()
    np.testing.assert_allclose(scores[[0, 7]], everything[[0, 7]], atol=1e-6)


@pytest.mark.parametrize("wrong_deg", [0.0, 12.0, -12.0])
def test_a_heading_loses_no_place(town, wrong_deg):
    technique, headings_deg, places, rows = town
    recalled = []
    for seed in range(PLACES):
        heading_deg = 31.0 + 45 * seed
        query = technique.encode(view(seed, heading_deg))
        turned_deg = (heading_deg + wrong_deg - headings_deg) % 360
        right = []
        for hint in ({}, {"turned_deg": turned_deg}):
            scores, by_rotation = technique.coarse_scores(query, rows, None, **hint)
            right.append(int(scores.argmax()) == seed)
        match = technique.match(query, places[seed].fine, np.flatnonzero(np.isfinite(by_rotation[seed])).tolist())
        off_deg = (match.rotation_deg - (heading_deg - headings_deg[seed]) + 180) % 360 - 180
        assert abs(off_deg) <= 7.5
        recalled.append(right)
    without, known = np.sum(recalled, axis=0)
    assert known >= without
    assert known == PLACES
