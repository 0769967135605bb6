"""Rankings: which hypotheses are tried, and how two rankings of a query are merged."""

import dataclasses

import numpy as np
import pytest
from ranking import make_index

from edgevpr.core.contract import FineMatch
from edgevpr.places.ranking import Ranking, merge_rankings, outside_neighbourhood
from edgevpr.places.retrieve import choose_best


def choose_hypotheses(by_hypothesis, count, among=None):
    among = np.ones(len(by_hypothesis), bool) if among is None else among
    return dict(choose_best(by_hypothesis.max(axis=1), by_hypothesis, among, count))


def test_choose_hypotheses_takes_the_best_of_many_places():
    by_hypothesis = np.random.default_rng(1).random((500, 24), dtype=np.float32)
    found = choose_hypotheses(by_hypothesis, 60)
    assert sum(len(each) for each in found.values()) == 60
    least = min(by_hypothesis[slot, each].min() for slot, each in found.items())
    left = by_hypothesis.copy()
    for slot, each in found.items():
        left[slot, each] = 0
    assert left.max() <= least
    assert len(found) > 20


@pytest.mark.parametrize(("places", "most"), [(1, 24), (2, 24), (5, 12), (19, 3), (20, 3), (60, 3)])
def test_choose_hypotheses_takes_more_per_place_if_there_are_few_places(places, most):
    by_hypothesis = np.random.default_rng(3).random((places, 24), dtype=np.float32)
    by_hypothesis[0] += 1
    found = choose_hypotheses(by_hypothesis, 60)
    assert len(found[0]) == most
    assert sum(len(each) for each in found.values()) == min(60, places * most)


def test_choose_hypotheses_skips_excluded_ones_without_adding_places():
    by_hypothesis = np.random.default_rng(4).random((500, 24), dtype=np.float32)
    by_hypothesis[:, 3:] = -np.inf
    by_hypothesis[7] = 0.5  # one place of which nothing is known does not change what all take
    found = choose_hypotheses(by_hypothesis, 10)
    assert sum(len(each) for each in found.values()) == 10
    assert {number for slot, each in found.items() for number in each if slot != 7} == {0, 1, 2}
    by_hypothesis[:] = -np.inf
    assert not choose_hypotheses(by_hypothesis, 10)


def test_choose_hypotheses_takes_only_those_of_the_requested_places():
    by_hypothesis = np.random.default_rng(5).random((500, 24), dtype=np.float32)
    among = np.zeros(500, bool)
    assert not choose_hypotheses(by_hypothesis, 10, among)
    among[100:103] = True
    assert sorted(choose_hypotheses(by_hypothesis, 10, among)) == [100, 101, 102]


def ranking(compared, rest=(), unread=()):
    slots = [*compared, *(slot for slot, _ in rest)]
    scores = [*compared.values(), *(score for _, score in rest)]
    matches = {slot: FineMatch(score) for slot, score in compared.items()}
    slots, scores, unread = np.array(slots), np.array(scores, np.float32), np.array(unread, np.intp)
    return Ranking(slots=slots, scores=scores, compared=matches, unread=unread)


def test_merge_rankings_keeps_the_better_match_of_a_place_in_both():
    one = ranking({4: 0.3, 7: 0.1}, rest=[(2, 0.09), (5, 0.08)])
    both = merge_rankings(one, ranking({7: 0.5, 2: 0.06}, rest=[(9, 0.05), (5, 0.04)], unread=[3]))
    assert both.slots.tolist() == [7, 4, 2, 5, 9]
    np.testing.assert_allclose(both.scores, [0.5, 0.3, 0.06, 0.06, 0.05], rtol=1e-6)
    assert {slot: match.score for slot, match in both.compared.items()} == {4: 0.3, 7: 0.5, 2: 0.06}
    assert both.unread.tolist() == [3]


def test_merge_rankings_adds_the_rotations_tried():
    known, all_of_them = (dataclasses.replace(ranking({1: 0.2}), tried=tried) for tried in (0.125, 1.0))
    assert merge_rankings(known, known).tried == 0.25
    assert merge_rankings(known, all_of_them).tried == 1.0


def test_promote_moves_a_place_to_the_front():
    promoted = ranking({4: 0.3, 7: 0.2, 2: 0.1}).promote(2)
    assert (promoted.slots.tolist(), promoted.tried) == ([2, 4, 7], 1.0)
    np.testing.assert_allclose(promoted.scores, [0.1, 0.3, 0.2], rtol=1e-6)


def test_outside_neighbourhood_excludes_two_neighbours_and_the_same_places():
    index, slots = make_index(range(10, 17)), np.arange(7)
    assert outside_neighbourhood(index, 3, slots, 50.0).tolist() == [True, False, False, False, False, False, True]
    assert outside_neighbourhood(index, 3, slots, 50.0, same_ids=(10,)).tolist() == [False] * 6 + [True]
    assert outside_neighbourhood(index, 3, slots, 50.0, max_slots=3).tolist() == [False] * 7
