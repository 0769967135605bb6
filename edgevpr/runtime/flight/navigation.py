"""The position of the aircraft at any moment, from its `path` and the filter of the path's errors (see `drift`), and
the check of fixes against it. `navigator` uses both."""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from edgevpr.core.arrays import Doubles
from edgevpr.core.geodesy import moved
from edgevpr.core.types import Position, Vehicle
from edgevpr.runtime.flight.drift import INERTIAL, RECKONED, Drift, DriftFilter, Strode
from edgevpr.runtime.flight.path import Path, Point
from edgevpr.runtime.recognise.locate import in_sd, matrix_of
from edgevpr.runtime.recognise.perspective import Lean
from edgevpr.runtime.recognise.recognition import Recognition
from edgevpr.runtime.recognise.stride import Stride

_GPS_EVERY_S = 1.0
_GPS_NEW_S = 0.7  # positions of a receiver come five times a second; without new ones the autopilot dead-reckons
# Errors of GPS are correlated from one second to the next, so its standard deviation is multiplied by this.
_GPS_ALIKE = 2.0
_GPS_VELOCITY_SD = 0.3  # m/s
_UNKNOWN_M = 1e4
_ANY_M_S = 10.0  # standard deviation of the velocity while only a fix is known
# Limits in standard deviations. A right fix is more than _CONTRADICTS from the expected position once in 3000 times. A
# second right fix is within _AGREES of the first seven times in eight; otherwise the one after it is.
_CONTRADICTS, _AGREES = 4.0, 2.0
_GOOD_FOR_S = 30.0  # a fix held back for longer is not compared: the path may have drifted too far
_DRIFT_M_S = 2.5  # drift of the path that is allowed for between two fixes that agree
_TURNED_DEG = 45.0  # so far a compass does not turn from one fix to the next
_MOST_ALIKE = 16.0  # fixes of the same ground that count as one
_IN_A_ROW, _ROW_WITHIN_S, _FASTEST_M_S = 4, 10.0, 30.0  # of fixes that are believed against a path that is lost


@dataclass(frozen=True, slots=True, kw_only=True)
class Whereabouts:
    """Position and velocity (m/s, east and north) of the aircraft at `t_s`. The accuracies (metres, m/s) are standard
    deviations along the worst direction."""

    t_s: float
    position: Position
    velocity_m_s: tuple[float, float]
    accuracy_m: float
    speed_accuracy_m_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class HeardFrame:
    """A frame taken at `t_s`. `sd_m` is the standard deviation, of each axis, by which its picture puts the aircraft
    wrongly, beside what `lean_s2` says that an error of the attitude does (see `DriftFilter` in `drift`). `stride` is
    the motion since the frame before (None: unknown). `alike_m` is how far apart pictures are whose fixes do not err
    alike."""

    t_s: float
    sd_m: float
    lean_s2: float = 0.0
    stride: Stride | None = None
    alike_m: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class PositionedMatch:
    """An accepted match with a position: its `frame`; `position` of the aircraft then; `accuracy_m`, to be sent with
    it; `covariance_m2` (2, 2), without the error that all fixes share and that of the frame; numbers of the `places` it
    comes from; `lean`, what its picture shows of the error of the attitude; and `turn_deg`, by how much the heading
    that it shows exceeds the autopilot's."""

    frame: HeardFrame
    position: Position
    accuracy_m: float
    covariance_m2: Doubles
    places: tuple[int, ...]
    lean: Lean | None = None
    turn_deg: float | None = None

    @property
    def t_s(self) -> float:
        """Time of the frame."""
        return self.frame.t_s

    @property
    def scatter_m2(self) -> Doubles:
        """Covariance (2, 2) by which the fixes of two frames differ."""
        return self.covariance_m2 + self.frame.sd_m**2 * np.eye(2)

    def is_turned_like(self, turn_deg: float | None) -> bool:
        """Tell whether its picture is turned against the compass by about `turn_deg`, where both are known."""
        if self.turn_deg is None or turn_deg is None:
            return True
        return abs((self.turn_deg - turn_deg + 180) % 360 - 180) <= _TURNED_DEG


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


class Weighed(NamedTuple):
    """Verdict on a fix: `why` it is not believed (None: it is). `is_against`: it contradicts the expected position,
    and other fixes agree with it; `is_lost`: the path's velocity is wrong too."""

    why: str | None = None
    is_against: bool = False
    is_lost: bool = False


BELIEVED = Weighed()


