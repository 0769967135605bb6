"""Decides whether to accept a match. Only this module does, and a match that is not accepted has no position.

A place *elsewhere* is outside the neighbourhood of the best place (see `outside_neighbourhood`). The *lead* of
the best place is its score minus that of the best place elsewhere."""

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
from edgevpr.runtime.recognise.confidence import Model, read_default_model
from edgevpr.runtime.recognise.evidence import Evidence, LookAlikes, list_evidence_kinds
from edgevpr.runtime.recognise.locate import Located
from edgevpr.runtime.recognise.perspective import ObservedTilt

# There are many trajectories at other speeds, so one of them scores well by chance: half the margin over them suffices.
# With it, no wrong sequence of the corridor set was accepted with hog, seqslam or cohog, flown as mapped, twice as fast
# or in the opposite direction. At half the speed cohog accepted places three away from the correct one.
_MARGIN_FACTOR_AT_OTHER_SPEEDS = 0.5
_MAX_INDEPENDENT = 10

# Looking down, a match is *unshifted* if query and place agree without shift, rotation or scaling. If the best place
# and more than this fraction of a few places elsewhere are unshifted, an on-screen display is drawn over every frame.
_MAX_UNSHIFTED_FRACTION = 0.4
_MAX_UNSHIFTED_CELLS = 0.75
_MAX_UNSHIFTED_DEG = 7.5
_MAX_UNSHIFTED_HEIGHT = 0.2

# A correct match with at least this score has agreeing landmarks: all 413 of them, in all aerial sets, had six or more.
# Weaker matches, such as of grass in different light, may have none. Applied if both pictures have enough landmarks.
_MIN_CLEAR_SCORE = 0.2
_MIN_INLIERS = 5
_MIN_LANDMARKS = 100
# Agreeing landmarks make up for a score below the technique's limit, down to this fraction of it.
_MIN_SCORE_RATIO_WITH_LANDMARKS = 0.5
# The least lead over the same place with the picture at another rotation. On sat_marash, with unknown heading, 273 of
# 276 correct matches have more, and two of three wrong ones have less: a bridge mistaken for its other end.
_MIN_LEAD_OVER_OTHER_ROTATION = math.log(1.75)
_MAX_TWIN_CONFIDENCE = 0.5  # highest confidence if a place elsewhere agrees equally well
# Highest confidence, looking ahead, if required landmarks do not agree: of 111 queries of corridor in a map without
# that part of it, 12 were accepted from regions alone.
_MAX_UNPROVEN_CONFIDENCE = 0.9
# Least probability for acceptance, at any precision: from the match alone, and from the flight so far.
_MIN_CONFIDENCE = 0.9
_MIN_TRACK_CONFIDENCE = 0.99
# If the flight so far raises the odds of a match by this factor, a confidence equal to the required precision suffices.
# A match alone often needs more, because the wrong match that looks best by chance must be refused; earlier queries are
# independent of it. In seven flights along corridor, the seasons and nordland_tiny, and over some 200 foreign pictures
# for each, this accepted no more wrong matches; of nordland_tiny's queries 0.59 instead of 0.47 are accepted.
_MIN_ODDS_RATIO = 10.0
_MAX_TILT_SHOWN_DEG = 60.0  # if not recorded; a smaller tilt adds to the reported error (kite_ochota sways by 20)
_MIN_TRACK_SUPPORT = 0.5  # least probability from the flight so far, for a confident match
# Least probability, before the query, of the place of a match that only the flight so far makes acceptable: ground
# outside the map that resembles a place once often does so again a few queries later.
_MIN_PREDICTED = 0.5


