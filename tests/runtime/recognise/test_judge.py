"""The judge of a single query: score, lead, and how much of the place agrees."""

import math

import numpy as np
import pytest

from edgevpr.contract import FineMatch, PartSpec, TechniqueSpec
from edgevpr.landmarks.agreement import PROVEN, Agreement
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


def found(inliers, possible=250, shift_share=(0.1, 0.0), is_expected=True):
    """An agreement of so many landmarks."""
    return Agreement(
        inliers=inliers,
        matched=60,
        possible=possible,
        shift_share=shift_share,
        rotation_deg=0.0,
        scale=1.0,
        covariance_share2=(1e-4, 0.0, 1e-4),
        is_expected=is_expected,
    )


def held(score, ahead, proof, rival=0, rule=RULE, coverage=0.5):
    """The verdict on a match that scores so much, so far ahead of a place elsewhere."""
    index = empty_index(TechniqueSpec(name="test", parameters={}, coarse=PartSpec((1,), "<f4")), 10, None)
    scores = np.array([score, score - ahead], np.float32)
    matches = {slot: FineMatch(float(value), coverage=coverage) for slot, value in zip((0, 9), scores, strict=True)}
    ranking = Ranking(np.array([0, 9]), scores, matches)
    return judge(ranking, index, rule, Alone(), is_new=False, proof=proof, rival=rival)


@pytest.mark.parametrize(("score", "ahead", "coverage"), [(0.05, 0.04, 0.5), (0.15, 0.001, 0.5), (0.15, 0.1, 0.02)])
def test_landmarks_make_up_for_a_weak_vote(score, ahead, coverage):
    assert held(score, ahead, None, coverage=coverage).is_open
    assert held(score, ahead, found(PROVEN), coverage=coverage).accepted
    for proof, rival in (
        (found(PROVEN - 1), 0),
        (found(PROVEN), PROVEN // 2 + 1),
        (found(40), 21),
        (found(40, shift_share=(0.0, 0.001)), 0),
        (found(40, is_expected=False), 0),
    ):
        verdict = held(score, ahead, proof, rival, coverage=coverage)
        assert (verdict.accepted, verdict.is_open) == (False, False)


@pytest.mark.parametrize("score", [0.0, 0.039, math.nan])
def test_landmarks_make_up_for_no_vote_at_all(score):
    assert not held(score, 0.0, None).is_open
    assert not held(score, 0.0, found(200)).accepted


def test_a_rule_that_accepts_nothing_is_not_made_up_for():
    assert not held(0.5, 0.2, None, rule=AcceptRule(min_score=0.08, min_margin=1.0, neighbour_m=50.0)).is_open


@pytest.mark.parametrize(
    ("score", "proof", "accepted"),
    [
        (0.3, found(4), False),
        (0.3, found(0), False),
        (0.3, found(5), True),
        (0.3, found(0, possible=99), True),
        (0.19, found(0), True),
        (0.12, found(30, is_expected=False), False),
    ],
)
def test_a_clear_vote_without_landmarks_that_agree_is_refused(score, proof, accepted):
    assert held(score, 0.1, proof).accepted == accepted


def test_a_sequence_is_not_open_to_proof():
    index = empty_index(TechniqueSpec(name="test", parameters={}, coarse=PartSpec((1,), "<f4")), 10, None)
    search = SequenceSearch(2)
    ranking = Ranking(np.array([0, 9]), np.array([0.05, 0.01], np.float32), {})
    search.follow(ranking, index, 0.0)
    search.follow(ranking, index, 1.0)
    assert not judge(ranking, index, RULE, search, is_new=False).is_open
