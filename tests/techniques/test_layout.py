"""Layouts of places: how they move with the picture, what of them is stored, and that a place is found however seen."""

import numpy as np
import pytest
from pictures import draw_texture, render_view

from edgevpr.techniques import layout
from edgevpr.techniques.cohog import CoHog

SIDE_PX = 256
PLACES = 6
SHIFTS_PX = ((0, 0), (40, 0), (-30, 30), (0, -60))
NOTHING = 0x88


def draw_view(seed, rotation_deg=0.0, right_px=0, down_px=0):
    """The ground of a place."""
    return render_view(draw_texture(seed, 3 * SIDE_PX, 3 * SIDE_PX), SIDE_PX, rotation_deg, right_px, down_px)


@pytest.fixture(scope="module")
def town():
    technique = CoHog(camera="nadir")
    return technique, np.stack([technique.encode(draw_view(seed)).coarse for seed in range(PLACES)])


def test_compute_agreement_is_high_at_the_shift_between_two_layouts():
    ground = np.random.default_rng(3).normal(size=(12, 20, 20)).astype(np.float32)
    ground /= np.linalg.norm(ground, axis=0)
    place, query = ground[:, 4:16, 4:16], ground[:, 6:18, 3:15]  # the camera is a cell to the left, and two below
    there = layout.compute_agreement(query, place, (-1 / 12, 2 / 12))
    assert there == pytest.approx(np.sqrt(11 * 10) / 12), "as many of all cells as are seen"
    assert layout.compute_agreement(query, place, (0, 2 / 12)) == there  # up to a cell beside
    assert layout.compute_agreement(query, place, (3 / 12, -2 / 12)) < 0.3
    assert layout.compute_agreement(query, place, (1.5, 0)) == 0
    assert layout.compute_agreement(np.zeros_like(query), place, (0, 0)) == 0


@pytest.mark.parametrize("step", range(layout.ROTATIONS))
def test_score_places_finds_place_and_rotation_of_a_moved_camera(town, step):
    technique, rows = town
    query = technique.encode(draw_view(step % PLACES, 15 * step, *SHIFTS_PX[step % len(SHIFTS_PX)]))
    scores, by_hypothesis = technique.score_places(query, rows, None)
    assert scores.argmax() == step % PLACES
    assert by_hypothesis[step % PLACES].argmax() % layout.ROTATIONS == step


def test_score_places_examines_only_likely_places_closely(town):
    technique, rows = town
    query = technique.encode(draw_view(1))
    _, by_hypothesis = technique.score_places(query, rows, None)
    likely = np.arange(PLACES) % 2 == 0
    scores, restricted = technique.score_places(query, rows, None, in_reach=likely)
    np.testing.assert_allclose(restricted[likely], by_hypothesis[likely], atol=1e-6)
    unlikely = restricted[~likely]
    assert (unlikely[np.isfinite(unlikely)] < 0).all()
    assert scores[1] == 0
    assert unlikely.max() == restricted[1].max(), "by the coarse grid the place comes first of them"


@pytest.mark.parametrize("headings", [False, True])
def test_score_places_scores_all_places_in_reach_and_some_others_of_a_large_map(town, headings):
    technique, rows = town
    query = technique.encode(draw_view(1))
    large = np.repeat(rows, 12_000 // PLACES, axis=0)
    rotation_deg = np.where(np.arange(len(large)) % 3, 0.0, np.nan) if headings else None
    likely = np.arange(len(large)) % 100 == 7
    scores, of_some = technique.score_places(query, large, None, rotation_deg, in_reach=likely)
    _, of_all = technique.score_places(query, large, None, rotation_deg)
    np.testing.assert_array_equal(np.isfinite(of_some[likely]), np.isfinite(of_all[likely]))
    rivals = np.isfinite(of_some[~likely]).any(axis=1)
    assert 2048 <= rivals.sum() <= 4096
    assert np.diff(np.flatnonzero(rivals)).max() <= 5
    few = np.repeat(rows, 4000 // PLACES, axis=0)
    _, of_few = technique.score_places(query, few, None, in_reach=np.arange(len(few)) == 7)
    assert np.isfinite(of_few).any(axis=1).all()
    assert (scores[~likely] == 0).all()


def test_rows_of_any_bytes_have_finite_scores(town):
    technique, _ = town
    damaged = np.random.default_rng(2).integers(0, 256, (4, layout.PLACE_BYTES), np.uint8)
    damaged[1:] = np.array([[0], [255], [NOTHING + 1]])
    scores, by_hypothesis = technique.score_places(technique.encode(draw_view(2)), damaged, None)
    assert np.isfinite(scores).all()
    assert np.isfinite(by_hypothesis).sum() == layout.ROTATIONS * len(damaged)


def test_score_places_matches_nothing_without_a_good_region(town):
    technique, rows = town
    empty = technique.encode(np.full((SIDE_PX, SIDE_PX), 90, np.uint8))
    assert (empty.coarse == NOTHING).all()
    with_empty = np.stack([*rows[:2], empty.coarse])
    assert (technique.score_places(empty, with_empty, None)[0] == 0).all()
    scores, by_hypothesis = technique.score_places(technique.encode(draw_view(0)), with_empty, None)
    assert scores.argmax() == 0
    assert scores[2] == 0
    assert np.isfinite(by_hypothesis).sum() == layout.ROTATIONS * 3


def list_possible_rotations(by_hypothesis):
    """Degrees of the rotations that are not out of the question, place by place."""
    return [sorted({15 * int(at) % 360 for at in np.flatnonzero(np.isfinite(scores))}) for scores in by_hypothesis]


@pytest.mark.slow
def test_score_places_allows_only_rotations_near_the_expected_one(town):
    technique, rows = town
    query, rows = technique.encode(draw_view(0)), np.resize(rows, (8, layout.PLACE_BYTES))
    scores, by_rotation = technique.score_places(query, rows, None, np.array([0, 7, 8, 100, 352, 353, 359.9, np.nan]))
    sets = list_possible_rotations(by_rotation)
    assert sets[:3] == [[0, 15, 345], [0, 15, 345], [0, 15, 30]]
    assert sets[3:7] == [[90, 105, 120], [0, 330, 345], [0, 15, 345], [0, 15, 345]]
    everything, by_rotation = technique.score_places(query, rows, None)
    assert sets[7] == list_possible_rotations(by_rotation)[7] == list(range(0, 360, 15))
    assert (scores <= everything + 1e-6).all()
    np.testing.assert_allclose(scores[[0, 7]], everything[[0, 7]], atol=1e-6)
