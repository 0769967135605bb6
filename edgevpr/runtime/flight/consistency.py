"""Check of fixes against the expected position: a fix that contradicts it is not believed until a second one agrees.
`navigator` uses it.

The path (see `path`) is summed up from the autopilot's velocities and drifts slowly. If a fix lies far outside of that
drift, either the fix is wrong or the path is: only another fix can tell. The path moves with the aircraft, so two right
fixes have the same offset from it, and two wrong ones hardly ever do.
"""

import math

import numpy as np

from edgevpr.core.arrays import Doubles
from edgevpr.runtime.flight.navigation import ComparedFix
from edgevpr.runtime.recognise.locate import in_sd

# Limits in standard deviations. A right fix is more than _CONTRADICTS from the expected position once in 3000 times. A
# second right fix is within _AGREES of the first seven times in eight; otherwise the one after it is.
_CONTRADICTS, _AGREES = 4.0, 2.0
_GOOD_FOR_S = 30.0  # a fix held back for longer is not compared: the path may have drifted too far
_DRIFT_M_S = 2.5  # drift of the path that is allowed for between two fixes that agree


class Consistency:
    """Holds back a fix that contradicts the expected position, until a second, independent fix agrees with it. With
    GPS, a contradicting fix is never believed."""

    def __init__(self) -> None:
        self._held: ComparedFix | None = None

    def weighed(self, fix: ComparedFix, has_gps: bool) -> tuple[str | None, bool]:
        """Judge a fix by its prediction. `has_gps`: the autopilot has a GPS that is believed. Returns two values:
        - the reason why the fix is not believed (None: it is believed);
        - True if the fix contradicts the expected position, but is believed because an earlier fix agrees with it."""
        step_m = fix.off_m - fix.expected_m
        if in_sd(step_m, fix.seen.covariance_m2 + fix.covariance_m2) <= _CONTRADICTS:
            self._held = None
            return None, False
        off_m, good_to_m = math.hypot(*step_m), math.sqrt(np.trace(fix.covariance_m2) / 2)
        if has_gps:
            self._held = None
            return f"held back: {off_m:.0f} m from where GPS and the fixes before say that the aircraft is", False
        if self._held is None or _differ(self._held, fix) > _AGREES:
            self._held = fix
        elif _is_independent(self._held, fix):
            self._held = None
            return None, True
        there = "where the aircraft is by the autopilot's reckoning and the fixes before"
        return f"held back: {off_m:.0f} m from {there}, good to {good_to_m:.0f} m: another fix has to agree", False


def _differ(one: ComparedFix, other: ComparedFix) -> float:
    """Return by how many standard deviations the offsets of two fixes from the path differ; infinity if more than 30 s
    lie between the fixes."""
    apart_s = abs(other.seen.t_s - one.seen.t_s)
    return in_sd(other.off_m - one.off_m, _of_both(one, other)) if apart_s <= _GOOD_FOR_S else math.inf


def _is_independent(one: ComparedFix, other: ComparedFix) -> bool:
    """Return True if two fixes are of different places, or if the aircraft has flown so far in between that the same
    wrong position, found twice, would not agree."""
    if set(one.seen.places).isdisjoint(other.seen.places):
        return True
    return in_sd(other.path_m - one.path_m, _of_both(one, other)) > _CONTRADICTS


def _of_both(one: ComparedFix, other: ComparedFix) -> Doubles:
    drift_m = _DRIFT_M_S * abs(other.seen.t_s - one.seen.t_s)
    both: Doubles = one.seen.covariance_m2 + other.seen.covariance_m2 + drift_m**2 * np.eye(2)
    return both