@dataclass(frozen=True, slots=True)
class ConfidenceRule:
    """Acceptance by confidence. `models` has a model for each kind of evidence. A match is accepted if its confidence
    is at least the model's threshold for `precision`, the required fraction of accepted matches that are correct."""

    models: Mapping[str, Model]
    precision: float

    def confidence(self, evidence: Evidence) -> float:
        """Return the probability that the match is correct: at most 0.5 if another place agrees about as well or the
        surroundings differ, and at most 0.9 if landmarks are required but do not agree."""
        confidence = self.models[evidence.kind].confidence(evidence.figures())
        if not evidence.is_unambiguous:
            return min(confidence, _MAX_TWIN_CONFIDENCE)
        return min(confidence, _MAX_UNPROVEN_CONFIDENCE) if evidence.needs_landmarks else confidence

    def cap_confidence(self, evidence: Evidence, confidence: float | None = None) -> float:
        """Return the confidence to report: that of the evidence, or `confidence` of the track of the flight, at most
        the highest that the model's training data support."""
        confidence = self.confidence(evidence) if confidence is None else confidence
        return min(confidence, self.models[evidence.kind].max_reported)

    def explain(self, evidence: Evidence) -> ReasonCode:
        """Return the code of a match with too low a confidence: what limits it, if its figures alone would suffice."""
        if not self.models[evidence.kind].confidence(evidence.figures()) >= self.threshold(evidence):  # or is NaN
            return ReasonCode.LOW_CONFIDENCE
        return ReasonCode.LANDMARKS_NEEDED if evidence.is_unambiguous else ReasonCode.LOOKS_ALIKE

    def compute_map_confidence(self, evidence: Evidence) -> float:
        """Return the probability that the query with this evidence shows ground of the map."""
        return self.models[evidence.kind].map_confidence(evidence.figures())

    def is_undecided(self, evidence: Evidence) -> bool:
        """Return True if landmarks can still decide: the match is unambiguous, its query is likely to show ground of
        the map, and its confidence is too low."""
        is_likely = evidence.is_unambiguous and self.compute_map_confidence(evidence) >= _MAX_TWIN_CONFIDENCE
        return is_likely and self.confidence(evidence) < self.threshold(evidence)

    def threshold(self, evidence: Evidence) -> float:
        """Return the confidence needed to accept a match with this kind of evidence."""
        return max(_MIN_CONFIDENCE, self.models[evidence.kind].threshold(self.precision))


@dataclass(frozen=True, slots=True, kw_only=True)
class AcceptRule:
    """Conditions under which `judge` accepts a match.

    * `min_score`: the least score
    * `min_margin`: the least margin over the best place elsewhere, which is more than `neighbour_m` metres away
    * `min_quality`: the least quality of the query's picture
    * `confidence_rule`: the confidence that is also required (None: score and lead alone decide)
    * `min_verify_score`: the least score to compare landmarks and, with a `confidence_rule`, to accept a match
    * `look_alikes`: places of the map that look alike (None: unknown)"""

    min_score: float
    min_margin: float
    neighbour_m: float
    min_quality: float = 0.0
    confidence_rule: ConfidenceRule | None = None
    min_verify_score: float = 0.0
    look_alikes: LookAlikes | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Findings:
    """What is known about the best place of a `ranking` when it is judged.

    `agreement`: that of the landmarks of query and place (None: not compared). `located`: the position computed from
    the best places (None: only that of the best place is known); these places do not count as elsewhere.
    `evidence`: that of the match (None: the rule needs none). `track_confidence`: probability of the place from the
    flight so far, `predicted` before this query (None: the query is judged alone). `lead_over_other_rotation`: the
    lead, as in the evidence, over the same place with the picture at another rotation (None: not compared).
    `unshifted_fraction`: the fraction of a few places elsewhere that are unshifted, if the best one is too (else 0).
    `tilt`: tilt of the query relative to the place (None: not measured)."""

    ranking: Ranking = field(kw_only=False)
    agreement: Agreement | None = None
    located: Located | None = None
    evidence: Evidence | None = None
    track_confidence: float | None = None
    predicted: float | None = None
    lead_over_other_rotation: float | None = None
    unshifted_fraction: float = 0.0
    tilt: ObservedTilt | None = None


@dataclass(frozen=True, slots=True)
class Verdict:
    """Decision on the best place: whether it is accepted, and the reason."""

    accepted: bool
    reason: Reason


