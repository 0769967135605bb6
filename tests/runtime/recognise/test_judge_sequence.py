"""When the best place of a sequence is accepted: never before it is full, nor at a speed that is not followed."""

import math

import numpy as np
import pytest

from edgevpr.core.config import load_config
from edgevpr.core.contract import PartSpec, TechniqueSpec
from edgevpr.places.index import empty_index
from edgevpr.places.retrieve import Ranking
from edgevpr.places.sequence import SequenceSearch
from edgevpr.runtime.recognise.judge import AcceptRule, Findings, accept_rule, judge
from edgevpr.techniques import create

PLACES, LENGTH = 80, 6
RULE = AcceptRule(min_score=0.1, min_margin=0.05, neighbour_m=50.0)


def flown(velocity, start, leaves=18, seed=3):
    """(accepted, why, slot) of each query of a flight along places that look a little like the two around them; from
    query `leaves` on it shows nothing of the map."""
    index = empty_index(TechniqueSpec(name="test", parameters={}, coarse=PartSpec((1,), "<f4")), PLACES, None)
    index.place_ids[:] = np.arange(PLACES)
    noise = np.random.default_rng(seed)
    sequence, found = SequenceSearch(LENGTH), []
    for query in range(18):
        away = np.abs(np.arange(PLACES) - (start + velocity * query))
        here = np.exp(-away) if query < leaves else 0.0
        scores = (0.3 + 0.4 * here + 0.02 * noise.random(PLACES)).astype(np.float32)
        slots = np.argsort(-scores)
        ranking = Ranking(slots=slots, scores=scores[slots], compared={})
        ranking = sequence.follow(ranking, index, float(query))
        verdict = judge(Findings(ranking), index, RULE, sequence)
        found.append((verdict.accepted, verdict.reason, int(ranking.slots[0])))
    return found


@pytest.mark.parametrize("velocity", [0.8, 1.0, 1.2])
def test_a_flight_like_the_mapping_flight_is_accepted_from_the_first_full_sequence_on(velocity):
    found = flown(velocity, 5)
    assert [yes for yes, _, _ in found] == [False] * (LENGTH - 1) + [True] * (18 - LENGTH + 1)
    assert all(abs(slot - (5 + velocity * query)) <= 1 for query, (yes, _, slot) in enumerate(found) if yes)
    assert "4 queries of 6" in found[3][1]


@pytest.mark.parametrize(("velocity", "start"), [(2.0, 5), (3.0, 5), (0.0, 30), (0.3, 30), (-1.0, 60), (-2.0, 60)])
def test_at_another_speed_or_the_other_way_nothing_wrong_is_accepted(velocity, start):
    for query, (yes, _, slot) in enumerate(flown(velocity, start)):
        assert not yes or abs(slot - (start + velocity * query)) <= 2  # neighbours are no other place


@pytest.mark.parametrize("seed", range(8))
def test_an_aircraft_that_leaves_the_mapped_way_is_not_followed_beyond_it(seed):
    found = flown(1.0, 5, leaves=11, seed=seed)
    assert found[10][0]
    # The mean would bear it for some queries yet: it is far ahead of all other places.
    assert not any(yes for yes, _, _ in found[13:])
    assert any("no longer" in why for _, why, _ in found[11:14])


@pytest.mark.parametrize(
    ("queries", "least", "goes_on"),
    [
        ([(5, 0.5), (6, 0.4), (7, 0.3)], 0.299, True),
        ([(5, 0.5), (6, 0.4), (7, 0.3)], 0.31, False),  # too low for one query
        ([(5, 0.9), (60, 0.1), (20, 0.1)], 0.0, False),  # the newest was not compared with the place
    ],
)
def test_the_newest_query_must_still_see_the_place(queries, least, goes_on):
    sequence, near = SequenceSearch(3), abs(np.arange(PLACES) - 7) <= 2
    index = empty_index(TechniqueSpec(name="test", parameters={}, coarse=PartSpec((1,), "<f4")), PLACES, None)
    index.place_ids[:] = np.arange(PLACES)
    for query, (slot, score) in enumerate(queries):
        slots, scores = np.array([slot, 40, 50]), np.array([score, 0.1, 0.1], np.float32)
        sequence.follow(Ranking(slots=slots, scores=scores, compared={}), index, float(query))
    assert sequence.goes_on(near, min_score=least) == goes_on


def test_the_margin_of_a_mean_is_that_of_one_query_over_the_root_of_their_number():
    technique, config = create("hog"), load_config(None).match
    assert accept_rule(technique, config, 9).min_margin == pytest.approx(technique.min_margin / math.sqrt(9))
    assert accept_rule(technique, config).min_margin == technique.min_margin
    assert accept_rule(technique, config, 40).min_margin == accept_rule(technique, config, 10).min_margin
    technique.min_margin = 1.0  # what is never to be accepted is not in a sequence either
    assert accept_rule(technique, config, 9).min_margin == 1.0
    told = load_config(None, {"match.min_margin": 0.2}).match
    assert accept_rule(technique, told, 9).min_margin == 0.2