class Navigation:
    """Estimates the aircraft's position from the autopilot's motion and our fixes. `drift` says what the path is summed
    up from: the autopilot's velocities (`RECKONED`) or accelerations (`INERTIAL`). `map_sd_m` is the standard
    deviation, of one axis, of the error that all fixes share. `has_gps`: the autopilot has a GPS that is believed."""

    def __init__(self, drift: Drift, map_sd_m: float) -> None:
        self._drift = drift
        self._path: Path | None = None
        self._filter = DriftFilter(drift, map_sd_m)
        self._framed: Point | None = None  # of the path, when the last frame was taken
        self._fixed_m: Doubles | None = None  # the last fix, from the origin of the path
        self.has_gps, self._gps_s, self._fixed_s = False, -math.inf, -math.inf

    @property
    def fixed_s(self) -> float:
        """Time of the last fix, stride or GPS position, whichever is the latest; -inf if there was none."""
        return max(self._fixed_s, self._gps_s)

    def hear_vehicle(self, vehicle: Vehicle, believes_gps: bool = True) -> None:
        """Process a report of the autopilot. A path of velocities (`RECKONED`) goes on with the reported velocity. If
        the autopilot has GPS, and `believes_gps`, the reported position and velocity correct ours. A report without
        velocity is ignored."""
        if vehicle.velocity_m_s is None:
            return
        had_gps, self.has_gps = self.has_gps, reckons_by_gps(vehicle) and believes_gps
        if self._drift is RECKONED and vehicle.position_sd_m is None:
            self._path = None  # it has lost its position, so its velocity is even less reliable
            return
        velocity_m_s, t_s = np.array(vehicle.velocity_m_s), vehicle.t_heard_s
        path = self._unbroken
        if path is None:
            if vehicle.position_sd_m is not None:
                here = Position(vehicle.lat_deg, vehicle.lon_deg)
                self._start(here, vehicle.position_sd_m, velocity_m_s, t_s, self._drift.velocity_sd)
            return
        if self._drift is RECKONED:
            self._filter.go_on(path.fly(t_s, velocity_m_s))
        if had_gps and not self.has_gps:
            self._filter.lose_gps()
        there = path.at(t_s)
        if there and self.has_gps and t_s - self._gps_s >= _GPS_EVERY_S:
            self._gps_s = t_s
            off_m = path.from_origin(vehicle.lat_deg, vehicle.lon_deg) - there.at_m
            sd_m = _GPS_ALIKE * (vehicle.position_sd_m or _UNKNOWN_M)
            self._filter.hear_gps(off_m, sd_m, velocity_m_s - there.velocity_m_s, _GPS_VELOCITY_SD)

    def hear_acceleration(self, t_s: float, acceleration_m_s2: Doubles) -> None:
        """Process the mean acceleration (2,) over the ground, east and north, since the last call."""
        if (path := self._unbroken) and self._drift is INERTIAL:
            self._filter.go_on(path.accelerate(t_s, acceleration_m_s2))

    def hear_frame(self, frame: HeardFrame) -> None:
        """Process a frame, whatever is recognised in it."""
        path, before = self._unbroken, self._framed
        self._framed = there = path.at(frame.t_s) if path else None
        if path is None or there is None:
            return
        stride, strode = frame.stride, None
        if stride and before and before.t_s == stride.from_s:
            moved_m = np.array(stride.moved_m)
            strode = Strode(moved_m, moved_m - (there.at_m - before.at_m), stride.sd_m)
        is_used = self._filter.hear_frame(path.now.t_s - frame.t_s, frame.lean_s2, frame.sd_m, strode)
        if strode and is_used:
            self._fixed_s = max(self._fixed_s, frame.t_s)

    def compared(self, seen: PositionedMatch) -> ComparedFix | None:
        """Compare the fix of a match with its prediction; None if the path at that time is not known. The match is of
        the last frame heard, or of a new one."""
        if self._framed is None or self._framed.t_s != seen.t_s:
            self.hear_frame(seen.frame)
        path, there = self._unbroken, self._framed
        if path is None or there is None:
            return None
        expected_m, covariance_m2 = self._filter.expected_fix()
        off_m = path.from_origin(seen.position.lat_deg, seen.position.lon_deg) - there.at_m
        return ComparedFix(
            seen=seen, path_m=there.at_m, off_m=off_m, expected_m=expected_m, covariance_m2=covariance_m2
        )

    def hear_fix(self, fix: ComparedFix, verdict: Weighed = BELIEVED) -> None:
        """Correct our position by a fix of which `Consistency` has given a verdict."""
        if self._path and verdict.is_lost and self._drift is INERTIAL:
            self.begin(fix.seen.position, worst_sd(fix.seen.scatter_m2), fix.seen.t_s, self._path.now.t_s)
        elif self._path:
            hear = self._filter.trust_fix if verdict.is_against else self._filter.hear_fix
            hear(fix.off_m, self._alike(fix) * fix.seen.covariance_m2)
            if fix.seen.frame.lean_s2 and (lean := fix.seen.lean):
                self._filter.hear_lean(np.array(lean.over_height), lean.sd)
            self._fixed_s = max(self._fixed_s, fix.seen.t_s)

    def _alike(self, fix: ComparedFix) -> float:
        """Return the factor of the covariance of a fix. Fixes of about the same ground err alike, so the nearer it is
        to the last one, the less it says. That one is remembered by the path and by strides only."""
        at_m, before_m = fix.path_m + fix.off_m, self._fixed_m
        self._fixed_m = at_m
        if fix.seen.frame.stride is None or before_m is None:
            return 1.0
        away_m = max(float(np.hypot(*(at_m - before_m))), fix.seen.frame.alike_m / _MOST_ALIKE)
        return max(1.0, fix.seen.frame.alike_m / away_m) if away_m else 1.0

    def begin(self, position: Position, sd_m: float, t_s: float, now_s: float) -> None:
        """Begin the path at `now_s`, when neither position nor velocity is known, at the `position` of a fix whose
        frame was taken at `t_s`; `sd_m` is its standard deviation. A path of velocities begins with a report only."""
        if self._drift is INERTIAL:
            sd_m = math.hypot(sd_m, _ANY_M_S * (now_s - t_s))
            self._start(position, sd_m, np.zeros(2), now_s, _ANY_M_S)
            self._fixed_s = t_s

    def at(self, t_s: float) -> Whereabouts | None:
        """Return where the aircraft is, or was, at `t_s`; None if that is not known."""
        path = self._unbroken
        there = path.at(t_s) if path else None
        if path is None or there is None:
            return None
        off_m, off_m_s, covariance = self._filter.errors(path.now.t_s - t_s)
        at_m = there.at_m + off_m
        velocity_m_s = there.velocity_m_s + off_m_s
        return Whereabouts(
            t_s=t_s,
            position=Position(*moved(path.origin.lat_deg, path.origin.lon_deg, *at_m.tolist())),
            velocity_m_s=(float(velocity_m_s[0]), float(velocity_m_s[1])),
            accuracy_m=worst_sd(covariance[:2, :2]),
            speed_accuracy_m_s=worst_sd(covariance[2:, 2:]),
        )

    def path_drift_m_s(self) -> tuple[float, float]:
        """Return the velocity (east, north) of the aircraft minus that of its path."""
        _, off_m_s, _ = self._filter.errors(0.0)
        return float(off_m_s[0]), float(off_m_s[1])

    def _start(
        self, position: Position, sd_m: float, velocity_m_s: Doubles, t_s: float, velocity_sd_m_s: float
    ) -> None:
        self._path, self._framed, self._fixed_m = Path(position, t_s, velocity_m_s), None, None
        self._filter.start(sd_m, velocity_sd_m_s)

    @property
    def _unbroken(self) -> Path | None:
        return self._path if self._path and not self._path.is_broken else None