def make_accept_rule(
    technique: Technique, config: MatchConfig, length: int = 1, calibration: MapCalibration | None = None
) -> AcceptRule:
    """Return the rule for a technique: by confidence if there is a model for its evidence, otherwise by its own limits.
    Limits in the configuration take precedence. `calibration` is that of the map (None: use the default models). A
    sequence of `length` queries is judged by limits; its margin is that of one query divided by the square root of its
    length (10 if longer, because queries of the same ground are not independent)."""
    kinds = list_evidence_kinds(technique.spec) if length == 1 else ()
    # With a confidence rule, no lead is needed: the flight so far may decide between two similar places.
    min_score, min_margin = (0.0, -math.inf) if kinds else (technique.min_score, technique.min_margin)
    if min_margin < 1:  # a margin of 1 or more accepts nothing, even in sequences
        min_margin /= math.sqrt(min(length, _MAX_INDEPENDENT))
    map_models = calibration.models if calibration else {}
    models = {kind: map_models.get(kind) or read_default_model(kind) for kind in kinds}
    return AcceptRule(
        min_score=min_score if config.min_score is None else config.min_score,
        min_margin=min_margin if config.min_margin is None else config.min_margin,
        neighbour_m=config.neighbour_m,
        min_quality=technique.min_quality,
        confidence_rule=ConfidenceRule(models, config.accept_precision) if kinds else None,
        min_verify_score=_MIN_SCORE_RATIO_WITH_LANDMARKS * technique.min_score,
        look_alikes=calibration.look_alikes if calibration and kinds else None,
    )


def check_texture(query: Descriptor, min_quality: float) -> Reason | None:
    """Return the reason to refuse a picture with too little texture, as of a covered lens or an empty sky; None if its
    quality is at least `min_quality`. A few textured regions can agree on a place by chance."""
    if query.quality >= min_quality:  # False for NaN
        return None
    return Reason(ReasonCode.LOW_TEXTURE, {"usable_share": query.quality, "min_share": min_quality})


def judge(findings: Findings, index: PlaceIndex, rule: AcceptRule, search: SequenceSearch | None = None) -> Verdict:
    """Decide whether to accept the best place of a ranking. `search` is the search over sequences that made the
    ranking (None: the query was ranked alone)."""
    if search and search.frames < search.length:
        return _refuse(ReasonCode.SEQUENCE_INCOMPLETE, queries=search.frames, min_queries=search.length)
    ranking, agreement, located = findings.ranking, findings.agreement, findings.located
    score = float(ranking.scores[0])
    lead = margin(ranking, index, rule.neighbour_m, located.places if located else ())
    if objection := _check_limits(score, lead, rule):
        return Verdict(False, objection)
    if search and (objection := _check_sequence(ranking, index, rule, search)):
        return Verdict(False, objection)
    if len(ranking.unread):
        return _refuse(ReasonCode.PLACE_UNREAD)
    if rule.confidence_rule:
        verdict = _judge_confidence(rule.confidence_rule, findings)
    elif lead is None:
        verdict = Verdict(True, Reason(ReasonCode.ACCEPTED_WITHOUT_RIVAL, {"score": score}))
    else:
        verdict = Verdict(True, Reason(ReasonCode.ACCEPTED_BY_SCORE, {"score": score, "margin": lead}))
    if not verdict.accepted:
        return verdict
    if findings.unshifted_fraction > _MAX_UNSHIFTED_FRACTION:
        return _refuse(ReasonCode.ELSEWHERE_AT_REST)
    if agreement is not None and (objection := _check_landmarks(agreement, score)):
        return Verdict(False, objection)
    if located and located.objection:
        return Verdict(False, located.objection)
    if findings.tilt and findings.tilt.least_deg > _MAX_TILT_SHOWN_DEG:
        return _refuse(ReasonCode.TILT_SHOWN, tilt_deg=findings.tilt.deg)
    return verdict


def _refuse(code: ReasonCode, **parameters: float) -> Verdict:
    return Verdict(False, Reason(code, parameters))


def _check_limits(score: float, lead: float | None, rule: AcceptRule) -> Reason | None:
    """Return the reason if a match is below the least score or lead (None: no place elsewhere) of `rule`, else None."""
    min_score = max(rule.min_score, rule.min_verify_score if rule.confidence_rule else 0.0)
    if not score >= min_score:  # `not >=` refuses NaN as well
        return Reason(ReasonCode.LOW_SCORE, {"score": score, "min_score": min_score})
    if lead is None and rule.min_score == 0 and rule.confidence_rule is None:
        return Reason(ReasonCode.NO_RIVAL)
    if lead is not None and not lead >= rule.min_margin:
        return Reason(ReasonCode.LOW_MARGIN, {"margin": lead, "min_margin": rule.min_margin})
    return None


