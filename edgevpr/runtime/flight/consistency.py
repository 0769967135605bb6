"""Check of fixes against the expected position: a fix that contradicts it is not believed until a second one agrees.
`navigator` uses it.

The path (see `path`) is summed up from the autopilot's velocities and drifts slowly. If a fix lies far outside of that
drift, either the fix is wrong or the path is: only another fix can tell. The path moves with the aircraft, so two right
fixes have the same offset from it, and two wrong ones hardly ever do.
"""

import math
from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

from edgevpr.core.arrays import Doubles
from edgevpr.runtime.flight.navigation import ExpectedFix
from edgevpr.runtime.recognise.locate import in_sd

# Limits in standard deviations. A right fix is more than _CONTRADICTS from the expected position once in 3000 times. A
# second right fix is within _AGREES of the first seven times in eight; otherwise the one after it is.
_CONTRADICTS, _AGREES = 4.0, 2.0
_GOOD_FOR_S = 30.0  # a fix held back for longer is not compared: the path may have drifted too far
_DRIFT_M_S = 2.5  # drift of the path that is allowed for between two fixes that agree


@dataclass(frozen=True, slots=True, kw_only=True)
class SeenFix:
    """A fix to be judged. `off_m` (2,): metres east and north from the path to the fix; `covariance_m2` (2, 2): that of
    the fix; `path_m` (2,): point of the path when its frame was taken, metres from the path's origin; `t_s`: time of
    the frame; `places`: numbers of the places that it comes from."""

    off_m: Doubles
    covariance_m2: Doubles
    path_m: Doubles
    t_s: float
    places: Collection[int]


@dataclass(frozen=True, slots=True)
class Weighed:
    """Verdict on a fix. `objection` is why it is not believed (None: it is believed). `is_against`: it contradicts the
    expected position, and is believed because an earlier fix agrees with it."""

    objection: str | None = None
    is_against: bool = False


class Consistency:
    """Holds back a fix that contradicts the expected position, until a second, independent fix agrees with it. With
    GPS, a contradicting fix is never believed."""

    def __init__(self) -> None:
        self._held: SeenFix | None = None

    def weighed(self, fix: SeenFix, expected: ExpectedFix, has_gps: bool) -> Weighed:
        """Judge a fix by the one that was `expected`. `has_gps`: the autopilot has a GPS that is believed."""
        step_m = fix.off_m - expected.off_m
        if in_sd(step_m, fix.covariance_m2 + expected.covariance_m2) <= _CONTRADICTS:
            self._held = None
            return Weighed()
        off_m, good_to_m = math.hypot(*step_m), math.sqrt(np.trace(expected.covariance_m2) / 2)
        if has_gps:
            self._held = None
            return Weighed(f"held back: {off_m:.0f} m from where GPS and the fixes before say that the aircraft is")
        if self._held is None or _differ(self._held, fix) > _AGREES:
            self._held = fix
        elif _is_independent(self._held, fix):
            self._held = None
            return Weighed(is_against=True)
        return Weighed(
            f"held back: {off_m:.0f} m from where the aircraft is by the autopilot's reckoning and the fixes before, "
            f"good to {good_to_m:.0f} m: another fix has to agree"
        )


def _differ(one: SeenFix, other: SeenFix) -> float:
    """Return by how many standard deviations the offsets of two fixes from the path differ; infinity if more than 30 s
    lie between the fixes."""
    apart_s = abs(other.t_s - one.t_s)
    return in_sd(other.off_m - one.off_m, _of_both(one, other)) if apart_s <= _GOOD_FOR_S else math.inf


def _is_independent(one: SeenFix, other: SeenFix) -> bool:
    """Return True if two fixes are of different places, or if the aircraft has flown so far in between that the same
    wrong position, found twice, would not agree."""
    if set(one.places).isdisjoint(other.places):
        return True
    return in_sd(other.path_m - one.path_m, _of_both(one, other)) > _CONTRADICTS


def _of_both(one: SeenFix, other: SeenFix) -> Doubles:
    drift_m = _DRIFT_M_S * abs(other.t_s - one.t_s)
    both: Doubles = one.covariance_m2 + other.covariance_m2 + drift_m**2 * np.eye(2)
    return both
