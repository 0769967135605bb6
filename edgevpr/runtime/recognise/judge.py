"""Decides when a match is accepted as the place. No other code does, and a match that is not accepted has no position.

A place *elsewhere* is outside the neighbourhood of the best place (see `outside_neighbourhood`). The *lead* of
the best place is how far its score is above that of the best place elsewhere.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from edgevpr.core.config import MatchConfig
from edgevpr.core.contract import Descriptor, FineMatch, Technique
from edgevpr.core.geodesy import wrap_deg
from edgevpr.core.reasons import Reason, ReasonCode
from edgevpr.places.index import PlaceIndex
from edgevpr.places.ranking import Ranking, margin, outside_neighbourhood
from edgevpr.places.sequence import SequenceSearch
from edgevpr.runtime.recognise.agreement import Agreement
from edgevpr.runtime.recognise.calibration import MapCalibration
from edgevpr.runtime.recognise.confidence import Model, prior
from edgevpr.runtime.recognise.evidence import Evidence, LookAlikes, list_evidence_kinds
from edgevpr.runtime.recognise.locate import Located
from edgevpr.runtime.recognise.perspective import ShownTilt

# Trajectories at other speeds are many, so one of them scores well by chance: half the margin over them is enough. With
# it, no wrong sequence of the corridor set was accepted from hog, seqslam or cohog, flown as it was mapped, twice as
# fast, or the other way. At half the speed cohog accepted places three away from the right one.
_MARGIN_SHARE_AT_OTHER_SPEEDS = 0.5
_MAX_INDEPENDENT = 10

# Looking down, if more than this share of a few places elsewhere agree without any shift or rotation, as the best one
# does, all share what is drawn over every frame.
_MAX_AT_REST_SHARE = 0.4
_MAX_REST_CELLS = 0.75
_MAX_REST_DEG = 7.5
_MAX_REST_HEIGHT = 0.2

# A right match with such a score has landmarks that agree: all 413 of them, in all sets from the air, had six or more.
# Weaker ones, of grass under other light, may have none. Applied if both pictures have enough landmarks.
_MIN_CLEAR_SCORE = 0.2
_MIN_INLIERS = 5
_MIN_LANDMARKS = 100
# Agreeing landmarks make up for a score below the technique's limit, down to this share of it.
_MIN_SCORE_SHARE_WITH_LANDMARKS = 0.5
# The least lead over the same place with the picture turned otherwise. Over sat_marash's ground, heading unknown, 273
# of 276 right matches have more, and two of three wrong ones less: a bridge taken for its other end.
_MIN_LEAD_OVER_TURNED = math.log(1.75)
# Probabilities: the highest where a place elsewhere agrees as well, and ahead, without the landmarks that are needed
# (of 111 queries of corridor, asked in a map without their part of it, regions alone had 12 accepted); the least for
# accepting, at any precision, by the match alone, and by the flight so far.
_MAX_TWIN_CONFIDENCE = 0.5
_MAX_UNPROVEN_CONFIDENCE = 0.9
_MIN_CONFIDENCE = 0.9
_MIN_TRACK_CONFIDENCE = 0.99
# How many times the flight must raise the odds of a match for the precision to be enough. By itself a match often needs
# more, since of many matches the luckiest wrong one must be refused; the queries before do not share its luck. In seven
# manners of flying along corridor, the seasons and nordland_tiny, and over some 200 foreign pictures each, nothing
# more was wrong; of nordland_tiny's queries 0.59 instead of 0.47 are accepted.
_MIN_ODDS_RAISED = 10.0
_MAX_TILT_SHOWN_DEG = 60.0  # of a tilt that is not recorded; below, the claim counts it (kite_ochota sways by 20)
_MIN_TRACK_SUPPORT = 0.5  # least probability by the flight so far, for a match that is sure by itself


@dataclass(frozen=True, slots=True)
class ConfidenceRule:
    """Acceptance by confidence. `models` gives a model for each kind of evidence. A match is accepted if its confidence
    is at least the model's threshold for `precision`, the share of accepted matches that must be right."""

    models: Mapping[str, Model]
    precision: float

    def confidence(self, evidence: Evidence) -> float:
        """Return the probability that the match is right: at most 0.5 if another place agrees about as well, and 0.9
        if landmarks are needed and do not agree."""
        confidence = self.models[evidence.kind].confidence(evidence.figures())
        if not evidence.leads:
            return min(confidence, _MAX_TWIN_CONFIDENCE)
        return min(confidence, _MAX_UNPROVEN_CONFIDENCE) if evidence.needs_landmarks else confidence

    def limit_confidence(self, evidence: Evidence) -> float:
        """Return the confidence as it is reported: no higher than the data support that its model was fitted to."""
        return min(self.confidence(evidence), self.models[evidence.kind].max_reported)

    def compute_map_confidence(self, evidence: Evidence) -> float:
        """Return the probability that the query of this evidence shows ground of the map."""
        return self.models[evidence.kind].map_confidence(evidence.figures())

    def is_open(self, evidence: Evidence) -> bool:
        """Return True if more evidence of the place can still decide: the match leads, its query is likely to show
        ground of the map, and it is not sure yet."""
        is_likely = evidence.leads and self.compute_map_confidence(evidence) >= _MAX_TWIN_CONFIDENCE
        return is_likely and self.confidence(evidence) < self.threshold(evidence)

    def threshold(self, evidence: Evidence) -> float:
        """Return the confidence needed to accept a match with this kind of evidence."""
        return max(_MIN_CONFIDENCE, self.models[evidence.kind].threshold(self.precision))


