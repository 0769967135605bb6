"""The innovation gate: checks each fix against its prediction from the path, for `navigator`."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from edgevpr.core.arrays import Doubles
from edgevpr.core.geodesy import offset_between_m
from edgevpr.core.reasons import Reason, ReasonCode
from edgevpr.runtime.flight.measurements import PositionedMatch
from edgevpr.runtime.recognise.locate import compute_worst_sd, mahalanobis

# In standard deviations: one correct fix in 3000 is farther than this from its prediction.
_MAX_INNOVATION_SIGMA = 4.0
# A second correct fix is within this of the first in seven of eight cases; otherwise the next one is.
_MAX_DISAGREEMENT_SIGMA = 2.0
_HELD_FIX_TIMEOUT_S = 30.0  # a fix held for longer is dropped: the path may have drifted too far
_CONFIRMATION_TIMEOUT_S = 2.5
_DRIFT_M_S = 2.5  # path drift allowed between two fixes that agree
_TRACKED_DRIFT_M_S = 0.5  # the same, where visual odometry has tracked the path
_FIXES_TO_OVERRULE_TRACK = 4
_MAX_SUPPORT = 20  # fixes that support a path; GPS counts as many
_SUPPORT_TIMEOUT_S = 10.0  # a path without a fix for longer before fixes contradict it has drifted, and is not kept
_MAX_ROUTE_INTERVAL_S = 10.0
_MAX_SPEED_M_S = 30.0
_MAX_UNPREDICTED_INTERVAL_S = 120.0  # between two matches that nothing predicts


@dataclass(frozen=True, slots=True, kw_only=True)
class PredictedFix:
    """The fix of a `match` and its prediction from the path, in metres east and north. `path_point_m` (2,): the point
    of the path when the frame was taken; `offset_m` (2,): the offset of the fix from that point; `predicted_m` (2,):
    the predicted offset; `covariance_m2` (2, 2): covariance of the prediction, without that of the fix."""

    match: PositionedMatch
    path_point_m: Doubles
    offset_m: Doubles
    predicted_m: Doubles
    covariance_m2: Doubles

    @property
    def innovation_m(self) -> Doubles:
        """Offset of the fix from its prediction (2,)."""
        return self.offset_m - self.predicted_m


class GateResult(NamedTuple):
    """Verdict on a fix: the `reason` not to accept it (None: accepted). `overrules_path`: it contradicts its
    prediction, but other fixes agree with it; `restarts_path`: the velocity of the path is wrong too."""

    reason: Reason | None = None
    overrules_path: bool = False
    restarts_path: bool = False


ACCEPTED = GateResult()


class Consistency:
    """Holds a fix that contradicts its prediction until a second, independent fix agrees with it. While GPS is trusted,
    contradicting fixes are rejected.

    The path drifts slowly, so only another fix can show whether a distant fix or the path is wrong. Two correct fixes
    have the same offset from the path; two wrong ones hardly ever do. If the path error exceeds drift, correct fixes
    disagree too: then four fixes at different places are accepted, if an aircraft could have flown from each to the
    next. Four are also needed where visual odometry tracks the path: repetitive ground can repeat a wrong fix. Even
    four may be wrong: until as many fixes support the new path as supported the overruled one (at most 20, also for
    GPS), it is in doubt, and a single fix where the other one leads returns to that. A path that nothing had supported
    for ten seconds is overruled without a doubt: off the map, odometry drifts."""

    def __init__(self) -> None:
        self._support = 0  # fixes since the path began or overruled another one
        self._supported_s = -math.inf  # time of the last of them, or of GPS
        self._overruling: PredictedFix | None = None  # the last fix that overruled a tracked path, which may be right
        self._overruled_support = 0
        self._agreeing: list[PredictedFix] = []  # held fixes: one, and later ones that agree with it
        self._heading_error_deg: float | None = None  # compass error of the last accepted fix
        self._flyable: list[PredictedFix] = []  # held fixes at different places, along a route that can be flown

    def is_contradicted(self, now_s: float, is_tracked: bool) -> bool:
        """Return True while the last fix contradicts its prediction and another may still confirm it. On a path that
        `is_tracked`, a correct fix is confirmed soon."""
        timeout_s = _CONFIRMATION_TIMEOUT_S if is_tracked else _HELD_FIX_TIMEOUT_S
        return bool(self._agreeing) and now_s - self._agreeing[-1].match.t_s <= timeout_s

    @property
    def doubt_m(self) -> float:
        """Distance to the position on the path that was overruled, while that may be right; otherwise 0."""
        return float(np.hypot(*self._overruling.innovation_m)) if self._overruling else 0.0

    def trust_path(self, t_s: float) -> None:
        """Process a position of GPS at `t_s` that supports the path."""
        self._support, self._supported_s, self._overruling = _MAX_SUPPORT, t_s, None

    def judge(self, fix: PredictedFix, has_gps: bool, is_tracked: bool) -> GateResult:
        """Gate a fix by its innovation. `has_gps`: of the autopilot, and trusted; `is_tracked`: by visual odometry."""
        match, innovation_m = fix.match, fix.innovation_m
        heading_agrees = match.heading_agrees_with(self._heading_error_deg)
        covariance_m2 = match.covariance_m2 + fix.covariance_m2
        if mahalanobis(innovation_m, covariance_m2) <= _MAX_INNOVATION_SIGMA and heading_agrees:
            self._support = min(_MAX_SUPPORT, self._support + 1)
            if self._support >= self._overruled_support:
                self._overruling = None
            return self._accept(fix, ACCEPTED)
        error_m, predicted_sd_m = math.hypot(*innovation_m), math.sqrt(np.trace(fix.covariance_m2) / 2)
        wrong_heading = Reason(ReasonCode.HELD_ROTATED, {"rotation_deg": match.heading_error_deg or 0.0})
        if has_gps:
            self._agreeing, self._flyable = [], []
            off_gps = Reason(ReasonCode.HELD_OFF_GPS, {"distance_m": error_m})
            return GateResult(off_gps if heading_agrees else wrong_heading)
        if (overruling := self._overruling) and heading_agrees:
            covariance_m2 = covariance_m2 + overruling.covariance_m2
            if mahalanobis(innovation_m + overruling.innovation_m, covariance_m2) <= _MAX_INNOVATION_SIGMA:
                self._support, self._overruling = self._overruled_support, None
                return self._accept(fix, GateResult(overrules_path=True))
        self._flyable = [held for held in self._flyable if _is_flyable(held, fix)]
        if all(match.shares_no_place_with(held.match) for held in self._flyable):  # neighbours share places
            self._flyable.append(fix)
        drift_m_s = _TRACKED_DRIFT_M_S if is_tracked else _DRIFT_M_S
        is_recent = bool(self._agreeing) and match.t_s - self._agreeing[-1].match.t_s <= _HELD_FIX_TIMEOUT_S
        first = self._agreeing[0] if is_recent and heading_agrees else None
        if first and _compute_distance(first, fix, drift_m_s) <= _MAX_DISAGREEMENT_SIGMA:
            self._agreeing.append(fix)
            is_enough = not is_tracked or len(self._agreeing) >= _FIXES_TO_OVERRULE_TRACK
            if is_enough and _is_independent(first, fix, drift_m_s):
                return self._overrule(fix, is_tracked)
        elif heading_agrees:
            self._agreeing = [fix]
        if len(self._flyable) == _FIXES_TO_OVERRULE_TRACK:
            return self._overrule(fix, is_tracked, restarts_path=True)
        if not heading_agrees:
            return GateResult(wrong_heading)
        return GateResult(Reason(ReasonCode.HELD_OFF_PATH, {"distance_m": error_m, "accuracy_m": predicted_sd_m}))

    def _overrule(self, fix: PredictedFix, is_tracked: bool, restarts_path: bool = False) -> GateResult:
        unsupported_s = (self._agreeing or self._flyable)[0].match.t_s - self._supported_s
        self._overruling = fix if is_tracked and unsupported_s <= _SUPPORT_TIMEOUT_S else None
        self._support, self._overruled_support = 0, self._support
        return self._accept(fix, GateResult(overrules_path=True, restarts_path=restarts_path))

    def _accept(self, fix: PredictedFix, verdict: GateResult) -> GateResult:
        self._agreeing, self._flyable, self._supported_s = [], [], fix.match.t_s
        if fix.match.heading_error_deg is not None:
            self._heading_error_deg = fix.match.heading_error_deg
        return verdict


def confirm_each_other(matches: Sequence[PositionedMatch]) -> bool:
    """Return True if successive matches that agree with each other, but that nothing else supports, show the position:
    the first and the last are of other places, or farther apart than their errors explain, or there are four."""
    if len(matches) < 2:
        return False
    first, last = matches[0], matches[-1]
    apart_m = math.hypot(*offset_between_m(first.position, last.position))
    sd_m = math.hypot(compute_worst_sd(first.scatter_m2), compute_worst_sd(last.scatter_m2))
    is_independent = last.shares_no_place_with(first) or apart_m > _MAX_INNOVATION_SIGMA * sd_m
    return is_independent or len(matches) >= _FIXES_TO_OVERRULE_TRACK


def can_follow(before: PositionedMatch, match: PositionedMatch) -> bool:
    """Return True if an aircraft could have flown from one match to the next, if nothing predicts them."""
    elapsed_s = match.t_s - before.t_s
    reach_m = _MAX_SPEED_M_S * elapsed_s + 3 * math.hypot(match.accuracy_m, before.accuracy_m)
    away_m = math.hypot(*offset_between_m(before.position, match.position))
    return 0 < elapsed_s <= _MAX_UNPREDICTED_INTERVAL_S and away_m <= reach_m


def _compute_distance(one: PredictedFix, other: PredictedFix, drift_m_s: float) -> float:
    """Return the difference of the innovations of two fixes in standard deviations."""
    return mahalanobis(other.innovation_m - one.innovation_m, _sum_covariances(one, other, drift_m_s))


def _is_flyable(one: PredictedFix, other: PredictedFix) -> bool:
    """Return True if an aircraft could have flown from one fix to the other within ten seconds."""
    elapsed_s = other.match.t_s - one.match.t_s
    if not 0 < elapsed_s <= _MAX_ROUTE_INTERVAL_S or not other.match.heading_agrees_with(one.match.heading_error_deg):
        return False
    flown_m = float(np.hypot(*(other.path_point_m + other.offset_m - one.path_point_m - one.offset_m)))
    return flown_m <= _MAX_SPEED_M_S * elapsed_s


def _is_independent(one: PredictedFix, other: PredictedFix, drift_m_s: float) -> bool:
    """Return True if two fixes are at different places, or so far apart that no single wrong position explains both."""
    if other.match.shares_no_place_with(one.match):
        return True
    flown_m = other.path_point_m + other.predicted_m - one.path_point_m - one.predicted_m
    return mahalanobis(flown_m, _sum_covariances(one, other, drift_m_s)) > _MAX_INNOVATION_SIGMA


def _sum_covariances(one: PredictedFix, other: PredictedFix, drift_m_s: float) -> Doubles:
    drift_m = drift_m_s * abs(other.match.t_s - one.match.t_s)
    total: Doubles = one.match.scatter_m2 + other.match.scatter_m2 + drift_m**2 * np.eye(2)
    return total
