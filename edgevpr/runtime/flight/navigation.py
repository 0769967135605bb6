"""The position of the aircraft at any moment, from its `path` and the filter of the path's errors (see `drift`)."""

import math
from dataclasses import dataclass

import numpy as np

from edgevpr.core.arrays import Doubles
from edgevpr.core.geodesy import offset_position
from edgevpr.core.types import Position, Receiver, Vehicle
from edgevpr.mavlink.receivers import RECEIVER_LAG_S, extrapolate
from edgevpr.runtime.flight.consistency import ACCEPTED, GateResult, PredictedFix
from edgevpr.runtime.flight.drift import Drift, DriftFilter, OdometryMeasurement
from edgevpr.runtime.flight.measurements import RECEIVER_LAG_SD_S, FrameMeasurement, PositionedMatch, worst_sd
from edgevpr.runtime.flight.output import MATCH_PROOF_S
from edgevpr.runtime.flight.path import Path, Point
from edgevpr.runtime.recognise.locate import mahalanobis

_GPS_EVERY_S = 1.0
_GPS_NEW_S = 0.7  # positions of a receiver come five times a second; without new ones the autopilot dead-reckons
# Errors of GPS are correlated from one second to the next, so its standard deviation is multiplied by this.
_GPS_ALIKE = 2.0
_GPS_VELOCITY_SD = 0.3  # m/s
_UNKNOWN_M = 1e4
_ANY_M_S = 10.0  # standard deviation of the velocity while only a fix is known
_FOLLOWED_S = 4.0  # after the frame of the last stride, and the longest time between two queries
_MAX_ALIKE = 16.0  # fixes of the same ground that count as one
# Between matches the ground under the strides may be higher or lower than taken for: what neighbouring pictures show of
# that sums up. An attitude that is two degrees wrong shows as much as the first over 300 m, 100 m high. After a gap of
# so many seconds nothing is known of it, and 0.3 is a valley of 30 m, seen from 100 m.
_UNTOLD_ZOOM = 0.1
_STRIDE_GAP_S = 5.0
_UNSEEN_SCALE = 0.3
_CONTRADICTS_SD = 5.0  # a receiver that is farther from our position is not used to correct it
# A steady receiver that contradicts our position for so long is right, unless a match of the last seconds proves ours.
_OVERRULES_S = 2.0
_START_STEADY_S = 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class NavState:
    """Position and velocity (m/s, east and north) of the aircraft at `t_s`. The accuracies (metres, m/s) are standard
    deviations along the worst direction."""

    t_s: float
    position: Position
    velocity_m_s: tuple[float, float]
    accuracy_m: float
    speed_accuracy_m_s: float


