"""Estimates the aircraft's position at any time, from its `path` and the filter of the path's errors (`drift`)."""

import math
from dataclasses import dataclass

import numpy as np

from edgevpr.core.arrays import Doubles
from edgevpr.core.geodesy import move_position
from edgevpr.core.types import Position, Receiver, Vehicle
from edgevpr.mavlink.receivers import MAX_FIX_AGE_S, RECEIVER_LAG_S, extrapolate
from edgevpr.runtime.flight.consistency import ACCEPTED, GateResult, PredictedFix, confirm_each_other
from edgevpr.runtime.flight.drift import Drift, DriftFilter
from edgevpr.runtime.flight.measurements import RECEIVER_LAG_SD_S, FrameMeasurement, PositionedMatch
from edgevpr.runtime.flight.output import MATCH_PROOF_S
from edgevpr.runtime.flight.path import Path, Point
from edgevpr.runtime.recognise.locate import compute_worst_sd, mahalanobis

_GPS_INTERVAL_S = 1.0
# GPS errors are correlated from one second to the next, so the standard deviation is multiplied by this.
_GPS_CORRELATION_FACTOR = 2.0
_GPS_VELOCITY_SD_M_S = 0.3
_UNKNOWN_POSITION_SD_M = 1e4
_UNKNOWN_VELOCITY_SD_M_S = 10.0  # while only a fix is known
# A match that agrees with a rougher prediction, and is farther from it than two of these, proves nothing: a place that
# looks alike could agree too.
_MAX_PROVING_SD_M = 25.0
_NOWHERE = Position(0.0, 0.0)  # origin of a path whose position is unknown
_MAX_TRACKING_GAP_S = 4.0  # since the last odometry step, and between two queries
_MAX_REPETITION_FACTOR = 16.0  # number of fixes over the same ground that count as one
_MAX_RECEIVER_SIGMA = 5.0  # a receiver farther from our position is not used to correct it
# A steady receiver that contradicts our position for this long is correct, unless a recent match proves our position.
_GPS_OVERRULES_S = 2.0
_MIN_STEADY_S = 1.0
# A receiver that has just come back may be off. While matches prove our position, its difference counts as its error.
_PROBATION_S = 10.0


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
    """Estimates the aircraft's position from the autopilot's motion and our fixes. `drift`: the path is integrated from
    the autopilot's velocities (`DEAD_RECKONING`) or from accelerations (`INERTIAL`, `INERTIAL_PX4`). `map_sd_m` is the
    standard deviation, of one axis, of the error common to all fixes.

    Accelerations are used with a continuous channel, where the autopilot's estimate may come from our positions, also
    from those sent before edgevpr was restarted: such a path starts only at a receiver or a match, and GPS is the
    position that the receiver itself reports. `has_gps`: there is a trusted GPS. `is_in_doubt`: a GPS contradicts our
    position, and no recent match proves it. `is_confirmed`: False after a match while the position was unknown, until
    another one or GPS agrees. `last_gps_s`, `last_fix_s`: when GPS or a match was last used (-inf: never)."""

    def __init__(self, drift: Drift, map_sd_m: float) -> None:
        self._drift = drift
        self._path: Path | None = None
        self._unplaced_path: Path | None = None  # the last accelerations, while the position is unknown
        self._filter = DriftFilter(drift, map_sd_m)
        self._frame_point: Point | None = None  # of the path, when the last frame was taken
        self._last_fix_m: Doubles | None = None  # (2,) from the origin of the path
        self.has_gps = self.is_in_doubt = False
        self.is_confirmed = True
        self._unconfirmed: list[PositionedMatch] = []  # agree with each other; nothing else supports them
        self.last_gps_s = self.last_fix_s = self._last_odometry_s = self._last_query_s = -math.inf
        self._query_interval_s = math.inf
        self._heading_step_s = -math.inf  # when the reported heading last changed without a turn
        self._doubt_m = np.zeros(2)  # error of odometry since the last fix or GPS position, because heights contradict
        self._contradicted_since_s: float | None = None

    @property
    def last_vision_s(self) -> float:
        """Time of the last fix or odometry step; -inf before the first."""
        return max(self.last_fix_s, self._last_odometry_s)

    @property
    def attitude_error_sd(self) -> float:
        """Standard deviation of the reported attitude, as a tangent, measured in images (0: they show no error)."""
        return self._filter.attitude_error_sd

    @property
    def path_velocity_m_s(self) -> Doubles | None:
        """Current velocity (2,) of the path, without corrections from matches; None if unknown."""
        return self._valid_path.now.velocity_m_s if self._valid_path else None

    def is_proven(self, t_s: float) -> bool:
        """Return True if a recent match proves our position."""
        return t_s - self.last_fix_s <= MATCH_PROOF_S

    def is_tracked(self, t_s: float) -> bool:
        """Return True if visual odometry tracks the path without contradiction, and queries are frequent enough that
        several would soon reveal an error of the path."""
        return max(t_s - self._last_odometry_s, self._query_interval_s) <= _MAX_TRACKING_GAP_S

    def add_report(self, vehicle: Vehicle, trusts_gps: bool = True) -> None:
        """Process a report from the autopilot; reports without velocity are ignored. With GPS, if `trusts_gps`, our
        position is corrected by the autopilot's or, for an inertial path, by the receiver's."""
        if vehicle.velocity_m_s is None:
            return
        has_gps = is_gps_aided(vehicle) and trusts_gps
        if self._drift.is_inertial:
            self._correct_by_receiver(vehicle, vehicle.gps if has_gps else None)
        else:
            self._correct_by_estimate(vehicle, has_gps)

    def _correct_by_estimate(self, vehicle: Vehicle, has_gps: bool) -> None:
        had_gps, self.has_gps = self.has_gps, has_gps
        if vehicle.position_sd_m is None:
            self._path = None  # an autopilot without a position has no reliable velocity either
            return
        velocity_m_s, t_s = np.array(vehicle.velocity_m_s), vehicle.t_received_s
        path = self._valid_path
        if path is None:
            position = Position(vehicle.lat_deg, vehicle.lon_deg)
            self._start(Path(position, t_s, velocity_m_s), vehicle.position_sd_m, self._drift.velocity_sd)
            return
        self._filter.predict(path.add_velocity(t_s, velocity_m_s), np.zeros(2))
        if had_gps and not self.has_gps:
            self._filter.lose_gps()
        point = path.interpolate(t_s)
        if point and self.has_gps and t_s - self.last_gps_s >= _GPS_INTERVAL_S:
            self._record_gps(t_s)
            offset_m = path.compute_offset_m(vehicle.lat_deg, vehicle.lon_deg) - point.position_m
            sd_m = _GPS_CORRELATION_FACTOR * (vehicle.position_sd_m or _UNKNOWN_POSITION_SD_M)
            predicted_m, _, _ = self._filter.estimate_errors(path.now.t_s - t_s)
            sd_m = self._compute_gps_sd_m(sd_m, offset_m - predicted_m, vehicle.gps, t_s)
            self._filter.correct_by_gps(offset_m, sd_m, velocity_m_s - point.velocity_m_s, _GPS_VELOCITY_SD_M_S)

    def _correct_by_receiver(self, vehicle: Vehicle, receiver: Receiver | None) -> None:
        """Correct an inertial path by a receiver (None: there is no trusted GPS)."""
        path, had_gps = self._valid_path, self.has_gps
        if path is None:
            self.has_gps = receiver is not None and self._start_at_receiver(receiver, vehicle.t_received_s)
            return
        error = None if receiver is None else self._compare_receiver(path, receiver)
        if receiver is None or error is None:
            self.has_gps = self.is_in_doubt = False
            self._contradicted_since_s = None
            if had_gps:
                self._filter.lose_gps()
            return
        offset_m, sd_m, error_m_s, sd_m_s, age_s = error
        predicted_m, _, covariance = self._filter.estimate_errors(age_s)
        sd_m = self._compute_gps_sd_m(sd_m, offset_m - predicted_m, receiver, vehicle.t_received_s)
        if mahalanobis(offset_m - predicted_m, covariance[:2, :2] + sd_m**2 * np.eye(2)) > _MAX_RECEIVER_SIGMA:
            self._handle_contradiction(receiver, vehicle.t_received_s)
            return
        self.has_gps, self.is_in_doubt, self._contradicted_since_s = True, False, None
        if vehicle.t_received_s - self.last_gps_s >= _GPS_INTERVAL_S:
            self._record_gps(vehicle.t_received_s)
            self._filter.correct_by_gps(offset_m, sd_m, error_m_s, sd_m_s, age_s)

    def _compute_gps_sd_m(self, sd_m: float, difference_m: Doubles, receiver: Receiver | None, now_s: float) -> float:
        """Return the standard deviation to assume for a GPS position that claims `sd_m` and differs from ours (2,)."""
        has_returned = receiver is not None and receiver.steady_for_s < _PROBATION_S
        return max(sd_m, float(np.hypot(*difference_m))) if has_returned and self.is_proven(now_s) else sd_m

    def _handle_contradiction(self, receiver: Receiver, now_s: float) -> None:
        """Process a receiver that contradicts our position: restart there if this persists and no match proves ours."""
        self.has_gps, self.is_in_doubt = False, not self.is_proven(now_s)
        if self._contradicted_since_s is None:
            self._contradicted_since_s = now_s
        contradicted_s = min(receiver.steady_for_s, now_s - self._contradicted_since_s)
        if self.is_in_doubt and contradicted_s >= _GPS_OVERRULES_S:
            self.has_gps = self._start_at_receiver(receiver, now_s)

    def _compare_receiver(
        self, path: Path, receiver: Receiver
    ) -> tuple[Doubles, float, Doubles | None, float, float] | None:
        """Return the offset (2,) from the path to a receiver, its standard deviation, the receiver's velocity minus the
        path's (2,; None: unknown), its standard deviation, and the age of both. None: the path was unknown then."""
        measured_s = receiver.t_s - RECEIVER_LAG_S
        point, before = path.interpolate(measured_s), path.interpolate(measured_s - RECEIVER_LAG_SD_S)
        if point is None or before is None:
            return None
        offset_m = path.compute_offset_m(receiver.lat_deg, receiver.lon_deg) - point.position_m
        speed_m_s = float(np.hypot(*point.velocity_m_s))
        sd_m = math.hypot(_GPS_CORRELATION_FACTOR * receiver.sd_m, RECEIVER_LAG_SD_S * speed_m_s)
        error_m_s = None if receiver.velocity_m_s is None else np.array(receiver.velocity_m_s) - point.velocity_m_s
        # In a turn, an error in the receiver's lag changes its velocity, which would look like an attitude error.
        sd_m_s = math.hypot(_GPS_VELOCITY_SD_M_S, *(point.velocity_m_s - before.velocity_m_s))
        return offset_m, sd_m, error_m_s, sd_m_s, path.now.t_s - measured_s

    def _start_at_receiver(self, receiver: Receiver, now_s: float) -> bool:
        """Start the path at a receiver's position if it is steady; return True if the path was started."""
        if receiver.steady_for_s < _MIN_STEADY_S:
            return False
        velocity_m_s, velocity_sd_m_s = np.zeros(2), _UNKNOWN_VELOCITY_SD_M_S
        if receiver.velocity_m_s is not None:
            velocity_m_s, velocity_sd_m_s = np.array(receiver.velocity_m_s), _GPS_VELOCITY_SD_M_S
        position = Position(*extrapolate(receiver, now_s))
        self._start(Path(position, now_s, velocity_m_s), _GPS_CORRELATION_FACTOR * receiver.sd_m, velocity_sd_m_s)
        self._record_gps(now_s)
        self.is_in_doubt, self._contradicted_since_s = False, None
        return True

    def _record_gps(self, now_s: float) -> None:
        self.last_gps_s, self.is_confirmed, self._doubt_m = now_s, True, np.zeros(2)

    def doubt_heading(self, step_rad: float, t_s: float) -> None:
        """Process a step of the reported heading at `t_s` that the gyros did not measure."""
        self._filter.doubt_heading(step_rad)
        self._heading_step_s = t_s

    def restart_odometry_scale(self, error: float, tolerance: float) -> None:
        self._filter.restart_odometry_scale(error, tolerance)

    def add_acceleration(self, t_s: float, acceleration_m_s2: Doubles) -> None:
        """Process the mean acceleration (2,) over the ground, east and north, since the last call."""
        if not self._drift.is_inertial:
            return
        if path := self._valid_path:
            self._filter.predict(path.add_acceleration(t_s, acceleration_m_s2), acceleration_m_s2)
            return
        if self._unplaced_path is None or self._unplaced_path.is_broken:
            self._unplaced_path = Path(_NOWHERE, t_s, np.zeros(2))
        self._unplaced_path.add_acceleration(t_s, acceleration_m_s2)

    def add_frame(self, frame: FrameMeasurement, is_query: bool = True) -> None:
        """Process a frame, whether it was recognised or not; one that is not a query only provides odometry."""
        if is_query:
            self._query_interval_s, self._last_query_s = frame.t_s - self._last_query_s, frame.t_s
        path, before = self._valid_path, self._frame_point
        self._frame_point = point = path.interpolate(frame.t_s) if path else None
        if path is None or point is None:
            return
        step, path_moved_m = None, np.zeros(2)
        is_of_this_heading = frame.t_s > self._heading_step_s
        if frame.odometry and before and before.t_s == frame.odometry.from_s and is_of_this_heading:
            step, path_moved_m = frame.odometry, point.position_m - before.position_m
            self._doubt_m = self._doubt_m + frame.scale_sd * np.array(step.moved_m)
        age_s = path.now.t_s - frame.t_s
        bend_m = point.position_m - (path.now.position_m - age_s * path.now.velocity_m_s)
        if self._filter.add_frame(age_s, bend_m, frame.attitude_gain_s2, frame.sd_m, step, path_moved_m) and step:
            self._last_odometry_s = frame.t_s

    def predict_fix(self, match: PositionedMatch) -> PredictedFix | None:
        """Predict the fix of a match in the last frame added or a new one; None if the path is unknown at that time."""
        if self._frame_point is None or self._frame_point.t_s != match.t_s:
            self.add_frame(match.frame)
        path, point = self._valid_path, self._frame_point
        if path is None or point is None:
            return None
        predicted_m, covariance_m2 = self._filter.predict_fix()
        point_m = point.position_m
        offset_m = path.compute_offset_m(match.position.lat_deg, match.position.lon_deg) - point_m
        return PredictedFix(
            match=match, path_point_m=point_m, offset_m=offset_m, predicted_m=predicted_m, covariance_m2=covariance_m2
        )

    def correct_by_fix(self, fix: PredictedFix, verdict: GateResult = ACCEPTED) -> None:
        """Correct our position by a fix that `Consistency` has accepted with this verdict."""
        match = fix.match
        if self._path and verdict.restarts_path and self._drift.is_inertial:
            self.start_at_fix(match)
            self.is_confirmed = True
        elif self._path:
            self._judge_support(fix, verdict)
            correct = self._filter.reset_to_fix if verdict.overrules_path else self._filter.correct_by_fix
            correct(fix.offset_m, self._repetition_factor(fix) * match.covariance_m2)
            if match.frame.attitude_gain_s2 and (error := match.attitude_error):
                self._filter.correct_by_attitude_error(np.array(error.nadir_shift), error.sd)
            if match.heading_error_deg is not None and match.t_s > self._heading_step_s:
                self._filter.correct_by_rotation(math.radians(match.heading_error_deg))
            self.last_fix_s, self._doubt_m = max(self.last_fix_s, match.t_s), np.zeros(2)

    def _judge_support(self, fix: PredictedFix, verdict: GateResult) -> None:
        """Update `is_confirmed` with an accepted fix."""
        predicted_sd_m, match = compute_worst_sd(fix.covariance_m2), fix.match
        agrees = min(predicted_sd_m, float(np.hypot(*fix.innovation_m)) / 2) <= _MAX_PROVING_SD_M
        agrees |= predicted_sd_m <= compute_worst_sd(match.scatter_m2)
        agrees &= predicted_sd_m < _UNKNOWN_POSITION_SD_M / 2  # otherwise the path starts at this match
        self._unconfirmed = [*self._unconfirmed, match] if agrees and not self.is_confirmed else [match]
        is_supported = agrees and (self.is_confirmed or confirm_each_other(self._unconfirmed))
        self.is_confirmed = verdict.overrules_path or is_supported

    def _repetition_factor(self, fix: PredictedFix) -> float:
        """Return the factor for the covariance of a fix: the closer it is to the last fix, the more of its error is
        repeated. It is 1 without odometry, because only odometry propagates the last fix."""
        fix_m, last_fix_m = fix.path_point_m + fix.offset_m, self._last_fix_m
        self._last_fix_m = fix_m
        length_m = fix.match.frame.correlation_length_m
        if fix.match.frame.odometry is None or last_fix_m is None or length_m == 0:
            return 1.0
        distance_m = float(np.hypot(*(fix_m - last_fix_m)))
        return max(1.0, length_m / max(distance_m, length_m / _MAX_REPETITION_FACTOR))

    def start_at_fix(self, match: PositionedMatch) -> None:
        """Start the path at a match, when neither position nor velocity is known. Only an inertial path can start so,
        and only if accelerations are known since the frame was taken: the next frame may have been taken already."""
        known_path = self._valid_path or self._unplaced_path
        path = known_path.restart(match.position, match.t_s) if known_path else None
        if path is None:
            return
        self._start(path, _UNKNOWN_POSITION_SD_M, _UNKNOWN_VELOCITY_SD_M_S)
        age_s = path.now.t_s - match.t_s
        self._filter.predict(age_s, path.now.velocity_m_s / age_s if age_s else np.zeros(2))
        self.add_frame(match.frame, is_query=False)  # its query is counted already
        if fix := self.predict_fix(match):
            self.correct_by_fix(fix)

    def estimate_state(self, t_s: float) -> NavState | None:
        """Return position and velocity at `t_s`, now or in the last seconds; None if unknown."""
        path = self._valid_path
        point = path.interpolate(t_s) if path else None
        if path is None or point is None:
            return None
        error_m, error_m_s, covariance = self._filter.estimate_errors(path.now.t_s - t_s)
        position_m = point.position_m + error_m
        velocity_m_s = point.velocity_m_s + error_m_s
        return NavState(
            t_s=t_s,
            position=move_position(path.origin, *position_m.tolist()),
            velocity_m_s=(float(velocity_m_s[0]), float(velocity_m_s[1])),
            accuracy_m=math.hypot(compute_worst_sd(covariance[:2, :2]), *self._doubt_m),
            speed_accuracy_m_s=compute_worst_sd(covariance[2:, 2:]),
        )

    def path_drift_m_s(self) -> tuple[float, float]:
        """Return the velocity (east, north) of the aircraft minus that of its path."""
        _, error_m_s, _ = self._filter.estimate_errors(0.0)
        return float(error_m_s[0]), float(error_m_s[1])

    def _start(self, path: Path, sd_m: float, velocity_sd_m_s: float) -> None:
        self._path, self._unplaced_path = path, None
        self._frame_point = self._last_fix_m = None
        self._filter.start(sd_m, velocity_sd_m_s)

    @property
    def _valid_path(self) -> Path | None:
        return self._path if self._path and not self._path.is_broken else None


def is_gps_aided(vehicle: Vehicle) -> bool:
    """Return True if the autopilot's position is based on GPS: a receiver near it has a fix, and does not repeat it."""
    return vehicle.has_gps and vehicle.gps is not None and vehicle.gps.age_at_report_s <= MAX_FIX_AGE_S
