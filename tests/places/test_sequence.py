"""Sequences against the paper's search, word by word; when a sequence begins anew; how much memory it takes."""

import math
import tracemalloc

import numpy as np
import pytest
from ranking import make_index

from edgevpr.core.contract import FineMatch
from edgevpr.places.ranking import Ranking
from edgevpr.places.sequence import SequenceSearch, compute_sequence_bytes

ASSUMED_SPEEDS = (0.8, 0.9, 1.0, 1.1, 1.2)
OTHERS = [quarter / 4 for quarter in range(-10, 13) if quarter != 4]


def literal(scores, length, velocities=ASSUMED_SPEEDS):
    """Equations 4 to 6 of Milford and Wyeth 2012, each path from its end at the newest query, as mean scores."""
    queries, places = len(scores), len(scores[0])
    found = np.zeros((queries, places))
    for newest in range(queries):
        frames = min(newest + 1, length)
        for end in range(places):
            for velocity in velocities:
                total = 0.0
                for age in range(frames):
                    place = end - math.floor(velocity * age + 0.5 + 1e-9)
                    if 0 <= place < places:
                        total += float(scores[newest - age][place])
                found[newest, end] = max(found[newest, end], total / frames)
    return found


def make_ranking(scores, slots=None):
    """The ranking of one query: all slots, or those that were compared in full."""
    slots = np.arange(len(scores)) if slots is None else np.array(slots)
    slots = slots[np.argsort(-scores[slots], kind="stable")]
    matches = {
        slot: FineMatch(float(scores[slot]), shift_cells=(float(slot), 1.0), rotation_deg=30.0)
        for slot in slots.tolist()
    }
    return Ranking(slots=slots, scores=scores[slots].astype(np.float32), compared=matches)


def to_dense(ranking, places):
    scores = np.zeros(places, np.float32)
    scores[ranking.slots] = ranking.scores
    return scores


def search_sequence(sequence, scores, index, step_s=1.0):
    return [sequence.add_query(make_ranking(row), index, at * step_s) for at, row in enumerate(scores)]


@pytest.fixture
def scores():
    return np.random.default_rng(7).random((25, 40), dtype=np.float32)


@pytest.mark.parametrize("length", [2, 5, 10, 30])
def test_sequence_search_equals_the_paper(scores, length):
    sequence = SequenceSearch(length)
    online = np.stack([to_dense(each, 40) for each in search_sequence(sequence, scores, make_index(range(40)))])
    np.testing.assert_allclose(online, literal(scores, length), rtol=1e-5)
    assert sequence.frames == min(length, 25)
    np.testing.assert_allclose(sequence.rivals, literal(scores, length, OTHERS)[-1], rtol=1e-5)


def test_sequence_search_in_two_stages_equals_the_dense_search(scores):
    candidates = np.argsort(-scores, axis=1)[:, :6]
    compared = np.take_along_axis(scores, candidates, axis=1)
    sparse = np.repeat(np.median(compared, axis=1)[:, None], 40, axis=1)  # the usual score, where none was made
    np.put_along_axis(sparse, candidates, compared, axis=1)
    sequence, index = SequenceSearch(4), make_index(range(40))
    rankings = [sequence.add_query(make_ranking(scores[at], candidates[at]), index, at) for at in range(25)]
    np.testing.assert_allclose(np.stack([to_dense(each, 40) for each in rankings]), literal(sparse, 4), rtol=1e-5)


def test_sequence_search_resolves_look_alikes_by_earlier_queries():
    """Place 30 looks a little more like the query than place 12, where the aircraft is; the way there does not."""
    scores = np.full((6, 40), 0.3, np.float32)
    for at in range(6):
        scores[at, 7 + at] = 0.6
    scores[5, 30] = 0.7
    index = make_index(range(40))
    assert [each.slots[0] for each in search_sequence(SequenceSearch(5), scores, index)] == [7, 8, 9, 10, 11, 12]


def test_sequence_matches_keep_the_shift_of_the_newest_query_and_score_the_sequence(scores):
    sequence, index = SequenceSearch(3), make_index(range(40))
    sequence.add_query(make_ranking(scores[0], range(20)), index, 0.0)
    ranking = sequence.add_query(make_ranking(scores[1], range(10, 30)), index, 1.0)
    assert (np.diff(ranking.scores) <= 0).all()
    assert set(ranking.slots) == set(range(40))
    assert set(ranking.compared) == set(range(10, 30))
    scored = dict(zip(ranking.slots.tolist(), ranking.scores.tolist(), strict=True))
    for slot, match in ranking.compared.items():
        assert match == FineMatch(scored[slot], shift_cells=(float(slot), 1.0), rotation_deg=30.0)


def test_sequence_search_restarts_after_a_time_gap(scores):
    sequence, index = SequenceSearch(5), make_index(range(40))
    search_sequence(sequence, scores[:5], index)
    assert sequence.frames == 5
    fresh = sequence.add_query(make_ranking(scores[5]), index, 4.0 + 5.1)
    assert sequence.frames == 1
    np.testing.assert_array_equal(to_dense(fresh, 40), scores[5])
    sequence.add_query(make_ranking(scores[6]), index, 10.0)
    assert sequence.frames == 2


@pytest.mark.slow
def test_sequence_memory_stays_within_its_declared_size():
    places, length = 50_000, 10
    index = make_index(range(places))
    scores = np.random.default_rng(2).random(places, dtype=np.float32)
    few = make_ranking(scores, np.argsort(-scores)[:40])
    sequence = SequenceSearch(length)
    tracemalloc.start()
    for at in range(3 * length):
        sequence.add_query(few, index, float(at))
    kept, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert kept < 1.02 * places * compute_sequence_bytes(length) == 1.02 * places * 44


@pytest.mark.parametrize(
    ("queries", "least", "is_continued"),
    [
        ([(5, 0.5), (6, 0.4), (7, 0.3)], 0.299, True),
        ([(5, 0.5), (6, 0.4), (7, 0.3)], 0.31, False),  # too low for one query
        ([(5, 0.9), (60, 0.1), (20, 0.1)], 0.0, False),  # the newest was not compared with the place
    ],
)
def test_sequence_search_requires_the_newest_query_to_show_the_place(queries, least, is_continued):
    sequence, near = SequenceSearch(3), abs(np.arange(80) - 7) <= 2
    index = make_index(range(80))
    for query, (slot, score) in enumerate(queries):
        slots, scores = np.array([slot, 40, 50]), np.array([score, 0.1, 0.1], np.float32)
        sequence.add_query(Ranking(slots=slots, scores=scores, compared={}), index, float(query))
    assert sequence.is_continued(near, min_score=least) == is_continued
