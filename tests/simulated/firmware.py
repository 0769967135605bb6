"""The common part of the simulated firmwares, ArduPilot and PX4: parameters and a position estimator. The error of the
estimate grows by a simple model. A point is (latitude, longitude) in degrees, a vector east + 1j * north."""

import cmath
import math
import struct
from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import ClassVar

from edgevpr.core.arrays import LatLon
from edgevpr.mavlink.wire import Message, mavlink, read_parameter_value
from simulated.estimator import Estimator
from simulated.motion import Motion, displace, displacement_m
from simulated.sensors import PositionMeasurement, Receivers

# Standard deviations that an innovation may have: EK3_POS_I_GATE, EK3_VEL_I_GATE, EKF2_GPS_P_GATE
GATE_SD = 5.0
OK: int = mavlink.MAV_RESULT_ACCEPTED
FAILED: int = mavlink.MAV_RESULT_FAILED
DENIED: int = mavlink.MAV_RESULT_DENIED
NOT_NOW: int = mavlink.MAV_RESULT_TEMPORARILY_REJECTED
UNSUPPORTED: int = mavlink.MAV_RESULT_UNSUPPORTED
_DRIFT_SD_M_S = {"plane": 1.0, "copter": 3.0}
# EK3_POSNE_M_NSE and EK3_VELNE_M_NSE, EKF2_GPS_P_NOISE and EKF2_GPS_V_NOISE: no measurement counts for better.
POSITION_NOISE_M = 0.5
_VELOCITY_NOISE_M_S = 0.3
# Of a vehicle that obeys its estimate. With it a copter whose autopilot is sent its own estimate is 119 m away after
# 55 s and 285 m after 75 s; real ones were 120 m and 330 m away.
_GYRO_ERROR_RAD_S = math.radians(0.02)
_INERTIAL_M_S2 = 0.05 + 0j  # error of the acceleration from which a copter dead-reckons
_WIND_LEARNT_IN_S = 5.0
_TYPES = {"copter": mavlink.MAV_TYPE_QUADROTOR, "plane": mavlink.MAV_TYPE_FIXED_WING}

Origin = tuple[float, float, float]  # latitude, longitude, altitude above sea level


