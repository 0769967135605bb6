"""The judge: by a confidence, or by score and lead; what speaks against a match; and when the best place of a sequence
is accepted: never before it is full, nor at a speed that is not followed."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from fixed_confidence import NEEDED, FixedModel, make_agreement, make_bare_index, make_model, make_rule

from edgevpr.core.config import load_config
from edgevpr.core.contract import FineMatch
from edgevpr.core.reasons import Reason, ReasonCode
from edgevpr.core.types import Position
from edgevpr.places.ranking import Ranking
from edgevpr.places.sequence import SequenceSearch
from edgevpr.runtime.recognise.evidence import DOWN, DOWN_BARE, MAP_FIGURES, PLACE_FIGURES, Evidence, log_count
from edgevpr.runtime.recognise.judge import (
    AcceptRule,
    ConfidenceRule,
    Findings,
    check_texture,
    is_unshifted,
    judge,
    make_accept_rule,
)
from edgevpr.runtime.recognise.locate import Located
from edgevpr.runtime.recognise.perspective import ObservedTilt
from edgevpr.techniques import create

RULE = AcceptRule(min_score=0.08, min_margin=0.03, neighbour_m=50.0)


def decide(scores=(0.2, 0.1), rule=RULE, matches=None, predicted=1.0, **more):
    """The verdict on a best place and places elsewhere with these scores; `more` is known of the best."""
    slots = np.array([0, 10, 20])[: len(scores)]
    compared = dict(zip(slots.tolist(), matches or map(FineMatch, scores), strict=True))
    ranking = Ranking(slots=slots, scores=np.array(scores, np.float32), compared=compared)
    return judge(Findings(ranking, predicted=predicted, **more), make_bare_index(30), rule)


CLEAR = Evidence(agree=-1.6, lead=0.7, coverage=-0.5)
INVALID = Located(position=Position(47.0, 8.0), covariance_m2=(1.0, 0.0, 1.0), objection=Reason(ReasonCode.LOW_TEXTURE))


@pytest.mark.parametrize(("confidence", "accepted"), [(1.0, True), (NEEDED, True), (0.8999, False), (math.nan, False)])
def test_judge_accepts_a_match_from_the_required_confidence(confidence, accepted):
    verdict = decide(rule=make_rule(lambda evidence: confidence), evidence=CLEAR)
    assert verdict.accepted is accepted
    assert verdict.reason.code is (ReasonCode.ACCEPTED_BY_CONFIDENCE if accepted else ReasonCode.LOW_CONFIDENCE)
    figures = {"confidence": confidence, "min_confidence": 0.9, "regions_ratio": math.exp(CLEAR.lead)}
    assert {name: verdict.reason.parameters[name] for name in figures} == pytest.approx(figures, nan_ok=True)
    alone = decide((0.2,), make_rule(lambda evidence: confidence), evidence=CLEAR)
    assert alone.accepted is accepted, "no place elsewhere"


@pytest.mark.parametrize(
    ("confidence", "of_map", "lead", "is_undecided"),
    [(0.3, 0.5, 0.7, True), (NEEDED, 0.99, 0.7, False), (0.3, 0.49, 0.7, False), (0.3, 0.99, 0.0, False)],
)
def test_judge_requests_more_evidence_only_if_it_can_decide(confidence, of_map, lead, is_undecided):
    rule = make_model(lambda evidence: confidence, lambda evidence: of_map)
    assert rule.is_undecided(replace(CLEAR, lead=lead)) == is_undecided


def test_cap_confidence_shows_no_more_than_the_data_support():
    rule = ConfidenceRule(dict.fromkeys(MAP_FIGURES, FixedModel(lambda evidence: 1.0, max_reported=0.9998)), 0.999)
    assert (rule.confidence(CLEAR), rule.cap_confidence(CLEAR)) == (1.0, 0.9998)
    assert (rule.cap_confidence(CLEAR, 0.9999999), rule.cap_confidence(CLEAR, 0.95)) == (0.9998, 0.95)
    down = make_accept_rule(create("cohog", {"camera": "nadir"}), load_config(None).match).confidence_rule
    assert down.cap_confidence(replace(CLEAR, lead=30.0)) <= 1 - 1 / 10_000


def test_judge_requires_landmarks_or_track_for_weak_forward_regions():
    rule = make_rule(lambda evidence: 1.0, needed=0.9999)
    hardly = replace(CLEAR, likeness=0.9, rank_gap=0.0, proof=0.0, lead=0.3, twin=-0.1)
    assert rule.confidence_rule.confidence(hardly) == 0.9
    refused = decide(rule=rule, evidence=hardly)
    assert (refused.accepted, refused.reason.code) == (False, ReasonCode.LANDMARKS_NEEDED)
    assert decide(rule=rule, evidence=replace(hardly, landmarks=log_count(9))).accepted
    assert decide(rule=rule, evidence=hardly, track_confidence=0.9999).accepted
    twin = replace(hardly, landmarks=log_count(30), twin=0.1)
    assert rule.confidence_rule.confidence(twin) == 0.5
    assert decide(rule=rule, evidence=twin).reason.code is ReasonCode.LOOKS_ALIKE


@pytest.mark.parametrize(
    ("confidence", "followed", "accepted"),
    [
        (0.5, 0.9999, True),
        (0.5, 0.999, True),  # as precise as asked
        (0.5, 0.9989, False),
        (0.991, 0.9991, True),  # its odds are raised ten times
        (0.9912, 0.9991, False),
        (1.0, 0.5, True),
        (1.0, 0.49, False),
    ],
)
def test_judge_requires_only_the_precision_if_the_track_makes_the_place_much_likelier(confidence, followed, accepted):
    rule = make_rule(lambda evidence: confidence, needed=0.9999)
    assert decide(rule=rule, evidence=CLEAR, track_confidence=followed).accepted == accepted
    assert decide(rule=rule, evidence=CLEAR).accepted is (confidence == 1.0)


@pytest.mark.parametrize(("predicted", "accepted"), [(0.5, True), (0.49, False), (None, False)])
def test_judge_lets_the_track_decide_only_where_it_predicted_the_place(predicted, accepted):
    track = {"track_confidence": 0.9999, "predicted": predicted}
    assert decide(rule=make_rule(lambda evidence: 0.5), evidence=CLEAR, **track).accepted is accepted
    assert decide(rule=make_rule(lambda evidence: 1.0), evidence=CLEAR, **track).accepted, "it needs no track"


@pytest.mark.parametrize(("followed", "accepted"), [(0.99, True), (0.9899, False)])
def test_judge_requires_a_certain_track_if_the_track_decides(followed, accepted):
    rule = make_rule(lambda evidence: 0.5)
    rule = replace(rule, confidence_rule=replace(rule.confidence_rule, precision=0.5))
    assert decide(rule=rule, evidence=CLEAR, track_confidence=followed).accepted is accepted


@pytest.mark.parametrize(("lead", "code"), [(math.log(1.75), None), (math.log(1.74), ReasonCode.ROTATION_AMBIGUOUS)])
def test_judge_requires_a_lead_over_the_image_at_another_rotation(lead, code):
    verdict = decide(rule=make_rule(lambda evidence: 1.0), evidence=CLEAR, lead_over_other_rotation=lead)
    assert verdict.reason.code is (code or ReasonCode.ACCEPTED_BY_CONFIDENCE)


@pytest.mark.parametrize(
    ("known", "code"),
    [
        ({"tilt": ObservedTilt(math.tan(math.radians(60.1)), 0.0)}, ReasonCode.TILT_SHOWN),
        ({"tilt": ObservedTilt(math.tan(math.radians(59.9)), 0.0)}, ReasonCode.ACCEPTED_BY_SCORE),
        ({"located": INVALID}, ReasonCode.LOW_TEXTURE),
    ],
)
def test_judge_refuses_a_match_for_its_tilt_and_its_position(known, code):
    verdict = decide(**known)
    assert verdict.reason.code is code
    assert verdict.accepted is (code is ReasonCode.ACCEPTED_BY_SCORE)


@pytest.mark.parametrize(
    ("scores", "limits", "code"),
    [
        ((0.25, 0.125), {"min_score": 0.25, "min_margin": 0.125}, ReasonCode.ACCEPTED_BY_SCORE),
        ((0.25, 0.125), {"min_score": 0.26}, ReasonCode.LOW_SCORE),
        ((0.25, 0.126), {"min_margin": 0.125}, ReasonCode.LOW_MARGIN),
        ((0.25,), {"min_score": 0.25}, ReasonCode.ACCEPTED_WITHOUT_RIVAL),
        ((0.25,), {"min_score": 0.26}, ReasonCode.LOW_SCORE),  # no place elsewhere makes it sure
        ((0.25,), {"min_score": 0.0}, ReasonCode.NO_RIVAL),
        ((0.25, 0.125), {"min_score": 0.0}, ReasonCode.ACCEPTED_BY_SCORE),
    ],
)
def test_judge_accepts_values_equal_to_the_limits(scores, limits, code):
    verdict = decide(scores, replace(RULE, **limits))
    assert verdict.reason.code is code
    assert verdict.accepted is code.name.startswith("ACCEPTED")


@pytest.mark.parametrize(("quality", "needed"), [(0.3, None), (0.29, 0.3), (math.nan, 0.3)])
def test_check_texture_accepts_an_image_of_sufficient_quality(quality, needed):
    reason = check_texture(SimpleNamespace(quality=quality), 0.3)
    assert (reason and reason.parameters["min_share"]) == needed


def test_judge_accepts_the_place_of_the_track_over_the_best_score():
    rule = make_accept_rule(create("cohog"), load_config(None, {}).match)
    rule = replace(rule, confidence_rule=make_model(lambda evidence: 0.5))
    assert decide((0.19, 0.2), rule, evidence=CLEAR, track_confidence=0.9999).accepted
    assert not decide((0.19, 0.2), rule, evidence=CLEAR).accepted
    assert not decide((0.19, 0.2), replace(rule, min_margin=0.0), evidence=CLEAR, track_confidence=0.9999).accepted


@pytest.mark.parametrize(("lead", "accepted"), [(0.0, True), (-0.01, False)])
def test_judge_never_accepts_by_track_alone_what_another_place_beats_in_the_image(lead, accepted):
    rule = make_rule(lambda evidence: 0.5)
    verdict = decide(rule=rule, evidence=replace(CLEAR, lead=lead), track_confidence=0.9999)
    assert verdict.accepted is accepted
    assert (verdict.reason.code is ReasonCode.ELSEWHERE_AGREES_BETTER) is not accepted


def test_judge_refuses_a_match_without_evidence():
    assert not decide(rule=make_rule(lambda evidence: 1.0)).accepted


@pytest.mark.parametrize("limit", [{"min_score": 0.21}, {"min_margin": 0.11}, {"min_verify_score": 0.21}])
def test_judge_applies_limits_in_addition_to_the_confidence(limit):
    assert decide(rule=make_rule(lambda evidence: 1.0), evidence=CLEAR).accepted
    assert not decide(rule=make_rule(lambda evidence: 1.0, **limit), evidence=CLEAR).accepted


@pytest.mark.parametrize("score", [math.nan, 0.019])
def test_judge_does_not_compensate_a_low_score_with_a_high_confidence(score):
    assert not decide((score, 0.0), make_rule(lambda evidence: 1.0, min_verify_score=0.02), evidence=CLEAR).accepted


@pytest.mark.parametrize("kind", [DOWN, DOWN_BARE])
@pytest.mark.parametrize("precision", [0.5, 0.999])
def test_confidence_is_low_without_a_lead_over_other_places(kind, precision):
    """Whatever the shipped models say."""
    config = load_config(None, {"match.accept_precision": precision}).match
    rule = make_accept_rule(create("cohog", {"camera": "nadir"}), config).confidence_rule
    evidence = Evidence(agree=0.0, **dict.fromkeys(MAP_FIGURES[kind] + PLACE_FIGURES[kind], 5.0) | {"lead": 0.04})
    assert rule.confidence(evidence) <= 0.5 < rule.threshold(evidence)


def test_make_accept_rule_uses_limits_for_sequences_and_techniques_without_evidence():
    config = load_config(None).match
    by_confidence, technique = make_accept_rule(create("cohog", {"w1": 208}), config), create("cohog")
    assert by_confidence.confidence_rule
    assert (by_confidence.min_score, by_confidence.min_margin) == (0.0, -math.inf)
    assert by_confidence.min_verify_score == technique.min_score / 2
    assert make_accept_rule(create("cohog", {"w1": 208}), config, length=3).confidence_rule is None
    assert make_accept_rule(create("hog"), config).confidence_rule is None


def test_judge_refuses_a_sequence_whose_newest_query_was_not_compared_with_the_place():
    search = SimpleNamespace(frames=2, length=2)
    ranking = Ranking(slots=np.array([0, 10]), scores=np.array([0.2, 0.1], np.float32), compared={10: FineMatch(0.1)})
    assert judge(Findings(ranking), make_bare_index(30), RULE, search).reason.code is ReasonCode.NEWEST_DISAGREES


@pytest.mark.parametrize(("rival", "accepted"), [(0.25, True), (0.26, False)])
def test_judge_requires_a_sequence_to_lead_over_other_speeds_by_half_the_margin(rival, accepted):
    rivals = np.zeros(30, np.float32)
    rivals[10] = rival
    search = SimpleNamespace(frames=2, length=2, rivals=rivals, is_continued=lambda near, least: True)
    ranking = Ranking(slots=np.array([20, 10]), scores=np.array([0.5, 0.0], np.float32), compared={})
    verdict = judge(Findings(ranking), make_bare_index(30), replace(RULE, min_margin=0.5), search)
    assert verdict.accepted is accepted
    assert accepted or verdict.reason.code is ReasonCode.LOW_MARGIN_AT_OTHER_SPEED


@pytest.mark.parametrize(("share", "accepted"), [(0.0, True), (0.4, True), (4 / 9, False)])
def test_judge_refuses_unshifted_matches_of_other_places_as_an_overlay(share, accepted):
    verdict = decide(unshifted_fraction=share)
    assert verdict.accepted is accepted
    assert (verdict.reason.code is ReasonCode.ELSEWHERE_AT_REST) is not accepted


@pytest.mark.parametrize(
    ("shift_cells", "rotation_deg", "height_ratio", "expected"),
    [
        ((0.2, -0.1), 0.0, 1.0, True),
        ((-0.75, 0.7), 352.5, None, True),
        ((0.0, 0.0), 0.0, 0.81, True),
        ((0.76, 0.0), 0.0, 1.0, False),
        ((0.0, 0.0), 7.6, 1.0, False),
        ((0.0, 0.0), 0.0, 1.21, False),
        ((0.0, 0.0), None, None, False),
    ],
)
def test_is_unshifted_requires_no_shift_rotation_or_height_change(shift_cells, rotation_deg, height_ratio, expected):
    match = FineMatch(0.3, shift_cells=shift_cells, rotation_deg=rotation_deg, height_ratio=height_ratio)
    assert is_unshifted(match) is expected


@pytest.mark.parametrize(
    ("lead", "inliers", "rival", "accepted"),
    [(0.1, 20, 10, True), (0.1, 20, 11, False), (0.1, 20, 0, True), (0.1, 0, 0, True)],
)
def test_judge_requires_landmarks_against_a_place_that_agrees_nearly_as_well(lead, inliers, rival, accepted):
    counted = {"landmarks": math.log1p(inliers), "rival": math.log1p(rival)}
    evidence = Evidence(agree=-2.0, lead=lead, coverage=-0.5, **counted)
    rule, agreement = make_rule(lambda evidence: 1.0), make_agreement(inliers)
    verdict = decide((0.15, 0.14), rule, agreement=agreement, evidence=evidence)
    assert verdict.accepted is accepted
    parameters = verdict.reason.parameters
    assert (parameters["landmarks"], parameters["rival_landmarks"]) == (inliers, rival)
    if not accepted:
        assert parameters["confidence"] == 0.5
        by_flight = decide((0.15, 0.14), make_rule(lambda evidence: 1.0), evidence=evidence, track_confidence=0.999)
        assert by_flight.accepted, "the flight knows which of the two it is"


@pytest.mark.parametrize(
    ("score", "proof", "accepted"),
    [
        (0.3, make_agreement(4), False),
        (0.3, make_agreement(0), False),
        (0.3, make_agreement(5), True),
        (0.3, make_agreement(0, possible=99), True),
        (0.3, make_agreement(0, possible=100), False),
        (0.19, make_agreement(0), True),
        (0.12, make_agreement(30, is_expected=False), False),
    ],
)
def test_judge_refuses_a_clear_vote_without_agreeing_landmarks(score, proof, accepted):
    assert decide((score, score - 0.1), agreement=proof).accepted == accepted


PLACES = 80
LENGTH = 6
SEQUENCE_RULE = AcceptRule(min_score=0.1, min_margin=0.05, neighbour_m=50.0)


def fly_sequence(velocity, start, leaves=18, seed=3):
    """(accepted, code, slot) of each query of a flight along places that look a little like the two around them; from
    query `leaves` on it shows nothing of the map."""
    index = make_bare_index(PLACES)
    index.place_ids[:] = np.arange(PLACES)
    noise = np.random.default_rng(seed)
    sequence, found = SequenceSearch(LENGTH), []
    for query in range(18):
        away = np.abs(np.arange(PLACES) - (start + velocity * query))
        here = np.exp(-away) if query < leaves else 0.0
        scores = (0.3 + 0.4 * here + 0.02 * noise.random(PLACES)).astype(np.float32)
        slots = np.argsort(-scores)
        ranking = Ranking(slots=slots, scores=scores[slots], compared={})
        ranking = sequence.add_query(ranking, index, float(query))
        verdict = judge(Findings(ranking), index, SEQUENCE_RULE, sequence)
        found.append((verdict.accepted, verdict.reason.code, int(ranking.slots[0])))
    return found


@pytest.mark.parametrize("velocity", [0.8, 1.2])
def test_sequence_of_the_mapping_flight_is_accepted_from_the_first_complete_one(velocity):
    found = fly_sequence(velocity, 5)
    assert [yes for yes, _, _ in found] == [False] * (LENGTH - 1) + [True] * (18 - LENGTH + 1)
    assert all(abs(slot - (5 + velocity * query)) <= 1 for query, (yes, _, slot) in enumerate(found) if yes)
    assert found[3][1] is ReasonCode.SEQUENCE_INCOMPLETE


@pytest.mark.parametrize(("velocity", "start"), [(2.0, 5), (3.0, 5), (0.0, 30), (0.3, 30), (-1.0, 60), (-2.0, 60)])
def test_sequence_at_another_speed_or_direction_is_never_accepted_wrongly(velocity, start):
    for query, (yes, _, slot) in enumerate(fly_sequence(velocity, start)):
        assert not yes or abs(slot - (start + velocity * query)) <= 2  # neighbours are no other place


@pytest.mark.parametrize("seed", range(8))
def test_sequence_ends_where_the_aircraft_leaves_the_mapped_route(seed):
    found = fly_sequence(1.0, 5, leaves=11, seed=seed)
    assert found[10][0]
    # The mean would bear it for some queries yet: it is far ahead of all other places.
    assert not any(yes for yes, _, _ in found[13:])
    assert any(code is ReasonCode.NEWEST_ELSEWHERE for _, code, _ in found[11:14])


def test_make_accept_rule_divides_the_margin_by_the_root_of_the_sequence_length():
    technique, config = create("hog"), load_config(None).match
    assert make_accept_rule(technique, config, 9).min_margin == pytest.approx(technique.min_margin / math.sqrt(9))
    assert make_accept_rule(technique, config).min_margin == technique.min_margin
    for length in (10, 40):
        rule = make_accept_rule(technique, config, length)
        assert rule.min_margin == pytest.approx(technique.min_margin / math.sqrt(10))
    technique.min_margin = 1.0  # what is never to be accepted is not in a sequence either
    assert make_accept_rule(technique, config, 9).min_margin == 1.0
    assert make_accept_rule(technique, load_config(None, {"match.min_margin": 0.2}).match, 9).min_margin == 0.2
