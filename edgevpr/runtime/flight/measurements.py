"""What a frame and its match say of the aircraft's position, and by how much that is wrong: the one place for errors of
attitude and time. `navigator`, `survey` and the watch over GPS use it."""

import math
from dataclasses import dataclass

import numpy as np

from edgevpr.core.arrays import Doubles
from edgevpr.core.geodesy import wrap_deg
from edgevpr.core.types import FRAME_TIME_SD_S, Position, Vehicle
from edgevpr.runtime.flight.drift import GRAVITY_M_S2
from edgevpr.runtime.recognise.locate import covariance_matrix
from edgevpr.runtime.recognise.odometry import OdometryStep
from edgevpr.runtime.recognise.perspective import AttitudeError
from edgevpr.runtime.recognise.recognition import Recognition

# Standard deviation of a reported attitude, as a tangent: half a degree. The watch over GPS allows for twice as much:
# its false alarm costs an aircraft its GPS, and matches in a row share the error of one turn. A filter averages over
# more.
ATTITUDE_SD = math.tan(math.radians(0.5))
CAUTIOUS_ATTITUDE_SD = math.tan(math.radians(1.0))
RECEIVER_LAG_SD_S = 0.1  # of a receiver's time, beside `receivers.RECEIVER_LAG_S`
_UNKNOWN_ATTITUDE_SD = math.tan(math.radians(15.0))  # without a reported attitude: a turning aircraft banks
_UNKNOWN_SPEED_M_S = 15.0  # of an aircraft that reports none
_MAX_HEIGHT_RATIO = 2.0  # beyond it, motion between pictures is not corrected but left out
_CORRELATED_SHARE = 0.25  # of the footprint: fixes nearer to each other err alike, by changes of the ground
_MAX_TURN_DEG = 45.0  # so far a compass does not turn from one fix to the next


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameMeasurement:
    """A frame taken at `t_s`. `sd_m` is the standard deviation, of each axis, by which its picture puts the aircraft
    wrongly, beside what `lean_s2` says that an error of the attitude does (see `DriftFilter`). `odometry` is the motion
    since the frame before (None: unknown), whose scale is wrong by `scale_sd` where heights contradict each other.
    `alike_m` is how far apart pictures are whose fixes do not err alike."""

    t_s: float
    sd_m: float
    lean_s2: float = 0.0
    odometry: OdometryStep | None = None
    scale_sd: float = 0.0
    alike_m: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class PositionedMatch:
    """An accepted match with a position: its `frame`; `position` of the aircraft then; `accuracy_m`, to be sent with
    it; `covariance_m2` (2, 2), without the error that all fixes share and that of the frame; numbers of the `places` it
    comes from; `lean`, what its picture shows of the error of the attitude; and `turn_deg`, by how much the heading
    that it shows exceeds the autopilot's."""

    frame: FrameMeasurement
    position: Position
    accuracy_m: float
    covariance_m2: Doubles
    places: tuple[int, ...]
    lean: AttitudeError | None = None
    turn_deg: float | None = None

    @property
    def t_s(self) -> float:
        """Time of the frame."""
        return self.frame.t_s

    @property
    def scatter_m2(self) -> Doubles:
        """Covariance (2, 2) by which the fixes of two frames differ."""
        return self.covariance_m2 + self.frame.sd_m**2 * np.eye(2)

    def is_of_other_places(self, other: "PositionedMatch") -> bool:
        """Tell whether it comes from none of the places that the other one comes from."""
        return set(self.places).isdisjoint(other.places)

    def is_turned_like(self, turn_deg: float | None) -> bool:
        """Tell whether its picture is turned against the compass by about `turn_deg`, where both are known."""
        if self.turn_deg is None or turn_deg is None:
            return True
        return abs(wrap_deg(self.turn_deg - turn_deg)) <= _MAX_TURN_DEG


