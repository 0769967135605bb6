"""Measurements of the aircraft's position from a frame and its match, with their errors. Attitude and time errors are
modelled only here. `navigator`, `survey` and `gpswatch` use it."""

import math
from dataclasses import dataclass

import numpy as np

from edgevpr.core.arrays import Doubles
from edgevpr.core.geodesy import wrap_deg
from edgevpr.core.types import FRAME_TIME_SD_S, Position, Vehicle
from edgevpr.frames.level import REPORTED_TILT_SD
from edgevpr.runtime.flight.drift import GRAVITY_M_S2
from edgevpr.runtime.recognise.locate import covariance_matrix
from edgevpr.runtime.recognise.odometry import OdometryStep
from edgevpr.runtime.recognise.perspective import AttitudeError
from edgevpr.runtime.recognise.recognition import Recognition

# Standard deviation of a reported attitude, as a tangent: half a degree, which a filter averages over many frames. The
# GPS watch allows twice as much (REPORTED_TILT_SD): after a false alarm GPS is not used, and successive matches in one
# turn have the same error.
ATTITUDE_SD = math.tan(math.radians(0.5))
RECEIVER_LAG_SD_S = 0.1  # standard deviation of a receiver's lag, whose mean is `receivers.RECEIVER_LAG_S`
_UNKNOWN_ATTITUDE_SD = math.tan(math.radians(15.0))  # without a reported attitude: a turning aircraft banks
MIN_HEIGHT_M = 1.0  # lower heights, as on the ground or below the take-off point, are raised to this
_UNKNOWN_SPEED_M_S = 15.0  # assumed if the aircraft reports none
_CORRELATION_LENGTH = 0.25  # of the footprint: closer fixes have common errors due to changed ground
_MAX_HEADING_CHANGE_DEG = 45.0  # largest change of the compass error between two fixes


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameMeasurement:
    """A frame taken at `t_s`. `sd_m`: standard deviation of its position on each axis, without the error that an
    attitude error causes through `attitude_gain_s2` (see `DriftFilter`). `odometry`: motion since the previous frame
    (None: unknown); `scale_sd`: error of its scale, where heights contradict each other. `correlation_length_m`: closer
    fixes of two frames have common errors."""

    t_s: float
    sd_m: float
    attitude_gain_s2: float = 0.0
    odometry: OdometryStep | None = None
    scale_sd: float = 0.0
    correlation_length_m: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class PositionedMatch:
    """An accepted match with a position. `frame`: its frame; `position`: the aircraft's position at that time;
    `accuracy_m`: the accuracy to send; `covariance_m2` (2, 2): without the frame's error and that common to all fixes;
    `places`: numbers of the matched places; `attitude_error`: measured in the picture (None: unknown);
    `heading_error_deg`: the heading measured in the picture minus the autopilot's (None: unknown)."""

    frame: FrameMeasurement
    position: Position
    accuracy_m: float
    covariance_m2: Doubles
    places: tuple[int, ...]
    attitude_error: AttitudeError | None = None
    heading_error_deg: float | None = None

    @property
    def t_s(self) -> float:
        """Time of the frame."""
        return self.frame.t_s

    @property
    def scatter_m2(self) -> Doubles:
        """Covariance (2, 2) without the error common to all fixes."""
        return self.covariance_m2 + self.frame.sd_m**2 * np.eye(2)

    def shares_no_place_with(self, other: "PositionedMatch") -> bool:
        """Return True if the two matches have no place in common."""
        return set(self.places).isdisjoint(other.places)

    def heading_agrees_with(self, heading_error_deg: float | None) -> bool:
        """Return True if the compass error here is also about `heading_error_deg`, or if either is unknown."""
        if self.heading_error_deg is None or heading_error_deg is None:
            return True
        return abs(wrap_deg(self.heading_error_deg - heading_error_deg)) <= _MAX_HEADING_CHANGE_DEG


