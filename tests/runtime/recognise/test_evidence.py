"""Evidence: what a match offers, by name, and which models can be used with it."""

import math
from dataclasses import replace

import numpy as np
import pytest
from fixed_confidence import make_agreement, make_bare_index

from edgevpr.core.contract import FineMatch, Support
from edgevpr.core.reasons import ReasonCode
from edgevpr.places.ranking import Ranking
from edgevpr.runtime.recognise.calibration import require_usable
from edgevpr.runtime.recognise.confidence import read_default_model
from edgevpr.runtime.recognise.evidence import (
    AHEAD,
    AHEAD_PROVEN,
    DOWN,
    DOWN_BARE,
    MAP_FIGURES,
    PLACE_FIGURES,
    LookAlike,
    LookAlikes,
    gather_evidence,
    list_evidence_kinds,
    log_count,
    log_inlier_ratio,
)
from edgevpr.techniques import create

INDEX = make_bare_index(30)
NEIGHBOUR_M = 50.0


def rank(matches):
    """A ranking of matches by their slots, best first."""
    slots = sorted(matches, key=lambda slot: -matches[slot].score)
    scores = np.array([matches[slot].score for slot in slots], np.float32)
    return Ranking(slots=np.array(slots, int), scores=scores, compared=matches)


def forward(score, back=0.2, likeness=0.7, log_rank=0.0, surroundings=1.0):
    support = Support(back=back, likeness=likeness, log_rank=log_rank, surroundings=surroundings)
    return FineMatch(score, coverage=0.3, support=support)


def see_forward(matches, look_alikes=None):
    index = replace(INDEX, place_ids=np.arange(len(INDEX)))
    return gather_evidence(rank(matches), index, NEIGHBOUR_M, None, (), looks_down=False, look_alikes=look_alikes)


def see_down(matches, proof=None, same=(), tried=1.0):
    return gather_evidence(replace(rank(matches), tried=tried), INDEX, NEIGHBOUR_M, proof, same, looks_down=True)


def test_evidence_has_the_features_of_the_models():
    down = {5: FineMatch(0.2, coverage=0.3)}
    for kind, evidence in (
        (AHEAD, see_forward({5: forward(0.2)})),
        (AHEAD_PROVEN, replace(see_forward({5: forward(0.2)}), proof=0.1)),
        (DOWN, see_down(down, make_agreement(12))),
        (DOWN_BARE, see_down(down)),
    ):
        assert evidence.kind == kind
        assert set(evidence.figures()) >= {*MAP_FIGURES[kind], *PLACE_FIGURES[kind]}
        assert evidence.describe().keys() <= ReasonCode.LOW_CONFIDENCE.parameters


def test_gather_evidence_treats_the_next_single_view_as_a_rival():
    matches = {5: forward(0.2), 6: forward(0.19), 20: forward(0.02)}
    along_a_way, single = (see_forward(matches, LookAlikes(overlap, {})) for overlap in (True, False))
    assert along_a_way.lead == see_forward(matches).lead > single.lead > 0
    assert single.twin is None


@pytest.mark.parametrize("overlap", [True, False])
def test_gather_evidence_compares_with_the_most_similar_place(overlap):
    known = LookAlikes(overlap, {5: LookAlike(20, math.log(0.1), math.log(0.08)), 20: LookAlike(5, -3.0, -2.5)})
    of_twin, of_another = (see_forward({5: forward(a), 20: forward(b)}, known) for a, b in ((0.2, 0.1), (0.1, 0.2)))
    assert of_twin.twin == pytest.approx(math.log(0.1 / 0.08))
    assert of_twin.has_twin
    assert not replace(of_twin, lead=math.log(4.01)).has_twin, "it is clearly beaten"
    assert not of_another.has_twin
    assert of_twin.apart == (None if overlap else pytest.approx(math.log(0.2 / 0.1)))
    assert known.twins == 1


CLEAR_LEAD = replace(see_forward({5: forward(0.2)}), lead=math.log(1.51), rank_gap=0.0, twin=-0.1)
SMALL_LEAD = replace(CLEAR_LEAD, lead=math.log(1.49))


@pytest.mark.parametrize(
    ("evidence", "needed"),
    [
        (CLEAR_LEAD, False),
        (replace(CLEAR_LEAD, twin=None), True),
        (replace(CLEAR_LEAD, twin=None, proof=log_inlier_ratio(15, 3)), True),
        (replace(CLEAR_LEAD, twin=None, proof=log_inlier_ratio(16, 3)), False),
        (replace(CLEAR_LEAD, twin=None, lead=math.log(3.99)), True),
        (replace(CLEAR_LEAD, twin=None, lead=math.log(4.01)), False),
        (SMALL_LEAD, True),
        (replace(SMALL_LEAD, landmarks=log_count(8)), True),
        (replace(SMALL_LEAD, landmarks=log_count(9)), False),
        (replace(SMALL_LEAD, landmarks=log_count(15), rank_gap=0.11, proof=log_inlier_ratio(15, 3)), True),
        (replace(SMALL_LEAD, landmarks=log_count(16), rank_gap=0.11, proof=log_inlier_ratio(16, 3)), False),
        (replace(CLEAR_LEAD, rank_gap=0.11), False),
        (replace(SMALL_LEAD, apart=math.log(1.51)), False),
        (replace(CLEAR_LEAD, apart=math.log(1.49)), True),
        (replace(CLEAR_LEAD, apart=math.log(1.49), proof=log_inlier_ratio(9, 3)), False),
        (replace(SMALL_LEAD, likeness=None), False),
    ],
)
def test_needs_landmarks_if_forward_regions_are_not_sufficient(evidence, needed):
    assert evidence.needs_landmarks == needed