@dataclass(frozen=True, slots=True, kw_only=True)
class AcceptRule:
    """Conditions under which `judge` accepts a match.

    * `min_score`: the least score
    * `min_margin`: the least lead over the best place elsewhere, that is more than `neighbour_m` metres away
    * `min_quality`: the least quality of the query's picture
    * `sure`: the confidence needed besides (None: score and lead alone decide)
    * `worth_a_look`: the least score at which landmarks are compared and, with `sure`, a match can be accepted
    * `look_alikes`: places of the map that look alike (None: unknown)
    """

    min_score: float
    min_margin: float
    neighbour_m: float
    min_quality: float = 0.0
    sure: ConfidenceRule | None = None
    worth_a_look: float = 0.0
    look_alikes: LookAlikes | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Findings:
    """All that is known of the best place of a `ranking` when it is judged.

    `proof` is the agreement of the landmarks
    of query and place (None: not compared). `where` is the position computed from the best places (None: only that of
    the best place is known); the places it was computed from are not elsewhere. `evidence` is that of the match (None:
    the rule needs none), and `track_confidence` that of the place by the flight so far (None: the query is judged
    alone). `lead_over_turned` is the lead, as in the evidence, over the same place with the picture turned otherwise
    (None: not compared). `at_rest_elsewhere` is the share of a few places elsewhere that agree at rest, where the best
    one does too (else 0). `tilt` is that of the query against the place (None: not measured).
    """

    ranking: Ranking = field(kw_only=False)
    proof: Agreement | None = None
    where: Located | None = None
    evidence: Evidence | None = None
    track_confidence: float | None = None
    lead_over_turned: float | None = None
    at_rest_elsewhere: float = 0.0
    tilt: ShownTilt | None = None


@dataclass(frozen=True, slots=True)
class Verdict:
    """Decision on the best place: whether it is accepted, and why or why not."""

    accepted: bool
    reason: Reason