def measure_frame(
    event: Recognition, vehicle: Vehicle | None, *, is_level: bool, height_ratio: float, height_ratio_sd: float
) -> FrameMeasurement | None:
    """Return the frame of an event; None for one that could not be read. `is_level`: the camera hangs in a gimbal;
    `height_ratio`: height by the pictures over the reported one, wrong by the share `height_ratio_sd`.

    An error of the attitude does not move the picture of a level camera, nor one that leans by no reported attitude. An
    error of the time moves the point under the camera, as the aircraft flies and as it rolls.
    """
    if event.frame is None:
        return None
    height_m, has_attitude, sd_m = 0.0, False, 0.0
    if vehicle:
        height_m, has_attitude = height_ratio * (vehicle.height_m or 0.0), vehicle.roll_deg is not None
        tilting_m_s = height_m * math.radians(0.0 if is_level else vehicle.tilting_deg_s)
        attitude_sd = ATTITUDE_SD if has_attitude else _UNKNOWN_ATTITUDE_SD
        sd_m = picture_error_m(vehicle, height_m, event.frame.t_sd_s, attitude_sd, tilting_m_s)
    is_unmoved = is_level or not has_attitude or not (event.view.aside or event.view.lean_m)
    is_correctable = 1 / _MAX_HEIGHT_RATIO < height_ratio < _MAX_HEIGHT_RATIO
    return FrameMeasurement(
        t_s=event.frame.t_mono_s,
        sd_m=sd_m,
        lean_s2=0.0 if is_unmoved else height_m / GRAVITY_M_S2,
        odometry=event.odometry.scale(height_ratio) if event.odometry and is_correctable else None,
        scale_sd=max(abs(height_ratio - 1.0), height_ratio_sd),
        alike_m=_CORRELATED_SHARE * (event.view.footprint_m or 0.0),
    )


def measure_for_gps(event: Recognition, vehicle: Vehicle) -> PositionedMatch | None:
    """Return the match of an event with the errors by which it may differ from a receiver; None if there is none."""
    if event.frame is None:
        return None
    t_sd_s = math.hypot(RECEIVER_LAG_SD_S, event.frame.t_sd_s)
    sd_m = picture_error_m(vehicle, vehicle.height_m or 0.0, t_sd_s, CAUTIOUS_ATTITUDE_SD)
    return position_match(event, FrameMeasurement(t_s=event.frame.t_mono_s, sd_m=sd_m))


def picture_error_m(
    vehicle: Vehicle, height_m: float, t_sd_s: float, attitude_sd: float = ATTITUDE_SD, tilting_m_s: float = 0.0
) -> float:
    """Return by how much a picture puts the aircraft wrongly: metres, standard deviation of one axis. `t_sd_s` is that
    of its time, `tilting_m_s` the speed of the point under the camera as the aircraft rolls."""
    speed_m_s = math.hypot(tilting_m_s, *(vehicle.velocity_m_s or (0.0, 0.0)))
    return math.hypot(attitude_sd * height_m, t_sd_s * speed_m_s)


def shared_time_error_m(event: Recognition, vehicle: Vehicle | None) -> float:
    """Return by how much (metres, standard deviation) frames put the aircraft wrongly whose time is known worse than
    usual: in one direction, so that several of them say no more than one."""
    t_sd_s = event.frame.t_sd_s if event.frame else 0.0
    velocity_m_s = vehicle and vehicle.velocity_m_s
    speed_m_s = math.hypot(*velocity_m_s) if velocity_m_s else _UNKNOWN_SPEED_M_S
    return speed_m_s * math.sqrt(max(0.0, t_sd_s**2 - FRAME_TIME_SD_S**2))


def position_match(event: Recognition, frame: FrameMeasurement) -> PositionedMatch | None:
    """Return the positioned match of an event and its frame; None if no match with a position was accepted."""
    if event.best is None or event.located is None or event.accuracy_m is None:
        return None
    turn_deg, shown_deg, reported_deg = None, event.located.heading_deg, event.view.up_deg
    if shown_deg is not None and reported_deg is not None:
        turn_deg = wrap_deg(shown_deg - reported_deg)
    return PositionedMatch(
        frame=frame,
        position=event.located.position,
        accuracy_m=event.accuracy_m,
        covariance_m2=covariance_matrix(event.located.covariance_m2),
        places=event.located.places or (event.best.place.place_id,),
        lean=event.located.lean,
        turn_deg=turn_deg,
    )


def worst_sd(covariance: Doubles) -> float:
    """Return the standard deviation along the worst direction of a covariance (2, 2)."""
    return float(np.sqrt(np.linalg.eigvalsh(covariance)[-1]))
