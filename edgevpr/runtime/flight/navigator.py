"""Decides which positions to send to the autopilot, given the vehicle's motion from the link and the matches from the
loop: through a continuous channel (GPS_INPUT, ODOMETRY) a position many times a second, otherwise single fixes.
The link calls it in its own thread, the loop of `flight` (through `autopilot`) in the main one, each within a turn
(`mavlink/turns.py`), so it needs no lock."""

import math
from dataclasses import dataclass, replace

from edgevpr.core.geodesy import distance_m, offset_between_m, offset_position
from edgevpr.core.reasons import Reason, ReasonCode
from edgevpr.core.types import Vehicle
from edgevpr.mavlink.channel import Channel
from edgevpr.mavlink.conversation import INTERIM_FIX_INTERVAL_S
from edgevpr.mavlink.messages import Fix, MotionState
from edgevpr.mavlink.peer import Listener
from edgevpr.mavlink.receivers import MAX_PLAUSIBLE_SD_M
from edgevpr.mavlink.vehicle import Attitude
from edgevpr.runtime.flight.agewatch import DEAD_RECKONING_ERROR, GPS_ERROR, PX4_INERTIAL_ERROR, AgeWatch, VelocityError
from edgevpr.runtime.flight.consistency import Consistency, can_follow, confirm_each_other
from edgevpr.runtime.flight.drift import DEAD_RECKONING, GRAVITY_M_S2, INERTIAL, INERTIAL_PX4, Drift
from edgevpr.runtime.flight.measurements import (
    FrameMeasurement,
    PositionedMatch,
    compute_reported_accuracy_m,
    compute_time_error_m,
    measure_frame,
    position_match,
)
from edgevpr.runtime.flight.navigation import Navigation, NavState, is_gps_aided
from edgevpr.runtime.flight.output import Output, OutputWatch
from edgevpr.runtime.flight.path import to_ground_acceleration
from edgevpr.runtime.flight.slew import Slew
from edgevpr.runtime.recognise.recognition import Recognition

_MAX_ERROR_M = 50.0  # a position with a larger error is not sent
# An ArduPilot plane follows positions of any claimed error: over ground 1.4 times as far below it strayed 84 m.
_MAX_CONTINUOUS_ERROR_M = 25.0
# Nor is a continuous one of unknown velocity: at 13 m/s it fell 40 m behind, and took 15 s to catch up without a jump.
_MAX_SPEED_ERROR_M_S = 6.0  # unknown: 10; in a hover by poor gyros, without a measured tilt: up to 3
# A match that is farther away than the way flown in this time is not of a late image, but of another place.
_MAX_DELAY_S = 10.0
_MIN_SPEED_M_S = 10.0
_MAX_INTERIM_S = 60.0  # single fixes without a match are sent for this long after the last match, odometry or GPS
# From accelerations alone we know no more than the autopilot, which has them too, and dead-reckons for some seconds
# itself. So a continuous position ends this long after the last picture with a match or odometry or, until there is
# one, this long after GPS. Positions sent for ten seconds led an ArduPilot copter whose camera froze 31 m away, and a
# PX4 copter 70 m.
_MAX_BLIND_S = 5.0
_MAX_SINCE_GPS_S = 3.0
_ALT_SD_M = 3.0
# Odometry is corrected if its scale differs by more from the height of one match, or from the median of three.
_MATCH_SCALE_TOLERANCE = 0.15
_SCALE_TOLERANCE = 0.02
# An autopilot treats the ten positions of a second as independent. Their errors are correlated for about five seconds:
# fifty of them carry the information of one, so the claimed error is multiplied by this. Without it, they outweighed
# the gyros: an ArduPilot copter tilted with our errors, which made our errors larger, and was lost after a minute. A
# smaller factor would be closer to the true error, but makes the loop unstable: benchmarks/results/loop.md.
CORRELATION_FACTOR = math.sqrt(50)
PX4_CORRELATION_FACTOR = 1.0  # while our errors do not follow from its own: then its loop is stable with any
_ATTITUDE_ERROR_VALID_S = 5.0
_PX4_CHANNELS = Channel.SENSOR, Channel.VISION
# PX4 refuses positions that are farther from its own than three (EKF2_AGP0_GATE) of the claimed and its own standard
# deviations together, and flies on without them for 7 s: after a gap of 3 s, in which it had drifted by 20 m, a copter
# strayed 53 m. So a position that matches prove claims, up to this distance, at least so much that PX4 uses it.
_PX4_GATE_SIGMA = 2.5
_MAX_PX4_DISTANCE_M = 40.0
# Between these two times after a lost receiver has become steady, "no fix" is sent as GPS_INPUT, so
# that ArduPilot returns to its receiver at once (AP_GPS::update_primary).
_GPS_BACK_FROM_S = 1.0
_GPS_BACK_UNTIL_S = 3.0
_REPORT_TIMEOUT_S = 5.0