class Navigation:
    """Estimates the aircraft's position from the autopilot's motion and our fixes. `drift`: the path is summed up from
    the autopilot's velocities (`RECKONED`) or from accelerations (`INERTIAL`, `INERTIAL_PX4`). `map_sd_m` is the
    standard deviation, of one axis, of the error that all fixes share.

    Accelerations go with positions that are sent all the time, of which the autopilot's estimate may be made: GPS is
    then what its receiver reports itself. `has_gps`: there is a GPS that is believed. `is_in_doubt`: a GPS contradicts
    our position, and no match proves ours."""

    def __init__(self, drift: Drift, map_sd_m: float) -> None:
        self._drift = drift
        self._path: Path | None = None
        self._filter = DriftFilter(drift, map_sd_m)
        self._framed: Point | None = None  # of the path, when the last frame was taken
        self._fixed_m: Doubles | None = None  # the last fix, from the origin of the path
        self.has_gps, self._gps_s, self._fixed_s, self._strode_s = False, -math.inf, -math.inf, -math.inf
        self.is_in_doubt = False
        self._strides_since_fix = _StridesSinceFix()
        self._contradicted_since_s: float | None = None
        self._asked_s, self._asks_every_s = -math.inf, math.inf  # the last query's frame, and the time before it

    @property
    def fixed_s(self) -> float:
        """Time of the last match that was believed; -inf if there was none."""
        return self._fixed_s

    @property
    def shown_s(self) -> float:
        """Time of the last fix or stride; -inf if there was none."""
        return max(self._fixed_s, self._strode_s)

    @property
    def gps_s(self) -> float:
        """Time of the last GPS position that was used; -inf if there was none."""
        return self._gps_s

    @property
    def path_velocity_m_s(self) -> Doubles | None:
        """Velocity (2,) of the path now, which no match has corrected; None if it is not known."""
        return self._valid_path.now.velocity_m_s if self._valid_path else None

    def is_followed(self, t_s: float) -> bool:
        """Tell whether the path is followed from frame to frame, by strides that it does not contradict, and queries
        are so frequent that several can contradict it soon."""
        return max(t_s - self._strode_s, self._asks_every_s) <= _FOLLOWED_S

    def add_report(self, vehicle: Vehicle, believes_gps: bool = True, is_estimate_ours: bool = False) -> None:
        """Process a report of the autopilot; one without velocity is ignored. If there is GPS, and `believes_gps`, it
        corrects ours: as reported by the autopilot, or beside accelerations by the receiver. `is_estimate_ours`: the
        reported position may be made of positions that we have sent."""
        if vehicle.velocity_m_s is None:
            return
        has_gps = rests_on_gps(vehicle) and believes_gps
        if self._drift.is_of_attitude:
            self._follow_receiver(vehicle, vehicle.gps if has_gps else None, is_estimate_ours)
        else:
            self._follow_estimate(vehicle, has_gps)

    def _follow_estimate(self, vehicle: Vehicle, has_gps: bool) -> None:
        had_gps, self.has_gps = self.has_gps, has_gps
        if vehicle.position_sd_m is None:
            self._path = None  # it has lost its position, so its velocity is even less reliable
            return
        velocity_m_s, t_s = np.array(vehicle.velocity_m_s), vehicle.t_heard_s
        path = self._valid_path
        if path is None:
            self._start_at_estimate(vehicle)
            return
        self._filter.predict(path.add_velocity(t_s, velocity_m_s))
        if had_gps and not self.has_gps:
            self._filter.lose_gps()
        there = path.interpolate(t_s)
        if there and self.has_gps and t_s - self._gps_s >= _GPS_EVERY_S:
            self._record_gps(t_s)
            off_m = path.compute_offset_m(vehicle.lat_deg, vehicle.lon_deg) - there.position_m
            sd_m = _GPS_ALIKE * (vehicle.position_sd_m or _UNKNOWN_M)
            self._filter.correct_by_gps(off_m, sd_m, velocity_m_s - there.velocity_m_s, _GPS_VELOCITY_SD)

    def _follow_receiver(self, vehicle: Vehicle, receiver: Receiver | None, is_estimate_ours: bool) -> None:
        """Correct the path of accelerations by a receiver (None: there is no GPS that is believed)."""
        path, had_gps = self._valid_path, self.has_gps
        if path is None:
            self.has_gps = receiver is not None and self._start_at_receiver(receiver, vehicle.t_heard_s)
            if receiver is None and not is_estimate_ours:
                self._start_at_estimate(vehicle)
            return
        off = None if receiver is None else self._compare_receiver(path, receiver)
        if receiver is None or off is None:
            self.has_gps = self.is_in_doubt = False
            self._contradicted_since_s = None
            if had_gps:
                self._filter.lose_gps()
            return
        off_m, sd_m, off_m_s, sd_m_s, age_s = off
        expected_m, _, covariance = self._filter.errors(age_s)
        if mahalanobis(off_m - expected_m, covariance[:2, :2] + sd_m**2 * np.eye(2)) > _CONTRADICTS_SD:
            self._contradict(receiver, vehicle.t_heard_s)
            return
        self.has_gps, self.is_in_doubt, self._contradicted_since_s = True, False, None
        if vehicle.t_heard_s - self._gps_s >= _GPS_EVERY_S:
            self._record_gps(vehicle.t_heard_s)
            self._filter.correct_by_gps(off_m, sd_m, off_m_s, sd_m_s, age_s)

    def _contradict(self, receiver: Receiver, now_s: float) -> None:
        """Process a receiver that contradicts our position: where it goes on and no match proves ours, begin there."""
        self.has_gps, self.is_in_doubt = False, now_s - self._fixed_s > MATCH_PROOF_S
        if self._contradicted_since_s is None:
            self._contradicted_since_s = now_s
        lasts_s = min(receiver.steady_for_s, now_s - self._contradicted_since_s)
        if self.is_in_doubt and lasts_s >= _OVERRULES_S:
            self.has_gps = self._start_at_receiver(receiver, now_s)

    def _compare_receiver(
        self, path: Path, receiver: Receiver
    ) -> tuple[Doubles, float, Doubles | None, float, float] | None:
        """Return the offset (2,) from the path to a receiver, its standard deviation, by how much the receiver's
        velocity exceeds the path's (2,; None: unknown), its standard deviation, and the age of both (None: unknown)."""
        measured_s = receiver.t_s - RECEIVER_LAG_S
        there, before = path.interpolate(measured_s), path.interpolate(measured_s - RECEIVER_LAG_SD_S)
        if there is None or before is None:
            return None
        off_m = path.compute_offset_m(receiver.lat_deg, receiver.lon_deg) - there.position_m
        speed_m_s = float(np.hypot(*there.velocity_m_s))
        sd_m = math.hypot(_GPS_ALIKE * receiver.sd_m, RECEIVER_LAG_SD_S * speed_m_s)
        off_m_s = None if receiver.velocity_m_s is None else np.array(receiver.velocity_m_s) - there.velocity_m_s
        # In a turn the velocity of a moment before is another one: that would be taken for an error of the attitude.
        sd_m_s = math.hypot(_GPS_VELOCITY_SD, *(there.velocity_m_s - before.velocity_m_s))
        return off_m, sd_m, off_m_s, sd_m_s, path.now.t_s - measured_s

    def _start_at_estimate(self, vehicle: Vehicle) -> None:
        if vehicle.position_sd_m is not None:
            here, velocity_m_s = Position(vehicle.lat_deg, vehicle.lon_deg), np.array(vehicle.velocity_m_s)
            self._start(here, vehicle.position_sd_m, velocity_m_s, vehicle.t_heard_s, self._drift.velocity_sd)

    def _start_at_receiver(self, receiver: Receiver, now_s: float) -> bool:
        """Begin the path at a receiver's position, if that is steady; return True if it was begun."""
        if receiver.steady_for_s < _START_STEADY_S:
            return False
        velocity_m_s, velocity_sd_m_s = np.zeros(2), _ANY_M_S
        if receiver.velocity_m_s is not None:
            velocity_m_s, velocity_sd_m_s = np.array(receiver.velocity_m_s), _GPS_VELOCITY_SD
        position = Position(*extrapolate(receiver, now_s))
        self._start(position, _GPS_ALIKE * receiver.sd_m, velocity_m_s, now_s, velocity_sd_m_s)
        self._record_gps(now_s)
        self.is_in_doubt, self._contradicted_since_s = False, None
        return True

    def _record_gps(self, now_s: float) -> None:
        self._gps_s, self._strides_since_fix = now_s, _StridesSinceFix(now_s)

    def add_acceleration(self, t_s: float, acceleration_m_s2: Doubles) -> None:
        """Process the mean acceleration (2,) over the ground, east and north, since the last call."""
        if (path := self._valid_path) and self._drift.is_of_attitude:
            self._filter.predict(path.add_acceleration(t_s, acceleration_m_s2))

    def add_frame(self, frame: FrameMeasurement, is_query: bool = True, turn_deg: float | None = None) -> None:
        """Process a frame, whatever is recognised in it, or one that is no query and only shows its stride. `turn_deg`
        is that of its match (see `PositionedMatch`)."""
        if is_query:
            self._asks_every_s, self._asked_s = frame.t_s - self._asked_s, frame.t_s
        path, before = self._valid_path, self._framed
        self._framed = there = path.interpolate(frame.t_s) if path else None
        if path is None or there is None:
            return
        if turn_deg is not None:
            self._filter.correct_by_turn(math.radians(turn_deg))
        stride, strode = frame.odometry, None
        if stride and before and before.t_s == stride.from_s:
            moved_m = np.array(stride.moved_m)
            strode = OdometryMeasurement(moved_m, moved_m - (there.position_m - before.position_m), stride.sd_m)
        is_used = self._filter.add_frame(path.now.t_s - frame.t_s, frame.lean_s2, frame.sd_m, strode)
        if stride and strode and is_used:
            self._strides_since_fix.add(strode.moved_m, stride.zoom, frame)
            self._strode_s = frame.t_s

    def compare(self, seen: PositionedMatch) -> PredictedFix | None:
        """Compare the fix of a match with its prediction; None if the path at that time is not known. The match is of
        the last frame heard, or of a new one."""
        if self._framed is None or self._framed.t_s != seen.t_s:
            self.add_frame(seen.frame, turn_deg=seen.turn_deg)
        path, there = self._valid_path, self._framed
        if path is None or there is None:
            return None
        expected_m, covariance_m2 = self._filter.predict_fix()
        off_m = path.compute_offset_m(seen.position.lat_deg, seen.position.lon_deg) - there.position_m
        return PredictedFix(
            seen=seen, path_m=there.position_m, off_m=off_m, expected_m=expected_m, covariance_m2=covariance_m2
        )

    def correct_by_fix(self, fix: PredictedFix, verdict: GateResult = ACCEPTED) -> None:
        """Correct our position by a fix of which `Consistency` has given a verdict."""
        if self._path and verdict.is_lost and self._drift.is_of_attitude:
            self.begin(fix.seen.position, worst_sd(fix.seen.scatter_m2), fix.seen.t_s, self._path.now.t_s)
        elif self._path:
            correct = self._filter.reset_to_fix if verdict.is_against else self._filter.correct_by_fix
            correct(fix.off_m, self._repetition_factor(fix) * fix.seen.covariance_m2)
            if fix.seen.frame.lean_s2 and (lean := fix.seen.lean):
                self._filter.correct_by_attitude_error(np.array(lean.over_height), lean.sd)
            self._fixed_s = max(self._fixed_s, fix.seen.t_s)
            self._strides_since_fix = _StridesSinceFix(self._fixed_s)

    def _repetition_factor(self, fix: PredictedFix) -> float:
        """Return the factor of the covariance of a fix: the nearer it is to the last one, the more it repeats of its
        error. It is 1 without a stride: then the last one does not last, since nothing carries it on."""
        at_m, before_m = fix.path_m + fix.off_m, self._fixed_m
        self._fixed_m = at_m
        alike_m = fix.seen.frame.alike_m
        if fix.seen.frame.odometry is None or before_m is None or alike_m == 0:
            return 1.0
        away_m = float(np.hypot(*(at_m - before_m)))
        return max(1.0, alike_m / max(away_m, alike_m / _MAX_ALIKE))

    def begin(self, position: Position, sd_m: float, t_s: float, now_s: float) -> None:
        """Begin the path at `now_s`, when neither position nor velocity is known, at the `position` of a fix whose
        frame was taken at `t_s`; `sd_m` is its standard deviation. A path of velocities begins with a report only."""
        if self._drift.is_of_attitude:
            sd_m = math.hypot(sd_m, _ANY_M_S * (now_s - t_s))
            self._start(position, sd_m, np.zeros(2), now_s, _ANY_M_S)
            self._fixed_s = t_s

    def estimate_state(self, t_s: float) -> NavState | None:
        """Return where the aircraft is, or was, at `t_s`; None if that is not known."""
        path = self._valid_path
        there = path.interpolate(t_s) if path else None
        if path is None or there is None:
            return None
        off_m, off_m_s, covariance = self._filter.errors(path.now.t_s - t_s)
        at_m = there.position_m + off_m
        velocity_m_s = there.velocity_m_s + off_m_s
        return NavState(
            t_s=t_s,
            position=Position(*offset_position(path.origin.lat_deg, path.origin.lon_deg, *at_m.tolist())),
            velocity_m_s=(float(velocity_m_s[0]), float(velocity_m_s[1])),
            accuracy_m=math.hypot(worst_sd(covariance[:2, :2]), self._strides_since_fix.error_m),
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
    def _valid_path(self) -> Path | None:
        return self._path if self._path and not self._path.is_broken else None


class _StridesSinceFix:
    """What strides have shown since the last fix or GPS, at `fixed_s`: how far they lead, and how the scale changes."""

    def __init__(self, fixed_s: float = -math.inf) -> None:
        self._moved_m, self._zoom, self._last_s = np.zeros(2), 0.0, fixed_s
        self._has_gap, self._scale_sd = False, 0.0

    def add(self, moved_m: Doubles, zoom: float, frame: FrameMeasurement) -> None:
        """Add a stride by `moved_m` (2,) metres to a frame."""
        self._has_gap |= frame.t_s - self._last_s > _STRIDE_GAP_S
        self._scale_sd = max(self._scale_sd, frame.scale_sd)
        self._moved_m, self._zoom, self._last_s = self._moved_m + moved_m, self._zoom + zoom, frame.t_s

    @property
    def error_m(self) -> float:
        """Standard deviation of one axis by which a changed height of the ground can have led us astray, metres."""
        unseen = _UNSEEN_SCALE if self._has_gap else 0.0
        # What the last match has shown of the height, and what has changed since.
        scale_sd = self._scale_sd + max(unseen, abs(self._zoom) - _UNTOLD_ZOOM, 0.0)
        return float(np.hypot(*self._moved_m)) * scale_sd


def rests_on_gps(vehicle: Vehicle) -> bool:
    """Tell whether a reported position rests on GPS: a receiver has a fix near that position, at most 0.7 s old."""
    return vehicle.has_gps and vehicle.gps is not None and vehicle.t_heard_s - vehicle.gps.t_s <= _GPS_NEW_S