def _judge_confidence(rule: ConfidenceRule, findings: Findings) -> Verdict:
    """Decide by the confidence of the match or, if known, by the probability of the place from the flight so far."""
    evidence, track, rotation_lead = findings.evidence, findings.track_confidence, findings.lead_over_other_rotation
    if evidence is None:
        return _refuse(ReasonCode.NOT_CALIBRATED)
    confidence, needed, reported = rule.confidence(evidence), rule.threshold(evidence), rule.cap_confidence(evidence)
    figures = {
        "track_confidence": None if track is None else rule.cap_confidence(evidence, track),
        "confidence": reported,
        "min_confidence": needed,
        **evidence.describe(),
    }
    is_confident = confidence >= needed
    code = ReasonCode.ACCEPTED_BY_CONFIDENCE
    raises_odds = track is not None and track * (1 - confidence) >= _MIN_ODDS_RATIO * confidence * (1 - track)
    min_track = max(_MIN_TRACK_CONFIDENCE, min(needed, rule.precision) if raises_odds else needed)
    is_tracked = track is not None and track >= min_track
    if not (is_confident or (is_tracked and (findings.predicted or 0.0) >= _MIN_PREDICTED)):
        code = rule.explain(evidence)
    elif evidence.lead < 0 and not is_confident:
        code = ReasonCode.ELSEWHERE_AGREES_BETTER
    elif track is not None and track < _MIN_TRACK_SUPPORT:
        code = ReasonCode.TRACK_CONTRADICTS
    elif rotation_lead is not None and rotation_lead < _MIN_LEAD_OVER_OTHER_ROTATION:
        code = ReasonCode.ROTATION_AMBIGUOUS
    return Verdict(code is ReasonCode.ACCEPTED_BY_CONFIDENCE, Reason(code, figures))


def _check_landmarks(agreement: Agreement, score: float) -> Reason | None:
    """Return the reason if the landmarks contradict the best place, or too few agree for its score; else None."""
    if not agreement.is_expected:
        return Reason(ReasonCode.LANDMARKS_DISAGREE, {"landmarks": agreement.inliers})
    if score >= _MIN_CLEAR_SCORE and agreement.inliers < _MIN_INLIERS and agreement.possible >= _MIN_LANDMARKS:
        return Reason(ReasonCode.FEW_LANDMARKS, {"landmarks": agreement.inliers, "min_landmarks": _MIN_INLIERS})
    return None


def is_unshifted(match: FineMatch) -> bool:
    """Return True if a match has almost no shift, rotation or height difference."""
    if match.rotation_deg is None or match.shift_cells is None:
        return False
    rotation_deg = abs(wrap_deg(match.rotation_deg))
    if rotation_deg > _MAX_UNSHIFTED_DEG or abs((match.height_ratio or 1.0) - 1) > _MAX_UNSHIFTED_HEIGHT:
        return False
    return max(map(abs, match.shift_cells)) <= _MAX_UNSHIFTED_CELLS


def _check_sequence(ranking: Ranking, index: PlaceIndex, rule: AcceptRule, search: SequenceSearch) -> Reason | None:
    """Return the reason if the mean score of a sequence cannot be trusted, else None: the newest query shows other
    places, the newest queries no longer fit, or a place elsewhere fits about as well at another speed of the flight."""
    if ranking.compared and int(ranking.slots[0]) not in ranking.compared:
        return Reason(ReasonCode.NEWEST_DISAGREES)
    is_elsewhere = outside_neighbourhood(index, int(ranking.slots[0]), np.arange(len(index)), rule.neighbour_m)
    if not search.is_continued(~is_elsewhere, rule.min_score):
        return Reason(ReasonCode.NEWEST_ELSEWHERE)
    lead = float(ranking.scores[0]) - float(search.rivals[is_elsewhere].max(initial=0))
    needed = _MARGIN_FACTOR_AT_OTHER_SPEEDS * rule.min_margin
    if not lead >= needed:
        return Reason(ReasonCode.LOW_MARGIN_AT_OTHER_SPEED, {"margin": lead, "min_margin": needed})
    return None