@dataclass(frozen=True, slots=True)
class Advice:
    """Advice on an accepted match: the `fix` to send or, if None, the reason `why` not. `is_held`: the fix is held back
    because it contradicts the predicted position."""

    fix: Fix | None
    why: Reason | None = None
    is_held: bool = False


def _withhold(code: ReasonCode) -> Advice:
    return Advice(None, Reason(code))


class Navigator(Listener):
    """Navigates for one autopilot: estimates the aircraft's position, and decides what to send. `map_sd_m` is the
    standard deviation of the error common to all fixes, `interval_s` the time between queries. With `is_muted`,
    in a dry run, it only gives advice. `is_level`: the camera is on a gimbal and stays level at any attitude.
    `shows_tilt`: False if errors of the attitude move positions, but pictures of an unknown lens do not show them.
    `age` estimates the hidden delay of the pictures from the reported motion."""

    def __init__(
        self,
        map_sd_m: float,
        interval_s: float,
        is_muted: bool = False,
        *,
        is_level: bool = False,
        shows_tilt: bool = True,
    ) -> None:
        self._is_muted, self._is_level, self._shows_tilt = is_muted, is_level, shows_tilt
        self._map_sd_m, self._fix_interval_s = map_sd_m, min(interval_s, INTERIM_FIX_INTERVAL_S)
        self._navigation = Navigation(DEAD_RECKONING, map_sd_m)
        self._consistency, self.age = Consistency(), AgeWatch()
        self._slew = Slew()
        self._vehicle: Vehicle | None = None
        self._attitude: Attitude | None = None
        self._autopilot_since_s = self._attitude_error_s = self._no_position_s = -math.inf
        self._channel, self._trusts_gps, self._distrusts_map = Channel.COMMAND, True, False
        self.output = Output.STARTING  # what a continuous channel carries
        self._watch = OutputWatch()
        self._unconfirmed: list[PositionedMatch] = []  # successive matches that nothing predicted
        self._height_ratio = 1.0
        self._resolved_doubt_m = self._resolved_step_m = 0.0  # differences of height that matches have resolved
        # Standard deviation of the error common to the last fixes, and its part that is due to a tilt of the camera.
        self._shared_sd_m, self._common_tilt_m = map_sd_m, 0.0

    @property
    def has_gps(self) -> bool:
        """True if the autopilot's position is based on a trusted GPS."""
        return self._navigation.has_gps

    def trust_gps(self, is_trusted: bool) -> None:
        """Set whether GPS is used for navigation."""
        self._trusts_gps = is_trusted

    def distrust_map(self, is_distrusted: bool) -> None:
        """Set whether the map has contradicted GPS since the first match. One of them is wrong, and it is unknown
        which: no position is sent, even after GPS is lost."""
        self._distrusts_map = is_distrusted

    def trusts_gps(self) -> bool:
        return self._trusts_gps

    def correct_height(self, ratio: float) -> None:
        """Set the ratio of visual height to the autopilot's height above ground (1.0: about equal). Odometry is scaled
        by it, and contradictions between the sources of the autopilot's height so far are resolved."""
        if ratio != 1.0:
            self._navigation.restart_odometry_scale(ratio - 1.0, _SCALE_TOLERANCE)
        self._height_ratio = ratio
        if self._vehicle:
            self._resolved_doubt_m = self._vehicle.height_doubt_m
            self._resolved_step_m = self._vehicle.height_step_m

    def handle_channel(self, channel: Channel) -> None:
        """Set the channel through which positions are sent. With a continuous one, the autopilot's velocity comes from
        our positions and must not be used: the path is then integrated from accelerations."""
        old_channel, self._channel = self._channel, channel
        if _choose_drift(channel) is not _choose_drift(old_channel):
            self.reset_navigation()

    def reset_navigation(self) -> None:
        """Restart at the autopilot's position, because later fixes have different errors from earlier ones."""
        self._navigation, self._consistency = Navigation(_choose_drift(self._channel), self._map_sd_m), Consistency()
        self._watch = OutputWatch()

    def handle_autopilot(self, t_s: float) -> None:
        """Process the first message of an autopilot, or of its replacement, at `t_s`."""
        self._autopilot_since_s, self._vehicle, self._resolved_step_m = t_s, None, 0.0

    def handle_no_position(self, t_s: float) -> None:
        """Process a report that the autopilot has no position."""
        self._no_position_s = t_s

    def handle_vehicle(self, vehicle: Vehicle) -> None:
        """Process a report of position and velocity."""
        navigation = self._navigation
        if self._vehicle and vehicle.heading_step_deg > self._vehicle.heading_step_deg:
            step_deg = vehicle.heading_step_deg - self._vehicle.heading_step_deg
            navigation.doubt_heading(math.radians(step_deg), vehicle.t_received_s)
        self._vehicle = vehicle
        navigation.add_report(vehicle, self._trusts_gps)
        if navigation.has_gps:
            self._consistency.trust_path(vehicle.t_received_s)
        self._watch.update(vehicle, navigation.last_fix_s, navigation.has_gps)
        if navigation.path_velocity_m_s is not None:
            velocity_m_s, error = navigation.path_velocity_m_s, self._choose_velocity_error()
            self.age.add_motion(vehicle.t_received_s, velocity_m_s, vehicle.heading_deg, error)

    def handle_specific_force(self, t_s: float, force_m_s2: tuple[float, float, float], attitude: Attitude) -> None:
        """Process the specific force that the accelerometers measure, m/s2 (forward, right, down), and the attitude."""
        acceleration_m_s2 = to_ground_acceleration(force_m_s2, attitude.roll_deg, attitude.pitch_deg, attitude.yaw_deg)
        self._attitude = attitude
        self._navigation.add_acceleration(t_s, acceleration_m_s2)

    def handle_frame(self, event: Recognition, is_query: bool = True) -> None:
        """Process the frame of an event without an accepted match, or one that only provides odometry (not a query).
        Odometry between frames of unknown age is of an unknown time, so they are not used."""
        if not self.age.is_unknown and (frame := self._measure(event)):
            self._navigation.add_frame(frame, is_query)

    def is_out_of_reach(self, event: Recognition) -> bool:
        """Return True if a match is so far from our position that no delay of its image explains it: it is wrong."""
        estimate = self._estimate_state(event.frame.t_mono_s) if event.frame else None
        if estimate is None or event.located is None or not self._navigation.is_confirmed:
            return False
        way_m = _MAX_DELAY_S * max(_MIN_SPEED_M_S, math.hypot(*estimate.velocity_m_s))
        away_m = math.hypot(*offset_between_m(estimate.position, event.located.position))
        return away_m > way_m + 4 * (estimate.accuracy_m + event.located.accuracy_m)

    def report_accuracy(self, event: Recognition) -> Recognition:
        """Return an event with the accuracy of its match in flight, which includes the errors of attitude and time."""
        frame, vehicle = self._measure(event), event.vehicle or self._vehicle
        if frame is None or vehicle is None or event.located is None:
            return event
        match_m, height_m = max(self._map_sd_m, event.located.accuracy_m), frame.attitude_gain_s2 * GRAVITY_M_S2
        accuracy_m = compute_reported_accuracy_m(match_m, event, vehicle, height_m, self._navigation.attitude_error_sd)
        return replace(event, accuracy_m=accuracy_m)

    def advise(self, event: Recognition, now_s: float) -> Advice:
        """Process an accepted match, and advise what to send for it. Raises ValueError for an invalid position."""
        frame = self._measure(event)
        match = position_match(event, frame) if frame else None
        if match is None:
            return _withhold(ReasonCode.PLACE_WITHOUT_POSITION)
        if event.view.reason:
            return _withhold(ReasonCode.NOT_BELOW_AIRCRAFT)
        vehicle, time_error_m = self._vehicle, compute_time_error_m(event, event.vehicle or self._vehicle)
        accuracy_m = math.hypot(match.accuracy_m, time_error_m)
        fix = Fix(match.position.lat_deg, match.position.lon_deg, accuracy_m, match.t_s)
        if vehicle is None or not vehicle.is_fresh(now_s):
            return self._advise_without_report(fix, match, now_s)
        if vehicle.velocity_m_s is None:
            return _withhold(ReasonCode.NO_TELEMETRY)
        predicted = self._navigation.predict_fix(match)
        if predicted is None:
            if self._navigation.path_velocity_m_s is not None:  # the frame is older than the path: nothing to compare
                return _withhold(ReasonCode.CONTINUOUS if self._channel.is_continuous else ReasonCode.NO_TELEMETRY)
            self._navigation.start_at_fix(match)
            self._correct_scale(event, vehicle)
            return _withhold(ReasonCode.CONTINUOUS) if self._channel.is_continuous else self._confirm(fix, match)
        verdict = self._consistency.judge(predicted, self.has_gps, self._navigation.is_tracked(match.t_s))
        if verdict.reason:
            return Advice(None, verdict.reason, is_held=True)
        self._navigation.correct_by_fix(predicted, verdict)
        self._correct_scale(event, vehicle)
        located = event.located
        self._common_tilt_m = located.common_tilt_m if located else 0.0
        self._shared_sd_m = math.hypot(self._map_sd_m, time_error_m, self._common_tilt_m)
        if match.attitude_error:
            self._attitude_error_s = match.t_s
        return self._advise_improvement(vehicle, vehicle.velocity_m_s, now_s)

    def make_interim_fix(self, now_s: float) -> Fix | None:
        """Return a fix predicted from earlier matches, for times without accepted matches; None if it would not
        improve the autopilot's position, or the last match contradicts the prediction."""
        vehicle = self._vehicle
        if self._is_muted or self._channel is not Channel.COMMAND or self.age.is_unknown:
            return None
        if self._consistency.is_contradicted(now_s, self._navigation.is_tracked(now_s)):
            return None
        if vehicle is None or vehicle.velocity_m_s is None or not vehicle.is_fresh(now_s):
            return None
        if _may_use_gps(vehicle) or self._estimate(now_s) is None:
            return None
        return self._advise_improvement(vehicle, vehicle.velocity_m_s, now_s).fix

    def knows_position(self, now_s: float) -> bool:
        """Return True if the position is accurate enough for a continuous channel."""
        return self._estimate(now_s) is not None

    def accuracy_m(self, now_s: float) -> float | None:
        """Return the accuracy of the position: metres, standard deviation of one axis (None: position unknown)."""
        estimate = self._estimate_state(now_s)
        if estimate is None or not self._navigation.is_confirmed:
            return None
        return self._compute_claimed_m(estimate)

    def estimate_state(self, t_s: float) -> MotionState | None:
        """Return position and motion at `t_s` for a continuous channel; None if they are not accurate enough. `t_s`
        must be later than in the last call."""
        if self._is_muted:
            return None
        vehicle, estimate = self._vehicle, self._estimate(t_s)
        self.output = self._next_output(vehicle, estimate)
        if estimate is None or vehicle is None or not self.output.is_sent:
            self._slew.reset()
            return None
        self._watch.record_sent(t_s)
        lat_deg, lon_deg, lag_m = self._slew.follow(estimate)
        east, north = estimate.velocity_m_s
        attitude, factor = self._attitude, self._correlation_factor(vehicle, t_s)
        accuracy_m = factor * math.hypot(self._compute_claimed_m(estimate), lag_m)
        is_fallback, receiver = self.output is Output.RESERVE, vehicle.gps
        return MotionState(
            t_mono_s=t_s,
            lat_deg=lat_deg,
            lon_deg=lon_deg,
            # The autopilot's own altitude may come from us, so with a receiver its altitude is sent.
            alt_m=receiver.alt_m if is_fallback and receiver and receiver.alt_m is not None else vehicle.alt_m,
            velocity_m_s=(east, north, vehicle.sink_m_s or 0.0),
            accuracy_m=max(accuracy_m, self._compute_usable_accuracy_m(vehicle, lat_deg, lon_deg, t_s)),
            alt_accuracy_m=_ALT_SD_M,
            speed_accuracy_m_s=factor * estimate.speed_accuracy_m_s,
            attitude=None if attitude is None else _to_radians(attitude),
            is_fallback=is_fallback,
        )

    def _next_output(self, vehicle: Vehicle | None, estimate: NavState | None) -> Output:
        """Decide what to send now."""
        if vehicle is None:
            return Output.STARTING
        # PX4's attitude follows our positions: if pictures do not show its errors, these grow (a copter was 80 m away).
        if self._channel in _PX4_CHANNELS and not self._shows_tilt:
            return Output.NO_LENS
        if vehicle.reaches_another:
            return Output.LINK_SHARED
        uses_gps = _may_use_gps(vehicle)
        if uses_gps and not self._channel.works_with_gps:
            return Output.GPS_IN_USE
        if estimate is None:
            return Output.STARTING if self.output is Output.STARTING else Output.UNKNOWN
        if self._navigation.is_in_doubt or self._distrusts_map:
            return Output.CONTRADICTS_GPS
        if self._watch.withdrawn:
            return self._watch.withdrawn
        receiver = vehicle.gps if uses_gps else None
        if not uses_gps or (receiver and receiver.sd_m > MAX_PLAUSIBLE_SD_M):
            return Output.SENDING
        if self._channel is not Channel.GPS_INPUT:
            return Output.BESIDE_GPS
        was_lost = self.output in (Output.SENDING, Output.GPS_BACK)
        if was_lost and receiver and receiver.steady_for_s < _GPS_BACK_UNTIL_S:
            return Output.GPS_BACK if receiver.steady_for_s >= _GPS_BACK_FROM_S else Output.SENDING
        return Output.RESERVE

    def _choose_velocity_error(self) -> VelocityError:
        has_gps, is_continuous = self._navigation.has_gps, self._channel.is_continuous
        if self._channel in _PX4_CHANNELS and not has_gps:
            return PX4_INERTIAL_ERROR
        return GPS_ERROR if has_gps and not is_continuous else DEAD_RECKONING_ERROR

    def _advise_without_report(self, fix: Fix, match: PositionedMatch, now_s: float) -> Advice:
        """Advise on a fix without a recent report of a position: only an autopilot that reports that it has none gets
        it, once other matches confirm it, because nothing else can show that the match is wrong."""
        since_s = max(self._autopilot_since_s, self._vehicle.t_received_s if self._vehicle else -math.inf)
        has_none = now_s - self._no_position_s <= _REPORT_TIMEOUT_S < now_s - since_s
        is_wanted = has_none and not self._channel.is_continuous
        return self._confirm(fix, match) if is_wanted else _withhold(ReasonCode.NO_TELEMETRY)

    def _confirm(self, fix: Fix, match: PositionedMatch) -> Advice:
        """Advise on the fix of a match that nothing predicts: hold it back until others, within reach, agree."""
        if self._unconfirmed and not can_follow(self._unconfirmed[-1], match):
            self._unconfirmed = []
        self._unconfirmed = [*self._unconfirmed[-3:], match]  # four are enough
        if confirm_each_other(self._unconfirmed):
            return Advice(fix)
        return Advice(None, Reason(ReasonCode.HELD_UNCONFIRMED), is_held=True)

    def _correct_scale(self, event: Recognition, vehicle: Vehicle) -> None:
        """Correct the scale of odometry by the height that the accepted match of an event shows."""
        located, reported_m = event.located, (event.vehicle or vehicle).height_m
        if located and located.height_m and reported_m and reported_m > 0:
            self._navigation.restart_odometry_scale(located.height_m / reported_m - 1.0, _MATCH_SCALE_TOLERANCE)

    def _measure(self, event: Recognition) -> FrameMeasurement | None:
        vehicle = event.vehicle or self._vehicle
        doubt = 0.0
        if vehicle and vehicle.height_m and vehicle.height_m > 0:
            step_m = abs(vehicle.height_step_m - self._resolved_step_m)
            doubt = max(vehicle.height_doubt_m - self._resolved_doubt_m, step_m) / vehicle.height_m
        ratio = self._height_ratio
        return measure_frame(event, vehicle, is_level=self._is_level, height_ratio=ratio, height_doubt=doubt)

    def _estimate_state(self, t_s: float) -> NavState | None:
        """Return position and velocity at `t_s`; None if unknown. While two positions are possible, their distance is
        included in the accuracy."""
        estimate, doubt_m = self._navigation.estimate_state(t_s), self._consistency.doubt_m
        return estimate and replace(estimate, accuracy_m=math.hypot(estimate.accuracy_m, doubt_m))

    def _estimate(self, t_s: float) -> NavState | None:
        estimate = self._estimate_state(t_s)
        max_error_m = _MAX_CONTINUOUS_ERROR_M if self._channel.is_continuous else _MAX_ERROR_M
        if estimate is None or self._compute_accuracy_m(estimate) > max_error_m:
            return None
        last_vision_s, last_gps_s = self._navigation.last_vision_s, self._navigation.last_gps_s
        if self._channel.is_continuous:
            # A channel used with GPS was sending before GPS was lost, and continues without a gap. PX4's starts now.
            is_gps_recent = self._channel.works_with_gps and t_s - last_gps_s <= _MAX_SINCE_GPS_S
            is_known = t_s - last_vision_s <= _MAX_BLIND_S or is_gps_recent
            is_known &= self._navigation.is_confirmed and estimate.speed_accuracy_m_s <= _MAX_SPEED_ERROR_M_S
        else:
            is_known = t_s - max(last_vision_s, last_gps_s) <= _MAX_INTERIM_S
        return estimate if is_known else None

    def _advise_improvement(self, vehicle: Vehicle, velocity_m_s: tuple[float, float], now_s: float) -> Advice:
        """Advise what to send to an autopilot that reports a position of its own: a fix only if ours is better."""
        if self._channel.is_continuous:
            return _withhold(ReasonCode.CONTINUOUS)
        if _may_use_gps(vehicle):  # ArduPilot then refuses a fix, and PX4's velocity jumps by its gain
            return _withhold(ReasonCode.HAS_GPS if self._trusts_gps else ReasonCode.HAS_WRONG_GPS)
        if self._distrusts_map:
            return _withhold(ReasonCode.MAP_CONTRADICTS_GPS)
        estimate = self._estimate_state(now_s)
        if estimate is None:
            return _withhold(ReasonCode.NO_TELEMETRY)
        if not self._navigation.is_confirmed:
            return Advice(None, Reason(ReasonCode.HELD_UNCONFIRMED), is_held=True)
        position, claimed_m = estimate.position, self._compute_claimed_m(estimate)
        east_m_s, north_m_s = velocity_m_s
        age_s = now_s - vehicle.t_received_s
        autopilot_deg = offset_position(vehicle.lat_deg, vehicle.lon_deg, age_s * east_m_s, age_s * north_m_s)
        error_m = float(distance_m(*autopilot_deg, position.lat_deg, position.lon_deg))
        # Mean square errors: our estimate's is 2 * accuracy_m**2 (two axes), the autopilot's is larger by error_m**2.
        accuracy_m = self._compute_accuracy_m(estimate)
        if error_m**2 <= 2 * accuracy_m**2:
            figures = {"distance_m": error_m, "accuracy_m": accuracy_m}
            return Advice(None, Reason(ReasonCode.NOT_BETTER, figures))
        # Lead by the drift of half the time to the next fix, so that the autopilot is correct halfway. Now it
        # is wrong by this lead, in one direction: half of its square is added to the variance of each axis.
        lead_m = [self._fix_interval_s / 2 * drift_m_s for drift_m_s in self._navigation.path_drift_m_s()]
        sent_deg = offset_position(position.lat_deg, position.lon_deg, *lead_m)
        return Advice(Fix(*sent_deg, math.hypot(claimed_m, math.hypot(*lead_m) / math.sqrt(2)), now_s))

    def _correlation_factor(self, vehicle: Vehicle, t_s: float) -> float:
        """Return the factor for the claimed errors of a continuous position. For PX4 it is 1 while pictures measure its
        attitude error, or need no attitude: then our positions do not feed back into our own errors. Nor do they while
        the autopilot has no position; ArduPilot then needs claims below 5 m and 1 m/s for ten seconds."""
        if not vehicle.has_position:
            return 1.0
        is_independent = self._is_level or t_s - self._attitude_error_s <= _ATTITUDE_ERROR_VALID_S
        return PX4_CORRELATION_FACTOR if self._channel in _PX4_CHANNELS and is_independent else CORRELATION_FACTOR

    def _compute_usable_accuracy_m(self, vehicle: Vehicle, lat_deg: float, lon_deg: float, t_s: float) -> float:
        """Return the smallest accuracy with which PX4 uses a position that matches prove; 0 if it need not."""
        if self._channel is not Channel.SENSOR or not self._navigation.is_proven(t_s):
            return 0.0
        away_m = float(distance_m(lat_deg, lon_deg, vehicle.lat_deg, vehicle.lon_deg))
        return away_m / _PX4_GATE_SIGMA if away_m <= _MAX_PX4_DISTANCE_M else 0.0

    def _compute_accuracy_m(self, estimate: NavState) -> float:
        """Return the accuracy of an estimate: not better than a camera tilt allows, which no filter averages out."""
        return max(estimate.accuracy_m, self._common_tilt_m)

    def _compute_claimed_m(self, estimate: NavState) -> float:
        """Return the accuracy to claim for an estimate: never better than the error common to all fixes."""
        return max(self._shared_sd_m, estimate.accuracy_m)


def _may_use_gps(vehicle: Vehicle) -> bool:
    """Return True unless the autopilot's reports show that it has lost GPS."""
    return is_gps_aided(vehicle) or vehicle.gps_is_silent


def _choose_drift(channel: Channel) -> Drift:
    """Return the path errors for an autopilot that receives positions through a channel."""
    if channel in _PX4_CHANNELS:
        return INERTIAL_PX4
    return INERTIAL if channel.is_continuous else DEAD_RECKONING


def _to_radians(attitude: Attitude) -> tuple[float, float, float]:
    return math.radians(attitude.roll_deg), math.radians(attitude.pitch_deg), math.radians(attitude.yaw_deg)
