"""Fixes that contradict what is known of the position: one alone is not believed.

The aircraft's path, by the autopilot's reckoning, drifts slowly, so a fix far outside of that is either wrong or says
that the reckoning is: only another fix can tell. Path and fixes move together, so two right fixes lie beside the path
by the same step, and two wrong ones hardly ever do.
"""

import math
from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

from edgevpr.core.arrays import Doubles
from edgevpr.runtime.flight.navigation import ExpectedFix
from edgevpr.runtime.recognise.locate import in_sd

# In standard deviations of both together. A right fix is farther off than the first once in 3000 times; a second right
# one agrees with it within the second seven times in eight, else the next does.
_CONTRADICTS, _AGREES = 4.0, 2.0
_GOOD_FOR_S = 30.0  # after that the reckoning may have drifted anywhere
_DRIFT_M_S = 2.5  # between two fixes that agree; more is a contradiction, and the next fix tells


@dataclass(frozen=True, slots=True, kw_only=True)
class SeenFix:
    """A fix: `off_m` (2,) east and north from the point `path_m` (2,) of the path to it, its covariance (2, 2), the
    time of its frame, and the places that it comes from."""

    off_m: Doubles
    covariance_m2: Doubles
    path_m: Doubles
    t_s: float
    places: Collection[int]


@dataclass(frozen=True, slots=True)
class Weighed:
    """Verdict on a fix: the `objection` to it (None: it may be believed), and whether it `is_against` what was known
    before, and believed since others say the same."""

    objection: str | None = None
    is_against: bool = False


class Consistency:
    """Holds back a fix that contradicts what is known until a second, independent one says the same; against GPS none
    is believed."""

    def __init__(self) -> None:
        self._held: SeenFix | None = None

    def weighed(self, fix: SeenFix, expected: ExpectedFix, has_gps: bool) -> Weighed:
        """Weigh a fix against what was expected of it."""
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
    """Return by how many standard deviations two fixes disagree on where the path is wrong; infinitely where they are
    too far apart in time."""
    apart_s = abs(other.t_s - one.t_s)
    return in_sd(other.off_m - one.off_m, _of_both(one, other)) if apart_s <= _GOOD_FOR_S else math.inf


def _is_independent(one: SeenFix, other: SeenFix) -> bool:
    """Tell whether a second fix is of other places, or is so far on that one which had stayed behind would no longer
    have agreed."""
    if set(one.places).isdisjoint(other.places):
        return True
    return in_sd(other.path_m - one.path_m, _of_both(one, other)) > _CONTRADICTS


def _of_both(one: SeenFix, other: SeenFix) -> Doubles:
    drift_m = _DRIFT_M_S * abs(other.t_s - one.t_s)
    both: Doubles = one.covariance_m2 + other.covariance_m2 + drift_m**2 * np.eye(2)
    return both
