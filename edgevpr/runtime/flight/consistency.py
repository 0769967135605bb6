"""The check of each fix against where the path says that the aircraft is. `navigator` uses it."""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from edgevpr.core.arrays import Doubles
from edgevpr.core.reasons import Reason, ReasonCode
from edgevpr.runtime.flight.measurements import PositionedMatch
from edgevpr.runtime.recognise.locate import mahalanobis

# Limits in standard deviations. A right fix is more than _CONTRADICTS from the expected position once in 3000 times. A
# second right fix is within _AGREES of the first seven times in eight; otherwise the one after it is.
_CONTRADICTS, _AGREES = 4.0, 2.0
_GOOD_FOR_S = 30.0  # a fix held back for longer is not compared: the path may have drifted too far
_JOINED_WITHIN_S = 2.5
_DRIFT_M_S, _FOLLOWED_DRIFT_M_S = 2.5, 0.5  # drift of the path that is allowed for between two fixes that agree
_IN_A_ROW, _ROW_WITHIN_S, _FASTEST_M_S = 4, 10.0, 30.0  # of fixes that are believed against a path that is lost


@dataclass(frozen=True, slots=True, kw_only=True)
class ComparedFix:
    """The fix of a match (`seen`) and its prediction by the path, in metres east and north. `path_m` (2,): the point of
    the path when the frame was taken; `off_m` (2,): the offset of the fix from that point; `expected_m` (2,): the
    predicted offset; `covariance_m2` (2, 2): that of the prediction, without that of the fix."""

    seen: PositionedMatch
    path_m: Doubles
    off_m: Doubles
    expected_m: Doubles
    covariance_m2: Doubles

    @property
    def beside_m(self) -> Doubles:
        """Offset of the fix from where it was expected (2,)."""
        return self.off_m - self.expected_m


class GateResult(NamedTuple):
    """Verdict on a fix: `why` it is not believed (None: it is). `is_against`: it contradicts the expected position,
    and other fixes agree with it; `is_lost`: the path's velocity is wrong too."""

    why: Reason | None = None
    is_against: bool = False
    is_lost: bool = False


BELIEVED = GateResult()


class Consistency:
    """Holds back a fix that contradicts the expected position, until a second, independent fix agrees with it. With
    GPS, a contradicting fix is never believed.

    The path drifts slowly: of a fix far beside it, only another fix can tell whether it is wrong or the path is. Two
    right fixes have the same offset from the path, and two wrong ones hardly ever do. A path that is wrong by more
    than a drift has no such fixes: there, several of different places that an aircraft can have flown through are
    believed. Only several are believed, too, where the camera has followed the path from frame to frame, since ground
    that repeats itself can say the same twice, and where pictures are suddenly turned against the compass."""

    def __init__(self) -> None:
        self._agreeing: list[ComparedFix] = []  # fixes held back: one, and those after it that say the same
        self._turn_deg: float | None = None  # of the last fix believed: that of the compass, if it is wrong
        self._row: list[ComparedFix] = []  # fixes held back, of different places, that can have been flown through

    def is_contradicted(self, now_s: float, is_followed: bool) -> bool:
        """Return True while the last fix contradicts what is expected, and another one may still agree with it. Where
        the path `is_followed` from frame to frame, one that was right would be followed by another soon."""
        good_for_s = _JOINED_WITHIN_S if is_followed else _GOOD_FOR_S
        return bool(self._agreeing) and now_s - self._agreeing[-1].seen.t_s <= good_for_s

    def judge(self, fix: ComparedFix, has_gps: bool, is_followed: bool) -> GateResult:
        """Judge a fix by its prediction. `has_gps`: the autopilot has a GPS that is believed; `is_followed`: the path
        is known from frame to frame, so that it takes several to be wrong."""
        step_m, is_turned = fix.beside_m, not fix.seen.is_turned_like(self._turn_deg)
        if mahalanobis(step_m, fix.seen.covariance_m2 + fix.covariance_m2) <= _CONTRADICTS and not is_turned:
            return self._believe(fix, BELIEVED)
        off_m, good_to_m = math.hypot(*step_m), math.sqrt(np.trace(fix.covariance_m2) / 2)
        turned = Reason(ReasonCode.HELD_TURNED, {"turn_deg": fix.seen.turn_deg or 0.0})
        if has_gps:
            self._agreeing, self._row = [], []
            return GateResult(turned if is_turned else Reason(ReasonCode.HELD_OFF_GPS, {"off_m": off_m}))
        self._row = [each for each in self._row if _could_follow(each, fix)]
        if all(fix.seen.is_of_other_places(each.seen) for each in self._row):  # neighbours share places
            self._row.append(fix)
        if len(self._row) == _IN_A_ROW:
            return self._believe(fix, GateResult(is_against=True, is_lost=True))
        if is_turned:
            return GateResult(turned)
        drift_m_s = _FOLLOWED_DRIFT_M_S if is_followed else _DRIFT_M_S
        if self._agreeing and _differ(self._agreeing[0], fix, drift_m_s) <= _AGREES:
            self._agreeing.append(fix)
            is_enough = not is_followed or len(self._agreeing) >= _IN_A_ROW
            if is_enough and _is_independent(self._agreeing[0], fix, drift_m_s):
                return self._believe(fix, GateResult(is_against=True))
        else:
            self._agreeing = [fix]
        return GateResult(Reason(ReasonCode.HELD_OFF_PATH, {"off_m": off_m, "accuracy_m": good_to_m}))

    def _believe(self, fix: ComparedFix, verdict: GateResult) -> GateResult:
        self._agreeing, self._row = [], []
        if fix.seen.turn_deg is not None:
            self._turn_deg = fix.seen.turn_deg
        return verdict


def _differ(one: ComparedFix, other: ComparedFix, drift_m_s: float) -> float:
    """Return by how many standard deviations two fixes differ, each as seen from where it was expected; infinity if
    they are 30 s apart."""
    if abs(other.seen.t_s - one.seen.t_s) > _GOOD_FOR_S:
        return math.inf
    return mahalanobis(other.beside_m - one.beside_m, _sum_covariances(one, other, drift_m_s))


def _could_follow(one: ComparedFix, other: ComparedFix) -> bool:
    """Tell whether an aircraft can have flown from one fix to another one within some seconds."""
    apart_s = other.seen.t_s - one.seen.t_s
    if not 0 < apart_s <= _ROW_WITHIN_S or not other.seen.is_turned_like(one.seen.turn_deg):
        return False
    flown_m = float(np.hypot(*(other.path_m + other.off_m - one.path_m - one.off_m)))
    return flown_m <= _FASTEST_M_S * apart_s


def _is_independent(one: ComparedFix, other: ComparedFix, drift_m_s: float) -> bool:
    """Tell whether two fixes are of different places, or so far apart that one wrong position would not agree."""
    if other.seen.is_of_other_places(one.seen):
        return True
    flown_m = other.path_m + other.expected_m - one.path_m - one.expected_m
    return mahalanobis(flown_m, _sum_covariances(one, other, drift_m_s)) > _CONTRADICTS


def _sum_covariances(one: ComparedFix, other: ComparedFix, drift_m_s: float) -> Doubles:
    drift_m = drift_m_s * abs(other.seen.t_s - one.seen.t_s)
    both: Doubles = one.seen.scatter_m2 + other.seen.scatter_m2 + drift_m**2 * np.eye(2)
    return both