class Firmware(ABC):
    """The position estimator of a vehicle, and all that edgevpr reads which depends on it. Flight modes and failsafes
    are not simulated, since edgevpr does not see them. The estimate is kept as its error (see `Estimator`)."""

    number: ClassVar[int]  # MAV_AUTOPILOT
    version: ClassVar[int]
    filter_report: ClassVar[int]  # number of the message
    default_hz: ClassVar[Mapping[int, float]] = {}
    velocity_ratio = 0.1  # innovation of measured velocities to their gate
    heading_error_deg = 0.0  # of a vehicle that obeys its estimate; the filter does not correct it

    def __init__(self, kind: str, motion: Motion, parameters: dict[str, float]) -> None:
        self.kind, self.motion = kind, motion
        self.vehicle_type = _TYPES[kind]
        self.parameters = Parameters({**parameters, **SIMULATOR}, self.number == mavlink.MAV_AUTOPILOT_PX4)
        self.receivers = Receivers(self.parameters)
        self.estimator = Estimator(_GYRO_ERROR_RAD_S if motion.obeys_estimate else 0.0)
        self.origin: Origin | None = None
        self.test_ratio = 0.0
        self.start_utc_s = 0.0
        self.now_s, self.truth = 0.0, motion.step(0.0, 0.0)
        self.turn_rad_s = 0.0  # of the true heading, clockwise
        self._wind_m_s = 0j  # as the filter has learnt it

    def step(self, dt_s: float) -> None:
        """Advance by `dt_s` seconds: motion, sensors, estimator."""
        self.now_s += dt_s
        turn = cmath.rect(1.0, math.radians(self.heading_error_deg))
        self.motion.steer(self.estimator.error_m, self.estimator.velocity_error_m_s, self.tilt, turn)
        old_heading_deg, self.truth = self.truth.heading_deg, self.motion.step(self.now_s, dt_s)
        self.turn_rad_s = math.radians(math.remainder(self.truth.heading_deg - old_heading_deg, 360)) / dt_s
        self.estimator.velocity_error_m_s += (turn.conjugate() - 1) * self.truth.acceleration_m_s2 * dt_s
        self.receivers.step(self.truth, self.now_s)
        self._estimate(1j * self.parameters["SIM_WIND_SPD"], dt_s)

    @abstractmethod
    def lose_gps(self) -> None:
        """Set the state of a vehicle that had GPS until a moment ago, and has none any more."""

    @abstractmethod
    def flags(self) -> int:
        """Return the flags of the filter's report (EKF_STATUS_REPORT or ESTIMATOR_STATUS)."""

    @abstractmethod
    def take_fix(self, command: Message) -> int:
        """Process command 43003: correct the position if it is accepted. Returns a MAV_RESULT."""

    @abstractmethod
    def take_odometry(self, message: Message) -> None:
        """Process an ODOMETRY (331)."""

    @abstractmethod
    def _estimate(self, wind_m_s: complex, dt_s: float) -> None:
        """Advance the estimator by `dt_s` seconds. `wind_m_s` is the true wind."""

    def take_global_position(self, message: Message) -> None:  # noqa: B027
        """Process a GLOBAL_POSITION_SENSOR (296), if the firmware knows it."""

    def use_source_set(self, number: float) -> int:
        """Execute MAV_CMD_SET_EKF_SOURCE_SET (42007), if the firmware has source sets. Returns a MAV_RESULT."""
        return UNSUPPORTED

    @property
    def tilt(self) -> complex:
        """Error of the attitude (see `Estimator`); where the motion is given, so is the attitude."""
        return self.estimator.tilt if self.motion.obeys_estimate else 0j

    @property
    def point(self) -> LatLon:
        """The estimated position."""
        return displace(self.truth.point, self.estimator.error_m)

    @property
    def velocity_m_s(self) -> complex:
        """The estimated velocity."""
        return self.truth.velocity_m_s + self.estimator.velocity_error_m_s

    def _innovation_m(self, point: LatLon, age_s: float = 0.0) -> complex:
        """Return the vector from the estimate to a point measured `age_s` ago, plus the distance flown since."""
        return displacement_m(self.truth.point, point) - self.estimator.error_m + self.velocity_m_s * age_s

    def _reset_to(self, point: LatLon, sd_m: float, age_s: float = 0.0) -> None:
        """Set the estimate to a point that was measured `age_s` seconds ago."""
        self.estimator.reset_position(self.estimator.error_m + self._innovation_m(point, age_s), sd_m)

    def _ratio(self, point: LatLon, sd_m: float, age_s: float = 0.0, gate_sd: float = GATE_SD) -> float:
        """Return the ratio of the innovation of a position to its gate, `gate_sd` standard deviations."""
        return abs(self._innovation_m(point, age_s)) / (gate_sd * math.hypot(self.estimator.sd_m, sd_m))

    def _fuse_position(self, point: LatLon, sd_m: float, age_s: float = 0.0, gate_sd: float = GATE_SD) -> bool:
        """Fuse a position if it is within the gate. Returns True if it was."""
        is_within = self._ratio(point, sd_m, age_s, gate_sd) <= 1
        if is_within:
            self.estimator.correct(0, self._innovation_m(point, age_s), sd_m)
        return is_within

    def _fuse_velocity(self, measured: PositionMeasurement, gate_sd: float = GATE_SD) -> None:
        """Fuse a measured velocity, if there is one within the gate."""
        if measured.velocity_m_s is not None:
            sd_m_s = max(_VELOCITY_NOISE_M_S, measured.speed_sd_m_s)
            innovation_m_s = measured.velocity_m_s - self.velocity_m_s
            if abs(innovation_m_s) <= gate_sd * math.hypot(self.estimator.speed_sd_m_s, sd_m_s):
                self.estimator.correct(1, innovation_m_s, sd_m_s)

    def _learn_wind(self, wind_m_s: complex) -> None:
        """Let the filter learn the true wind from a fused position."""
        self._wind_m_s += (wind_m_s - self._wind_m_s) * min(1.0, 0.2 / _WIND_LEARNT_IN_S)

    def _drift(self, wind_m_s: complex, dt_s: float, unnoticed_share: float) -> None:
        """Increase the velocity error of the dead reckoning: of a plane by `unnoticed_share` of the change of wind
        since the filter learnt it, of a copter by the error of its accelerometers."""
        self.estimator.expect_drift(_DRIFT_SD_M_S[self.kind])
        if self.kind == "plane":
            self.estimator.velocity_error_m_s = unnoticed_share * (self._wind_m_s - wind_m_s)
        else:
            self.estimator.velocity_error_m_s += _INERTIAL_M_S2 * dt_s