class Consistency:
    """Holds back a fix that contradicts the expected position, until a second, independent fix agrees with it. With
    GPS, a contradicting fix is never believed.

    The path drifts slowly: of a fix far beside it, only another fix can tell whether it is wrong or the path is. Two
    right fixes have the same offset from the path, and two wrong ones hardly ever do. A path that is wrong by more
    than a drift has no such fixes: there, several in a row that an aircraft can have flown through are believed. So
    are several whose pictures are suddenly turned against the compass, of which one alone is wrong."""

    def __init__(self) -> None:
        self._held: ComparedFix | None = None
        self._turn_deg: float | None = None  # of the last fix believed: that of the compass, if it is wrong
        self._row: list[ComparedFix] = []  # of fixes held back, all of which an aircraft can have flown through

    def is_contradicted(self, now_s: float) -> bool:
        """Return True while the last fix contradicts what is expected, and another one may still agree with it."""
        return self._held is not None and now_s - self._held.seen.t_s <= _GOOD_FOR_S

    def weighed(self, fix: ComparedFix, has_gps: bool) -> Weighed:
        """Judge a fix by its prediction. `has_gps`: the autopilot has a GPS that is believed."""
        step_m, is_turned = fix.off_m - fix.expected_m, not fix.seen.is_turned_like(self._turn_deg)
        if in_sd(step_m, fix.seen.covariance_m2 + fix.covariance_m2) <= _CONTRADICTS and not is_turned:
            return self._believed(fix, BELIEVED)
        off_m, good_to_m = math.hypot(*step_m), math.sqrt(np.trace(fix.covariance_m2) / 2)
        turned = f"held back: its picture is turned by {fix.seen.turn_deg or 0:.0f} degrees against the compass"
        if has_gps:
            self._held, self._row = None, []
            there = f"held back: {off_m:.0f} m from where GPS and the fixes before say that the aircraft is"
            return Weighed(turned if is_turned else there)
        self._row = [*(each for each in self._row[1 - _IN_A_ROW :] if _could_follow(each, fix)), fix]
        if len(self._row) == _IN_A_ROW:
            return self._believed(fix, Weighed(is_against=True, is_lost=True))
        if is_turned:
            return Weighed(turned)
        if self._held is None or _differ(self._held, fix) > _AGREES:
            self._held = fix
        elif _is_independent(self._held, fix):
            return self._believed(fix, Weighed(is_against=True))
        there = "where the aircraft is by the autopilot's reckoning and the fixes before"
        return Weighed(f"held back: {off_m:.0f} m from {there}, good to {good_to_m:.0f} m: another fix has to agree")

    def _believed(self, fix: ComparedFix, verdict: Weighed) -> Weighed:
        self._held, self._row = None, []
        if fix.seen.turn_deg is not None:
            self._turn_deg = fix.seen.turn_deg
        return verdict