def accept_rule(
    technique: Technique, config: MatchConfig, length: int = 1, calibration: MapCalibration | None = None
) -> AcceptRule:
    """Return the rule for a technique: by confidence if a model of its evidence exists, else by its own limits. Limits
    in the configuration come first. `calibration` is that of the map (None: the shipped models are used). A sequence of
    `length` queries is judged by limits; its margin is that of one query, over the root of its length (10 at most:
    queries that show the same ground are not independent)."""
    kinds = list_evidence_kinds(technique.spec) if length == 1 else ()
    # The flight may know better than one match which of two places it is: no lead is needed for its sake.
    own_score, own_margin = (0.0, -math.inf) if kinds else (technique.min_score, technique.min_margin)
    if own_margin < 1:  # a margin of 1 or more accepts nothing, not in sequences either
        own_margin /= math.sqrt(min(length, _MAX_INDEPENDENT))
    own = calibration.models if calibration else {}
    models = {kind: own.get(kind) or prior(kind) for kind in kinds}
    return AcceptRule(
        min_score=own_score if config.min_score is None else config.min_score,
        min_margin=own_margin if config.min_margin is None else config.min_margin,
        neighbour_m=config.neighbour_m,
        min_quality=technique.min_quality,
        sure=ConfidenceRule(models, config.accept_precision) if kinds else None,
        worth_a_look=_MIN_SCORE_SHARE_WITH_LANDMARKS * technique.min_score,
        look_alikes=calibration.look_alikes if calibration and kinds else None,
    )


def check_texture(query: Descriptor, min_quality: float) -> Reason | None:
    """Return the reason if a picture shows too little to be recognised, as a covered lens or bare sky does, None if its
    quality is at least `min_quality`. The few regions that hold information can agree on a place by chance."""
    if query.quality >= min_quality:  # False for NaN
        return None
    return Reason(ReasonCode.LOW_TEXTURE, {"usable": query.quality, "needed": min_quality})


def judge(findings: Findings, index: PlaceIndex, rule: AcceptRule, search: SequenceSearch | None = None) -> Verdict:
    """Decide whether the best place of a ranking is accepted. `search` is the search over sequences that made the
    ranking (None: the query was ranked alone)."""
    if search and search.frames < search.length:
        return _refuse(ReasonCode.SEQUENCE_INCOMPLETE, queries=search.frames, needed=search.length)
    ranking, proof, where = findings.ranking, findings.proof, findings.where
    score = float(ranking.scores[0])
    ahead = margin(ranking, index, rule.neighbour_m, where.places if where else ())
    if objection := _check_limits(score, ahead, rule):
        return Verdict(False, objection)
    if search and (objection := _check_sequence(ranking, index, rule, search)):
        return Verdict(False, objection)
    if len(ranking.unread):
        return _refuse(ReasonCode.PLACE_UNREAD)
    if rule.sure:
        verdict = _judge_confidence(rule.sure, findings)
    elif ahead is None:
        verdict = Verdict(True, Reason(ReasonCode.ACCEPTED_WITHOUT_RIVAL, {"score": score}))
    else:
        verdict = Verdict(True, Reason(ReasonCode.ACCEPTED_BY_SCORE, {"score": score, "lead": ahead}))
    if not verdict.accepted:
        return verdict
    if findings.at_rest_elsewhere > _MAX_AT_REST_SHARE:
        return _refuse(ReasonCode.ELSEWHERE_AT_REST)
    if proof is not None and (objection := _check_landmarks(proof, score)):
        return Verdict(False, objection)
    if where and where.objection:
        return Verdict(False, where.objection)
    if findings.tilt and findings.tilt.least_deg > _MAX_TILT_SHOWN_DEG:
        return _refuse(ReasonCode.TILT_SHOWN, tilt_deg=findings.tilt.deg)
    return verdict


def _refuse(code: ReasonCode, **parameters: float) -> Verdict:
    return Verdict(False, Reason(code, parameters))


def _check_limits(score: float, ahead: float | None, rule: AcceptRule) -> Reason | None:
    """Return the reason if a match fails the least score or the least lead of `rule`, else None. `ahead` is its lead
    (None: there is no place elsewhere)."""
    least = max(rule.min_score, rule.worth_a_look if rule.sure else 0.0)
    if not score >= least:  # `not >=` refuses NaN as well
        return Reason(ReasonCode.LOW_SCORE, {"score": score, "needed": least})
    if ahead is None and rule.min_score == 0 and rule.sure is None:
        return Reason(ReasonCode.NO_RIVAL)
    if ahead is not None and not ahead >= rule.min_margin:
        return Reason(ReasonCode.LOW_LEAD, {"lead": ahead, "needed": rule.min_margin})
    return None