class Parameters(dict[str, float]):
    """Parameters by name; each stays an int or a float. With `bytewise` (PX4) the bytes of an integer are sent in the
    float of the message, else (ArduPilot) the integer's value."""

    def __init__(self, values: dict[str, float], bytewise: bool) -> None:
        super().__init__(values)
        self._bytewise = bytewise

    def set(self, name: str, value: float) -> None:
        """Set the value of an existing parameter."""
        self[name] = type(self[name])(value)

    def answer(self, message: Message) -> list[Message]:
        """Return the reply to a PARAM_REQUEST_READ by name or a PARAM_SET; none for an unknown name."""
        name = message.param_id
        if name not in self:
            return []
        if message.get_type() == "PARAM_SET":
            self.set(name, read_parameter_value(message, self._bytewise) or 0.0)
        value, is_whole = self[name], isinstance(self[name], int)
        kind = mavlink.MAV_PARAM_TYPE_INT32 if is_whole else mavlink.MAV_PARAM_TYPE_REAL32
        if is_whole and self._bytewise:
            value = struct.unpack("<f", struct.pack("<i", value))[0]
        index = list(self).index(name)
        return [mavlink.MAVLink_param_value_message(name.encode(), float(value), kind, len(self), index)]


# Parameters of the simulation, named as in ArduPilot's own simulator, so that one test can drive both.
SIMULATOR = {
    "SIM_GPS1_ENABLE": 1,
    "SIM_GPS1_TYPE": 1,  # 1: u-blox, whose fix is RTK; 5: NMEA, whose fix is a plain 3D one
    "SIM_GPS1_NUMSATS": 10,
    "SIM_GPS_SPOOF": 0,  # 1: the receiver says that it is spoofed; not a parameter of ArduPilot's simulator
    "SIM_WIND_SPD": 0.0,  # of a wind from the south
}
_SERIAL = {f"SERIAL{number}_{name}": value for number in (1, 2) for name, value in (("BAUD", 57), ("PROTOCOL", 2))}
# The source of each quantity in the first source set, and in the second and third.
_SOURCES = {"POSXY": (3, 0), "VELXY": (3, 0), "POSZ": (1, 1), "VELZ": (3, 0), "YAW": (1, 0)}
ARDUPILOT = {
    "AHRS_EKF_TYPE": 3,
    "AHRS_GPS_USE": 1,
    "ARMING_CHECK": 1,
    "EK3_AFFINITY": 0,
    "EK3_ENABLE": 1,
    "EK3_GLITCH_RAD": 25,
    "EK3_PRIMARY": 0,
    "EK3_SRC_OPTIONS": 0,
    **{f"EK3_SRC{number}_{name}": both[number > 1] for name, both in _SOURCES.items() for number in (1, 2, 3)},
    "FLOW_TYPE": 0,
    "GPS1_DELAY_MS": 0,
    "GPS1_TYPE": 1,
    "GPS2_DELAY_MS": 0,
    "GPS2_TYPE": 0,
    **{f"GPS{number}_POS_{axis}": 0.0 for number in (1, 2) for axis in "XYZ"},
    "GPS_AUTO_SWITCH": 1,
    "GPS_BLEND_MASK": 5,
    "GPS_PRIMARY": 0,
    **_SERIAL,
    "VISO_DELAY_MS": 10,
    "VISO_ORIENT": 0,
    **{f"VISO_POS_{axis}": 0.0 for axis in "XYZ"},
    "VISO_POS_M_NSE": 0.2,
    "VISO_QUAL_MIN": 0,
    "VISO_SCALE": 1.0,
    "VISO_TYPE": 0,
}
ARDUPILOT_PLANE = {"ARSPD_TYPE": 2, "ARSPD_USE": 1}

PX4 = {
    "EKF2_AGP0_ID": 1,
    "EKF2_AGP0_CTRL": 1,
    "EKF2_AGP0_DELAY": 0.0,
    "EKF2_AGP0_GATE": 3.0,
    "EKF2_AGP0_MODE": 0,
    "EKF2_AGP0_NOISE": 1.0,
    "EKF2_EV_CTRL": 0,
    "EKF2_EV_DELAY": 0.0,
    "EKF2_EV_NOISE_MD": 0,
    "EKF2_EVP_GATE": 5.0,
    "EKF2_EVP_NOISE": 0.1,
    **{f"EKF2_EV_POS_{axis}": 0.0 for axis in "XYZ"},
    "EKF2_GPS_CTRL": 7,
    "EKF2_GPS_MODE": 0,
    "EKF2_HGT_REF": 1,
    "EKF2_NOAID_TOUT": 5_000_000,
    "EKF2_OF_CTRL": 1,  # as of a real one without any flow sensor
    "MAV_1_CONFIG": 102,
    "MAV_1_MODE": 2,
    "SER_TEL2_BAUD": 921_600,
    "SYS_HAS_GPS": 1,
}
