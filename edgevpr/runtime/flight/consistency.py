"""Fixes that contradict what the autopilot itself knows of its position: one alone is not believed.

Without GPS the autopilot reckons where it is. Its error grows slowly, so a fix far outside of that is either wrong or
says that the reckoning is: only another fix can tell. Autopilot and fixes move together, so two right fixes lie off the
autopilot's position by the same step, and two wrong ones hardly ever do.
"""

import math
from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

from edgevpr.geodesy import offset_m
from edgevpr.mavlink.certainty import DRIFT_M_S
from edgevpr.runtime.recognise.locate import in_sd, matrix_of
from edgevpr.runtime.recognise.recognition import Recognition
from edgevpr.types import Position, Vehicle

# In standard deviations of both together. A right fix is farther off than the first once in 3000 times; a second right
# one agrees with it within the second seven times in eight, else the next does.
_CONTRADICTS, _AGREES = 4.0, 2.0
_GOOD_FOR_S = 30.0  # after that the reckoning may have drifted anywhere
_FASTEST_M_S = 30.0  # where the autopilot does not say how fast it is


@dataclass(frozen=True, slots=True, kw_only=True)
class _Offset:
    """A fix: `step_m` (2,) east and north from the autopilot's position `reckoned` to it, the covariance (2, 2) of the
    fix and of where the autopilot was then, the time of its frame, and the places that it comes from."""

    step_m: np.ndarray
    covariance_m2: np.ndarray
    reckoned: Position
    t_s: float
    places: Collection[int]


class Consistency:
    """Holds back a fix that contradicts the autopilot's position until a second, independent one says the same, and
    lets those through that go on to say so. With GPS, and where it is not known how exact the autopilot's position is,
    nothing is held back."""

    def __init__(self) -> None:
        self._held: _Offset | None = None
        self._believed: _Offset | None = None  # the last of those that agree with each other against the autopilot

    def objection(self, event: Recognition) -> str | None:
        """Return the reason why the fix of an accepted match with a position is held back; None: it may be sent."""
        vehicle, now_s = event.vehicle, event.frame.t_mono_s
        if vehicle is None or vehicle.has_gps or vehicle.position_sd_m is None or not vehicle.is_fresh_at(now_s):
            self._held = self._believed = None
            return None
        fix = _offset(event, vehicle)
        if in_sd(fix.step_m, fix.covariance_m2 + vehicle.position_sd_m**2 * np.eye(2)) <= _CONTRADICTS:
            self._held = self._believed = None
            return None
        if self._believed and _differ(self._believed, fix) <= _CONTRADICTS:
            self._believed = fix
            return None
        agrees = self._held and _differ(self._held, fix) <= _AGREES
        if agrees and _is_independent(self._held, fix):
            self._held, self._believed = None, fix
            return None
        if not agrees:
            self._held = fix
        return (
            f"held back: {math.hypot(*fix.step_m):.0f} m from where the autopilot is by its own reckoning, which is "
            f"good to {vehicle.position_sd_m:.0f} m: another fix has to agree"
        )


def _offset(event: Recognition, vehicle: Vehicle) -> _Offset:
    # No fix is claimed to be better than the accuracy that is sent with it.
    unsaid_m2 = max(0.0, event.accuracy_m**2 - event.located.accuracy_m**2)
    speed_m_s = math.hypot(*vehicle.velocity_m_s) if vehicle.velocity_m_s else _FASTEST_M_S
    room_m = speed_m_s * abs(event.frame.t_mono_s - vehicle.t_heard_s)  # flown between the report and the frame
    here = event.position
    return _Offset(
        step_m=np.array(offset_m(vehicle.lat_deg, vehicle.lon_deg, here.lat_deg, here.lon_deg)),
        covariance_m2=matrix_of(event.located.covariance_m2) + (unsaid_m2 + room_m**2) * np.eye(2),
        reckoned=Position(vehicle.lat_deg, vehicle.lon_deg),
        t_s=event.frame.t_mono_s,
        places=event.located.places or (event.best.place.place_id,),
    )


def _differ(one: _Offset, other: _Offset) -> float:
    """Return by how many standard deviations two fixes disagree on where the autopilot is wrong; infinitely where they
    are too far apart in time."""
    apart_s = abs(other.t_s - one.t_s)
    return in_sd(other.step_m - one.step_m, _of_both(one, other)) if apart_s <= _GOOD_FOR_S else math.inf


def _is_independent(one: _Offset, other: _Offset) -> bool:
    """Tell whether a second fix is of other places, or is so far on that one which had stayed behind would no longer
    have agreed."""
    if set(one.places).isdisjoint(other.places):
        return True
    moved_m = np.array(
        offset_m(one.reckoned.lat_deg, one.reckoned.lon_deg, other.reckoned.lat_deg, other.reckoned.lon_deg)
    )
    return in_sd(moved_m, _of_both(one, other)) > _CONTRADICTS


def _of_both(one: _Offset, other: _Offset) -> np.ndarray:
    drift_m = DRIFT_M_S * abs(other.t_s - one.t_s)
    return one.covariance_m2 + other.covariance_m2 + drift_m**2 * np.eye(2)
