"""A vehicle that starts on the ground and does what it is told: hovers and circles; and the simulated
flight controller in it, which is armed and takes off. Plain kinematics: what matters here is where it is."""

import cmath
import math
from itertools import pairwise
from statistics import fmean

from simulated.ardupilot_rules import _GPS
from simulated.controller import FlightController
from simulated.firmware import FAILED, OK
from simulated.motion import Motion, TrueState
from simulated.reports import compute_yaw
from simulated.sensors import FIX_3D

from edgevpr.core.geodesy import moved
from edgevpr.core.types import Position
from edgevpr.lab.simulate.generated import ORIGIN
from edgevpr.mavlink.wire import mavlink

GRAVITY_M_S2 = 9.81
AIRSPEED_M_S = 22.0  # of a plane
CIRCLE_M = 80.0  # radius, where a plane waits
_CLIMB_M_S = {"copter": 3.0, "plane": 4.0}
_COMMAND_GOOD_FOR_S = 3.0  # a copter that is told no velocity any more stops
_CRUISE_DEG = 90.0  # the nose at the start


class FreeFlight(Motion):
    """A copter or plane that begins at `home`, on the ground."""

    is_known = True

    def __init__(self, kind: str, home: Position) -> None:
        self._kind, self._home = kind, home
        self._at_m, self._height_m, self._goal_m = 0j, 0.0, 0.0
        self._heading_deg = _CRUISE_DEG
        self._told: tuple[complex, float] = 0j, -math.inf

    @property
    def is_flying(self) -> bool:
        """True from take-off to landing."""
        return self._goal_m > 0 or self._height_m > 0

    def begin(self, now_s: float) -> None:
        """Do nothing: it moves when it is told to."""

    def take_off(self, height_m: float) -> None:
        """Climb to a height over home."""
        self._goal_m = height_m

    def fly(self, velocity_m_s: complex, now_s: float) -> None:
        """Fly so for three seconds; a plane does not obey."""
        self._told = velocity_m_s, now_s

    def step(self, now_s: float, dt_s: float) -> TrueState:
        """Move on by `dt_s`."""
        most_m = _CLIMB_M_S[self._kind] * dt_s
        climb_m = max(-most_m, min(most_m, self._goal_m - self._height_m))
        self._height_m += climb_m
        roll_deg = 0.0
        if self._kind == "plane":
            velocity, roll_deg = self._circled(dt_s)
        else:
            velocity, told_s = self._told
            if not self.is_flying or now_s - told_s > _COMMAND_GOOD_FOR_S:
                velocity = 0j
        self._at_m += velocity * dt_s
        lat_deg, lon_deg = moved(self._home.lat_deg, self._home.lon_deg, self._at_m.real, self._at_m.imag)
        return TrueState(
            lat_deg=lat_deg,
            lon_deg=lon_deg,
            alt_m=(self._home.alt_m or 0.0) + self._height_m,
            height_m=self._height_m,
            velocity_m_s=velocity,
            climb_m_s=climb_m / dt_s if dt_s else 0.0,
            roll_deg=roll_deg,
            pitch_deg=0.0,
            heading_deg=self._heading_deg,
        )

    def _circled(self, dt_s: float) -> tuple[complex, float]:
        """Fly straight until the height is reached, then circle to the right; return velocity and bank."""
        if not self.is_flying:
            return 0j, 0.0
        roll_deg = 0.0
        if self._height_m >= self._goal_m - 1:
            self._heading_deg = (self._heading_deg + math.degrees(AIRSPEED_M_S / CIRCLE_M * dt_s)) % 360
            roll_deg = math.degrees(math.atan(AIRSPEED_M_S**2 / (CIRCLE_M * GRAVITY_M_S2)))
        return cmath.rect(AIRSPEED_M_S, math.radians(90 - self._heading_deg)), roll_deg


class Piloted(FlightController):
    """A flight controller that is armed and takes off, and says where it truly is (SIM_STATE). It has
    GPS at the start."""

    def __init__(self, vehicle: str, **parameters: float) -> None:
        self.kind = vehicle.removeprefix("ardu").removeprefix("px4-")
        self.motion = FreeFlight(self.kind, ORIGIN)
        super().__init__(vehicle, self.motion, gps=True)
        self._gps_s, self._vision_s = [], -math.inf  # when the companion's messages were heard
        self.reports[mavlink.MAVLINK_MSG_ID_SIM_STATE] = _truth
        for name, value in parameters.items():
            self.set(name, value)

    def why_not_arm(self) -> str | None:
        """The reason of the pre-arm checks of an ArduPilot, None where they pass."""
        brain, receivers = self.brain, self.brain.receivers
        needs_vision = brain.parameters["VISO_TYPE"] != 0
        checks = {
            "Need Position Estimate": not brain._is_aiding,
            "VisOdom: not healthy": needs_vision and brain.now_s - self._vision_s > 0.3,
            "GPS 1: Bad fix": brain._source == _GPS and receivers.reports[0].fix_type < FIX_3D,
            "GPS 2: Bad fix": receivers.has_second and receivers.reports[1].fix_type < FIX_3D,
            "GPS 2: not healthy": receivers.has_second and not self.is_second_healthy,
        }
        return next((reason for reason, is_so in checks.items() if is_so), None)

    @property
    def is_second_healthy(self) -> bool:
        """True while the second GPS reports at about 5 Hz or more, and was not late twice in a row (AP_GPS)."""
        intervals_s = [after - before for before, after in pairwise(self._gps_s[-50:])]
        return bool(intervals_s) and fmean(intervals_s) < 0.215 and min(intervals_s[-2:]) < 0.245

    def receive(self, message):
        if message.get_type() == "GPS_INPUT":
            self._gps_s.append(self.brain.now_s)
        if message.get_type() == "ODOMETRY" and message.frame_id == mavlink.MAV_FRAME_LOCAL_FRD:
            self._vision_s = self.brain.now_s
        return super().receive(message)

    def arm(self) -> None:
        """Arm; a plane with ArduPilot, whose mode is TAKEOFF, then takes off."""
        self.brain.is_armed = True
        if self.kind == "plane" and self.brain.number == mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA:
            self.motion.take_off(self.brain.parameters["TKOFF_ALT"])

    def _obey(self, command):
        match command.command:
            case mavlink.MAV_CMD_COMPONENT_ARM_DISARM:
                if why_not := self.why_not_arm():
                    return FAILED, [mavlink.MAVLink_statustext_message(2, f"Arm: {why_not}".encode())]
                self.arm()
                return OK, []
            case mavlink.MAV_CMD_NAV_TAKEOFF:
                self.motion.take_off(command.param7)
                return OK, []
            case mavlink.MAV_CMD_DO_SET_MODE:
                return OK, []
        return super()._obey(command)


def _truth(brain):
    truth = brain.truth
    place = truth.lat_deg, truth.lon_deg, truth.alt_m
    speeds = truth.velocity_m_s.imag, truth.velocity_m_s.real, -truth.climb_m_s
    exact = round(truth.lat_deg * 1e7), round(truth.lon_deg * 1e7)
    angles = math.radians(truth.roll_deg), math.radians(truth.pitch_deg), compute_yaw(truth)
    return mavlink.MAVLink_sim_state_message(1, 0, 0, 0, *angles, 0, 0, -9.81, 0, 0, 0, *place, 0, 0, *speeds, *exact)
