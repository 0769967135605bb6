"""`cohog` looking down, where the heading is known: the rotation to expect, the three possible, and no less recall."""

import cv2
import numpy as np
import pytest
from pictures import textured

from edgevpr.techniques import create

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
    assert (scores <= everything).all()
    assert scores[0] == everything[0]
    assert scores[7] == everything[7]


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


def test_a_wrong_heading_finds_nothing_that_the_flight_would_accept(town):
    technique, headings_deg, places, rows = town
    heading_deg = 40.0
    query = technique.encode(view(3, heading_deg))
    _, by_rotation = technique.coarse_scores(query, rows, None, (heading_deg + 180 - headings_deg) % 360)
    scores = [
        technique.match(query, place.fine, np.flatnonzero(np.isfinite(allowed)).tolist()).score
        for place, allowed in zip(places, by_rotation, strict=True)
    ]
    assert max(scores) < technique.min_score


def test_a_camera_that_looks_ahead_has_no_rotations_to_choose_from():
    technique = create("cohog")
    places = [technique.encode(textured(seed)) for seed in range(3)]
    coarse = np.stack([place.coarse for place in places])
    mean = coarse.astype(np.float32).mean(axis=0)
    rows = technique.pack(coarse, mean)
    scores, by_rotation = technique.coarse_scores(places[1], rows, mean, np.array([90.0, np.nan, 0.0]))
    assert by_rotation is None
    np.testing.assert_array_equal(scores, technique.coarse_scores(places[1], rows, mean)[0])
