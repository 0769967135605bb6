"""Two looks at the same places for one query, joined to one ranking."""

from dataclasses import replace

import numpy as np

from edgevpr.core.contract import FineMatch
from edgevpr.places.retrieve import Ranking, together


def ranking(compared, rest=(), unread=()):
    slots = [*compared, *(slot for slot, _ in rest)]
    scores = [*compared.values(), *(score for _, score in rest)]
    matches = {slot: FineMatch(score) for slot, score in compared.items()}
    return Ranking(
        slots=np.array(slots), scores=np.array(scores, np.float32), compared=matches, unread=np.array(unread, np.intp)
    )


def test_of_a_place_that_both_compared_the_better_match_counts():
    one = ranking({4: 0.3, 7: 0.1}, rest=[(2, 0.09), (5, 0.08)])
    other = ranking({7: 0.5, 2: 0.06}, rest=[(9, 0.05), (5, 0.04)], unread=[3])
    both = together(one, other)
    assert both.slots.tolist() == [7, 4, 2, 5, 9]
    np.testing.assert_allclose(both.scores, [0.5, 0.3, 0.06, 0.06, 0.05], rtol=1e-6)
    assert {slot: match.score for slot, match in both.compared.items()} == {4: 0.3, 7: 0.5, 2: 0.06}
    assert both.unread.tolist() == [3]


def test_a_rival_of_the_first_look_stays_a_rival():
    both = together(ranking({1: 0.2, 8: 0.19}), ranking({1: 0.21, 6: 0.02}))
    assert both.slots.tolist() == [1, 8, 6]


def test_two_looks_have_tried_the_rotations_of_both():
    known, all_of_them = (replace(ranking({1: 0.2}), tried=tried) for tried in (0.125, 1.0))
    assert together(known, known).tried == 0.25
    assert together(known, all_of_them).tried == 1.0
