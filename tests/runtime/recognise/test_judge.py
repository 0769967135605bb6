"""The judge of a single query: score, lead, and how much of the place agrees."""

import math

import numpy as np
import pytest

from edgevpr.contract import FineMatch, PartSpec, TechniqueSpec
from edgevpr.places.index import empty_index
from edgevpr.places.retrieve import Ranking
from edgevpr.places.sequence import Alone, SequenceSearch
from edgevpr.runtime.recognise.judge import AcceptRule, judge

RULE = AcceptRule(min_score=0.08, min_margin=0.03, neighbour_m=50.0)


def judged(coverage, scores=(0.2, 0.1)):
    index = empty_index(TechniqueSpec(name="test", parameters={}, coarse=PartSpec((1,), "<f4")), 10, None)
    slots = np.array([0, 9])[: len(scores)]
    matches = {int(slot): FineMatch(score, coverage=coverage) for slot, score in zip(slots, scores, strict=True)}
    ranking = Ranking(slots, np.array(scores, np.float32), matches)
    return judge(ranking, index, RULE, Alone(), is_new=False)


@pytest.mark.parametrize("coverage", [0.0, 0.031, 0.0399, math.nan])
def test_a_match_in_which_little_of_the_place_agrees_is_refused(coverage):
    verdict = judged(coverage)
    assert not verdict.accepted
    assert verdict.reason.endswith("% of the place agrees, 4% needed")


@pytest.mark.parametrize("coverage", [0.04, 0.05, 1.0])
def test_a_match_in_which_enough_of_the_place_agrees_is_accepted(coverage):
    assert judged(coverage).accepted


def test_a_technique_that_does_not_count_what_agrees_is_judged_by_its_score():
    assert judged(None).accepted
    assert "is below" in judged(None, (0.05, 0.0)).reason
    assert "ahead of a place elsewhere" in judged(None, (0.2, 0.19)).reason


def test_in_a_sequence_the_newest_query_need_not_be_sure_by_itself():
    index = empty_index(TechniqueSpec(name="test", parameters={}, coarse=PartSpec((1,), "<f4")), 10, None)
    search, verdicts = SequenceSearch(2), []
    for query in range(2):
        scores = np.full(10, 0.02, np.float32)
        scores[4 + query] = 0.3
        slots = np.argsort(-scores, kind="stable")
        matches = {int(slot): FineMatch(float(scores[slot]), coverage=0.01) for slot in slots}
        ranking = search.follow(Ranking(slots, scores[slots], matches), index, float(query))
        verdicts.append(judge(ranking, index, RULE, search, is_new=False))
    assert verdicts[-1].accepted, verdicts[-1].reason


def test_where_there_is_no_place_elsewhere_what_agrees_counts_all_the_same():
    assert judged(0.05, (0.2,)).accepted
    assert not judged(0.03, (0.2,)).accepted