def test_evidence_is_ambiguous_if_only_the_middle_agrees():
    same, other = (see_forward({5: forward(0.2, surroundings=ratio)}) for ratio in (0.46, 0.44))
    assert (same.is_unambiguous, other.is_unambiguous) == (True, False)
    ratios = [evidence.describe()["surroundings_ratio"] for evidence in (same, other)]
    assert ratios == [None, pytest.approx(0.44)]


def test_list_evidence_kinds_depends_on_the_camera():
    assert list_evidence_kinds(create("cohog", {"w1": 208}).spec) == (AHEAD, AHEAD_PROVEN)
    assert list_evidence_kinds(create("cohog", {"camera": "nadir"}).spec) == (DOWN, DOWN_BARE)
    assert (
        list_evidence_kinds(create("hog").spec)
        == list_evidence_kinds(create("cohog", {"matching": "thesis"}).spec)
        == ()
    )


def test_gather_evidence_measures_the_lead_over_places_elsewhere_not_neighbours():
    far, near = (see_forward({5: forward(0.2), other: forward(0.15)}) for other in (20, 6))
    assert far.lead == pytest.approx(math.log(math.sqrt(0.2 / 0.15)))
    assert near.lead > far.lead, "only chance is elsewhere"
    down = see_down({5: FineMatch(0.2, coverage=0.3), 20: FineMatch(0.1, coverage=0.3)})
    assert down.lead == pytest.approx(math.log(2))


@pytest.mark.parametrize(("inliers", "rival", "times"), [(32, 0, 4), (32, 16, 2), (32, 40, 1), (7, 3, 1), (0, 250, 1)])
def test_forward_landmarks_are_evidence_only_beyond_rivals_and_chance(inliers, rival, times):
    proof = log_inlier_ratio(inliers, rival)
    assert proof == pytest.approx(math.log(times))
    described = replace(see_forward({5: forward(0.2)}), proof=proof).describe()
    assert described["landmarks_ratio"] == (pytest.approx(times) if proof else None)
    assert (described["coverage_share"] is None) == bool(proof)


@pytest.mark.parametrize(
    ("proof", "counts"),
    [
        (make_agreement(12), 12),
        (make_agreement(12, is_expected=False), 0),
        (make_agreement(12, shift_share=(0.0, 0.001)), 0),
        (make_agreement(0), 0),
    ],
)
def test_landmarks_count_only_if_expected_and_shifted(proof, counts):
    assert see_down({5: FineMatch(0.2, coverage=0.3)}, proof).landmarks == pytest.approx(math.log1p(counts))


def test_gather_evidence_treats_a_place_of_the_same_ground_as_the_same_place():
    matches = {5: FineMatch(0.2, coverage=0.3), 20: FineMatch(0.19, coverage=0.3), 28: FineMatch(0.05, coverage=0.3)}
    index = type(INDEX)(**(dict(INDEX.arrays) | {"place_ids": np.arange(101, 131)}), mean=INDEX.mean)
    apart = gather_evidence(rank(matches), index, NEIGHBOUR_M, None, (), looks_down=True)
    together = gather_evidence(rank(matches), index, NEIGHBOUR_M, None, (121,), looks_down=True)
    assert (apart.lead, together.lead) == (pytest.approx(math.log(0.2 / 0.19)), pytest.approx(math.log(4)))


@pytest.mark.parametrize("score", [0.0, 1e-9, 1.0])
def test_gather_evidence_is_finite_for_any_fraction(score):
    matches = {5: forward(score, back=0.0), 20: forward(0.0, back=0.0)}
    assert all(map(math.isfinite, see_forward(matches).figures().values()))
    assert all(map(math.isfinite, see_down({5: FineMatch(score), 20: FineMatch(0.0)}).figures().values()))


def test_gather_evidence_is_none_if_nothing_was_compared():
    empty = Ranking(slots=np.array([3]), scores=np.array([0.2], np.float32), compared={})
    for down in (True, False):
        assert gather_evidence(empty, INDEX, NEIGHBOUR_M, None, (), looks_down=down) is None
    assert see_forward({5: FineMatch(0.2)}) is None, "a technique that gives no support"


def test_require_usable_refuses_a_model_of_other_evidence():
    model = read_default_model(DOWN_BARE)
    require_usable(DOWN, model)
    with pytest.raises(ValueError, match="landmarks"):
        require_usable(DOWN_BARE, read_default_model(DOWN))
    with pytest.raises(ValueError, match="sideways"):
        require_usable("sideways", model)
    named = replace(model.of_place, names=("colour", *model.of_place.names[1:]))
    with pytest.raises(ValueError, match="colour"):
        require_usable(DOWN, replace(model, of_place=named))


def test_chance_is_lower_with_a_known_heading():
    matches = {5: FineMatch(0.2, coverage=0.05, structure=1.5), 20: FineMatch(0.15, coverage=0.04)}
    all_of_them, known = (see_down(matches, make_agreement(3), tried=tried).figures() for tried in (1.0, 1 / 8))
    model = read_default_model(DOWN)
    assert 0 < model.chance(known) == pytest.approx(model.chance(all_of_them) / 4)
    assert model.confidence(known) > model.confidence(all_of_them)
