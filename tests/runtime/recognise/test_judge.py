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


def behind(*others, best=(0.3, (0.2, -0.1), 0.0)):
    """The verdict on a best place and two places elsewhere: the score, step and rotation of each."""
    index = empty_index(TechniqueSpec(name="test", parameters={}, coarse=PartSpec((1,), "<f4")), 30, None)
    slots = np.array([0, 10, 20])[: 1 + len(others)]
    matches = {
        int(slot): FineMatch(score, shift_cells=step, rotation_deg=turn, coverage=0.5)
        for slot, (score, step, turn) in zip(slots, (best, *others), strict=True)
    }
    ranking = Ranking(slots, np.array([match.score for match in matches.values()], np.float32), matches)
    return judge(ranking, index, RULE, Alone(), is_new=False)


@pytest.mark.parametrize("step", [(0.0, 0.0), (-1.4, 1.4)])
def test_places_far_apart_that_have_not_moved_either_share_a_display(step):
    verdict = behind((0.2, (9.0, 3.0), 0.0), (0.15, step, 0.0))
    assert not verdict.accepted
    assert "--learn-mask" in verdict.reason


@pytest.mark.parametrize(
    "other", [(0.15, (1.6, 0.0), 0.0), (0.15, (0.0, 0.0), 15.0), (0.07, (0.0, 0.0), 0.0), (0.15, (0.0, 0.0), None)]
)
def test_places_that_agree_by_another_step_share_none(other):
    assert behind(other).accepted
    assert behind(other, (0.1, None, None)).accepted


def test_a_picture_that_has_moved_is_no_display():
    still = (0.15, (0.0, 0.0), 0.0)
    assert not behind(still).accepted
    assert behind(still, best=(0.3, (5.0, 0.0), 0.0)).accepted
    assert behind(still, best=(0.3, (0.0, 0.0), 180.0)).accepted
    assert behind(still, best=(0.3, (0.0, 0.0), None)).accepted, "looking ahead"


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


@pytest.mark.parametrize(("turn", "is_display"), [(3.0, True), (356.5, True), (9.0, False)])
def test_a_display_is_found_though_rotations_are_measured(turn, is_display):
    assert behind((0.15, (0.0, 0.0), turn)).accepted is not is_display