def _judge_confidence(sure: ConfidenceRule, findings: Findings) -> Verdict:
    """Decide by the confidence of the match or, if it is known, by the place's probability by the flight so far."""
    evidence, followed = findings.evidence, findings.track_confidence
    if evidence is None:
        return _refuse(ReasonCode.NOT_CALIBRATED)
    confidence, needed = sure.confidence(evidence), sure.threshold(evidence)
    shown = sure.limit_confidence(evidence)
    figures = {"track": followed, "confidence": shown, "needed": needed, **evidence.describe()}
    by_itself = confidence >= needed
    code = ReasonCode.ACCEPTED_BY_CONFIDENCE
    if not (by_itself or (followed is not None and _is_track_confident(followed, confidence, needed, sure.precision))):
        code = ReasonCode.LOW_CONFIDENCE
    elif evidence.lead < 0 and not by_itself:
        code = ReasonCode.ELSEWHERE_AGREES_BETTER
    elif followed is not None and followed < _MIN_TRACK_SUPPORT:
        code = ReasonCode.TRACK_CONTRADICTS
    elif findings.lead_over_turned is not None and findings.lead_over_turned < _MIN_LEAD_OVER_TURNED:
        code = ReasonCode.TURNED_AGREES
    return Verdict(code is ReasonCode.ACCEPTED_BY_CONFIDENCE, Reason(code, figures))


def _is_track_confident(followed: float, confidence: float, needed: float, precision: float) -> bool:
    """Return True if a place's probability by the flight so far, `followed`, is enough. By itself its match has this
    `confidence` of the one `needed`."""
    is_raised = followed * (1 - confidence) >= _MIN_ODDS_RAISED * confidence * (1 - followed)
    return followed >= max(_MIN_TRACK_CONFIDENCE, min(needed, precision) if is_raised else needed)


def _check_landmarks(proof: Agreement, score: float) -> Reason | None:
    """Return the reason if the landmarks show that the query is not at the best place, None if they do not."""
    if not proof.is_expected:
        return Reason(ReasonCode.LANDMARKS_DISAGREE, {"landmarks": proof.inliers})
    if score >= _MIN_CLEAR_SCORE and proof.inliers < _MIN_INLIERS and proof.possible >= _MIN_LANDMARKS:
        return Reason(ReasonCode.FEW_LANDMARKS, {"landmarks": proof.inliers, "needed": _MIN_INLIERS})
    return None


def is_at_rest(match: FineMatch) -> bool:
    """Return True if a match has about no shift, rotation or change of height."""
    if match.rotation_deg is None or match.shift_cells is None:
        return False
    off_deg = abs(wrap_deg(match.rotation_deg))
    if off_deg > _MAX_REST_DEG or abs((match.height_ratio or 1.0) - 1) > _MAX_REST_HEIGHT:
        return False
    return max(map(abs, match.shift_cells)) <= _MAX_REST_CELLS


def _check_sequence(ranking: Ranking, index: PlaceIndex, rule: AcceptRule, search: SequenceSearch) -> Reason | None:
    """Return the reason if the mean score of a sequence is not to be trusted, else None: the newest query shows other
    places, the newest queries no longer fit, or a place elsewhere fits about as well if it is passed at another speed.
    """
    if ranking.compared and int(ranking.slots[0]) not in ranking.compared:
        return Reason(ReasonCode.NEWEST_DISAGREES)
    away = outside_neighbourhood(index, int(ranking.slots[0]), np.arange(len(index)), rule.neighbour_m)
    if not search.is_continued(~away, rule.min_score):
        return Reason(ReasonCode.NEWEST_LEFT)
    ahead_of_rivals = float(ranking.scores[0]) - float(search.rivals[away].max(initial=0))
    needed = _MARGIN_SHARE_AT_OTHER_SPEEDS * rule.min_margin
    if not ahead_of_rivals >= needed:
        return Reason(ReasonCode.LOW_LEAD_SPEED, {"lead": ahead_of_rivals, "needed": needed})
    return None