def reckons_by_gps(vehicle: Vehicle) -> bool:
    """Tell whether a reported position rests on GPS: a receiver has a fix near that position, at most 0.7 s old."""
    return vehicle.has_gps and vehicle.gps is not None and vehicle.t_heard_s - vehicle.gps.t_s <= _GPS_NEW_S


def worst_sd(covariance: Doubles) -> float:
    """Return the standard deviation along the worst direction of a covariance (2, 2)."""
    return float(np.sqrt(np.linalg.eigvalsh(covariance)[-1]))


def positioned(event: Recognition, frame: HeardFrame) -> PositionedMatch | None:
    """Return the positioned match of an event and its frame; None if no match with a position was accepted."""
    if event.best is None or event.located is None or event.accuracy_m is None:
        return None
    turn_deg, shown_deg, told_deg = None, event.located.heading_deg, event.view.up_deg
    if shown_deg is not None and told_deg is not None:
        turn_deg = (shown_deg - told_deg + 180) % 360 - 180
    return PositionedMatch(
        frame=frame,
        position=event.located.position,
        accuracy_m=event.accuracy_m,
        covariance_m2=matrix_of(event.located.covariance_m2),
        places=event.located.places or (event.best.place.place_id,),
        lean=event.located.lean,
        turn_deg=turn_deg,
    )


def _differ(one: ComparedFix, other: ComparedFix) -> float:
    """Return by how many standard deviations the offsets of two fixes differ; infinity if they are 30 s apart."""
    apart_s = abs(other.seen.t_s - one.seen.t_s)
    return in_sd(other.off_m - one.off_m, _of_both(one, other)) if apart_s <= _GOOD_FOR_S else math.inf


def _could_follow(one: ComparedFix, other: ComparedFix) -> bool:
    """Tell whether an aircraft can have flown from one fix to another one, of other places, within some seconds."""
    apart_s = other.seen.t_s - one.seen.t_s
    is_other = set(one.seen.places).isdisjoint(other.seen.places) and other.seen.is_turned_like(one.seen.turn_deg)
    if not 0 < apart_s <= _ROW_WITHIN_S or not is_other:
        return False
    flown_m = float(np.hypot(*(other.path_m + other.off_m - one.path_m - one.off_m)))
    return flown_m <= _FASTEST_M_S * apart_s


def _is_independent(one: ComparedFix, other: ComparedFix) -> bool:
    """Tell whether two fixes are of different places, or so far apart that one wrong position would not agree."""
    if set(one.seen.places).isdisjoint(other.seen.places):
        return True
    return in_sd(other.path_m - one.path_m, _of_both(one, other)) > _CONTRADICTS


def _of_both(one: ComparedFix, other: ComparedFix) -> Doubles:
    drift_m = _DRIFT_M_S * abs(other.seen.t_s - one.seen.t_s)
    both: Doubles = one.seen.scatter_m2 + other.seen.scatter_m2 + drift_m**2 * np.eye(2)
    return both