def measure_frame(
    event: Recognition, vehicle: Vehicle | None, *, is_level: bool, height_ratio: float, height_doubt: float
) -> FrameMeasurement | None:
    """Return the measurement of an event's frame; None if the frame could not be read. `is_level`: the camera is
    on a gimbal; `height_ratio`: visual height divided by the reported one, whose relative error is `height_doubt`.

    An attitude error does not affect a camera on a gimbal, nor a picture for which no attitude was used. A time error
    shifts the nadir by the aircraft's motion and roll.
    """
    if event.frame is None:
        return None
    height_m, has_attitude, sd_m = 0.0, False, 0.0
    if vehicle:
        height_m, has_attitude = 0.0, vehicle.roll_deg is not None
        if vehicle.height_m is not None:
            height_m = height_ratio * max(MIN_HEIGHT_M, vehicle.height_m)
        sweep_m_s = height_m * math.radians(0.0 if is_level else vehicle.tilt_rate_deg_s)
        attitude_sd = ATTITUDE_SD if has_attitude else _UNKNOWN_ATTITUDE_SD
        sd_m = compute_picture_error_m(vehicle, height_m, event.frame.t_sd_s, attitude_sd, sweep_m_s)
    is_unaffected = is_level or not has_attitude or not (event.view.nadir_offset or event.view.nadir_offset_m)
    return FrameMeasurement(
        t_s=event.frame.t_mono_s,
        sd_m=sd_m,
        attitude_gain_s2=0.0 if is_unaffected else height_m / GRAVITY_M_S2,
        odometry=event.odometry,
        scale_sd=height_ratio * height_doubt,
        correlation_length_m=_CORRELATION_LENGTH * (event.view.footprint_m or 0.0),
    )


def measure_for_gps(event: Recognition, vehicle: Vehicle) -> PositionedMatch | None:
    """Return the match of an event, with the errors of a comparison with a GPS receiver; None without a match."""
    if event.frame is None:
        return None
    t_sd_s = math.hypot(RECEIVER_LAG_SD_S, event.frame.t_sd_s)
    sd_m = compute_picture_error_m(vehicle, vehicle.height_m or 0.0, t_sd_s, REPORTED_TILT_SD)
    return position_match(event, FrameMeasurement(t_s=event.frame.t_mono_s, sd_m=sd_m))


def compute_picture_error_m(
    vehicle: Vehicle, height_m: float, t_sd_s: float, attitude_sd: float = ATTITUDE_SD, sweep_m_s: float = 0.0
) -> float:
    """Return the standard deviation (metres, of one axis) of a position from a picture. `t_sd_s` is that of its time,
    `sweep_m_s` the speed at which rolling sweeps the camera over the ground."""
    speed_m_s = math.hypot(sweep_m_s, *(vehicle.velocity_m_s or (0.0, 0.0)))
    return math.hypot(attitude_sd * height_m, t_sd_s * speed_m_s)


def compute_reported_accuracy_m(
    match_m: float, event: Recognition, vehicle: Vehicle, height_m: float, attitude_sd: float
) -> float:
    """Return the accuracy (metres) to report for the match of an event: that of match and map (`match_m`) combined with
    the errors of the attitude (`attitude_sd`, a tangent; no effect at `height_m` 0) and of the frame's time."""
    t_sd_s, sweep_m_s = event.frame.t_sd_s if event.frame else 0.0, height_m * math.radians(vehicle.tilt_rate_deg_s)
    attitude_sd = max(ATTITUDE_SD, attitude_sd)
    return math.hypot(match_m, compute_picture_error_m(vehicle, height_m, t_sd_s, attitude_sd, sweep_m_s))


def compute_time_error_m(event: Recognition, vehicle: Vehicle | None) -> float:
    """Return the standard deviation (metres) of the position error common to frames if their times are less accurate
    than usual. It is always along the flight, so averaging over frames does not reduce it."""
    t_sd_s = event.frame.t_sd_s if event.frame else 0.0
    velocity_m_s = vehicle and vehicle.velocity_m_s
    speed_m_s = math.hypot(*velocity_m_s) if velocity_m_s else _UNKNOWN_SPEED_M_S
    return speed_m_s * math.sqrt(max(0.0, t_sd_s**2 - FRAME_TIME_SD_S**2))


def position_match(event: Recognition, frame: FrameMeasurement) -> PositionedMatch | None:
    """Return the positioned match of an event and its frame; None if no match with a position was accepted."""
    if event.best is None or event.located is None or event.accuracy_m is None:
        return None
    heading_error_deg, matched_deg, reported_deg = None, event.located.heading_deg, event.view.up_deg
    if matched_deg is not None and reported_deg is not None:
        heading_error_deg = wrap_deg(matched_deg - reported_deg)
    return PositionedMatch(
        frame=frame,
        position=event.located.position,
        accuracy_m=event.accuracy_m,
        covariance_m2=covariance_matrix(event.located.covariance_m2),
        places=event.located.places or (event.best.place.place_id,),
        attitude_error=event.located.attitude_error,
        heading_error_deg=heading_error_deg,
    )
