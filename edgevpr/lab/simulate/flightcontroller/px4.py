"""The rules of PX4 1.17-alpha (February 2026): EKF2 and command 43003 (EKF2.cpp, ekf.cpp
resetGlobalPosToExternalObservation, ekf_helper.cpp updateHorizontalDeadReckoningstatus), message 296
(aux_global_position.cpp). How fast an estimate goes wrong is a plain model."""

import math

from edgevpr.lab.simulate.flightcontroller.parameters import PX4 as PX4_PARAMETERS
from edgevpr.lab.simulate.flightcontroller.parameters import SIMULATOR, Parameters
from edgevpr.lab.simulate.flightcontroller.receivers import FIX_3D, ExternalNavigation, Measurement, Receivers
from edgevpr.lab.simulate.flightcontroller.reckoning import Reckoning
from edgevpr.lab.simulate.flightcontroller.truth import Motion, Truth
from edgevpr.mavlink.wire import Message, mavlink

_AIDING_GONE_S = 1.0  # no_aid_timeout_max
_RESET_AFTER_S = 7.0  # reset_timeout_max
_SILENT_AFTER_S = 5.0  # of message 296
_OLDEST_FIX_S = 15.0
_DEFAULT_ACCURACY_M = 50.0
_GATE_SD = 5.0
_SURE_M = 1.0  # a fix that claims to be better is believed as it is
_SD_GROWS_M_S = {"copter": 3.0, "plane": 1.0}
_INERTIAL_M_S2 = 0.05 + 0j
_WIND_LEARNT_IN_S = 5.0

_OFFBOARD, _POSITION, _LAND = 6 << 16, 3 << 16, 4 << 16 | 6 << 24
_TAKEOFF = 4 << 16 | 2 << 24
_OK, _FAILED, _DENIED = mavlink.MAV_RESULT_ACCEPTED, mavlink.MAV_RESULT_FAILED, mavlink.MAV_RESULT_DENIED
_NOT_NOW = mavlink.MAV_RESULT_TEMPORARILY_REJECTED


class Px4:
    """The estimator of a copter or a plane and what hangs on it. `motion` is landed where the failsafe says so."""

    firmware = mavlink.MAV_AUTOPILOT_PX4
    version = 1 << 24 | 17 << 16 | mavlink.FIRMWARE_VERSION_TYPE_ALPHA
    filter_report = mavlink.MAVLINK_MSG_ID_ESTIMATOR_STATUS
    default_hz = {  # noqa: RUF012 - of a link in the mode "onboard"
        mavlink.MAVLINK_MSG_ID_ATTITUDE: 20.0,
        mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: 10.0,
        mavlink.MAVLINK_MSG_ID_GPS_RAW_INT: 5.0,
        mavlink.MAVLINK_MSG_ID_ESTIMATOR_STATUS: 1.0,
        mavlink.MAVLINK_MSG_ID_SYSTEM_TIME: 1.0,
    }

    def __init__(self, kind: str, motion: Motion) -> None:
        self.kind = kind
        self.vehicle_type = mavlink.MAV_TYPE_FIXED_WING if kind == "plane" else mavlink.MAV_TYPE_QUADROTOR
        self.parameters = Parameters({**PX4_PARAMETERS, **SIMULATOR}, bytewise=True)
        self.receivers, self.external = Receivers(self.parameters), ExternalNavigation(self.parameters)
        self.reckoning = Reckoning()
        self.origin: tuple[float, float, float] | None = None
        self.mode, self.is_armed = _POSITION, motion.is_flying
        self.texts: list[tuple[int, str]] = []
        self.test_ratio = 0.0
        self._motion = motion
        self._used: Measurement | None = None
        self._gps_s = self._fused_s = self._aided_s = -math.inf  # last passed: GPS; anything; when it was not inertial
        self._other_s = self._other_heard_s = -math.inf  # 296: last fused, last heard
        self._wind_m_s = 0j
        self._has_failed = False

    def lose_gps(self, truth: Truth, now_s: float) -> None:
        """Be as one that had GPS until a while ago, and has none any more."""
        self.parameters.set("SIM_GPS1_ENABLE", 0)
        self.origin = truth.lat_deg, truth.lon_deg, truth.alt_m
        self._gps_s = self._fused_s = now_s - 2 * _AIDING_GONE_S
        self._aided_s = now_s - _AIDING_GONE_S

    def step(self, truth: Truth, wind_m_s: complex, now_s: float, dt_s: float) -> None:
        """Let sensors report, and the estimator and its watchers follow."""
        self.receivers.step(truth, now_s)
        first = self.receivers.first
        measured = first.last if first.fix_type >= FIX_3D and self.parameters["EKF2_GPS_CTRL"] & 1 else None
        if measured is not None and measured != self._used:
            self._take(truth, measured, wind_m_s, now_s)
        self._used = measured
        is_aided = now_s - self._fused_s < _AIDING_GONE_S
        if is_aided:
            self.reckoning.drift_m_s = 0j
        elif self.kind == "plane":
            self.reckoning.drift_m_s = self._wind_m_s - wind_m_s if self._motion.is_flying else 0j
        elif self._motion.is_flying:
            self.reckoning.drift_m_s += _INERTIAL_M_S2 * dt_s
        is_inertial = not is_aided and self.kind != "plane" and self._motion.is_flying
        if not is_inertial:
            self._aided_s = now_s
        self.reckoning.step(dt_s, _SD_GROWS_M_S[self.kind] if self._motion.is_flying and not is_aided else 0.0)
        self._watch(now_s)

    def flags(self, now_s: float) -> int:
        """Return the flags of ESTIMATOR_STATUS."""
        flags = mavlink.ESTIMATOR_ATTITUDE | mavlink.ESTIMATOR_VELOCITY_VERT | mavlink.ESTIMATOR_POS_VERT_ABS
        if self.origin is None:
            return flags | mavlink.ESTIMATOR_CONST_POS_MODE
        if self._is_valid(now_s):
            flags |= mavlink.ESTIMATOR_VELOCITY_HORIZ | mavlink.ESTIMATOR_POS_HORIZ_REL
            flags |= mavlink.ESTIMATOR_POS_HORIZ_ABS
        return flags | (mavlink.ESTIMATOR_GPS_GLITCH if self.test_ratio > 1 else 0)

    def take_fix(self, command: Message, truth: Truth, now_s: float) -> int:
        """Judge command 43003, and set the position where it is accepted. Time of sending and frame mean nothing."""
        is_dead_reckoning = self._motion.is_flying and now_s - self._fused_s >= _AIDING_GONE_S
        is_on_ground = not self._motion.is_flying and now_s - self._gps_s >= _AIDING_GONE_S
        if not (is_dead_reckoning or is_on_ground) or not math.isfinite(command.param2):
            return _NOT_NOW
        lat_deg, lon_deg = command.x / 1e7, command.y / 1e7
        if not (abs(lat_deg) <= 90 and abs(lon_deg) <= 180):
            return _FAILED
        accuracy_m = command.param3 if math.isfinite(command.param3) and command.param3 > 0 else _DEFAULT_ACCURACY_M
        if self.origin is None:
            self.origin = lat_deg, lon_deg, truth.alt_m
        # Within the gate PX4 corrects velocity and wind too, which is not simulated; the position follows either way.
        moved_m = 0j
        if self._is_valid(now_s):
            moved_m = self.reckoning.velocity_m_s(truth) * min(max(command.param2, 0.0), _OLDEST_FIX_S)
        self.reckoning.reset_to(truth, lat_deg, lon_deg, accuracy_m)
        self.reckoning.error_m += moved_m
        return _OK

    def take_global_position(self, message: Message, truth: Truth, now_s: float) -> None:
        """Fuse a GLOBAL_POSITION_SENSOR (296). Its own times are ignored: it is as old as the parameter says."""
        is_ours = message.id == self.parameters["EKF2_AGP0_ID"] != 0  # 0: the slot is off
        if not message.eph > 0 or not is_ours or not self.parameters["EKF2_AGP0_CTRL"] & 1:
            return
        delay_s = self.parameters["EKF2_AGP0_DELAY"] / 1e3
        is_starting = now_s - self._other_heard_s > _SILENT_AFTER_S
        self._other_heard_s = now_s
        noise_m = max(message.eph, self.parameters["EKF2_AGP0_NOISE"])
        lat_deg, lon_deg = message.lat / 1e7, message.lon / 1e7
        if self.origin is None:
            self.origin = lat_deg, lon_deg, message.alt
            self.reckoning.reset_to(truth, lat_deg, lon_deg, noise_m)
            self._other_s = self._fused_s = now_s
            return
        moved_m = self.reckoning.velocity_m_s(truth) * delay_s
        innovation_m = self.reckoning.innovation_m(truth, lat_deg, lon_deg) + moved_m
        variance_m2 = self.reckoning.sd_m**2 + noise_m**2
        if abs(innovation_m) <= self.parameters["EKF2_AGP0_GATE"] * math.sqrt(variance_m2):
            gain = self.reckoning.sd_m**2 / variance_m2
            self.reckoning.error_m += gain * innovation_m
            self.reckoning.sd_m *= math.sqrt(1 - gain)
        elif now_s - self._gps_s > _AIDING_GONE_S and (is_starting or now_s - self._other_s > _RESET_AFTER_S):
            self.reckoning.reset_to(truth, lat_deg, lon_deg, noise_m)
            self.reckoning.error_m += moved_m
        else:
            return
        self._other_s = self._fused_s = now_s

    def set_origin(self, lat_deg: float, lon_deg: float, alt_m: float, truth: Truth) -> bool:
        """Move the origin; the vehicle stays where it is. Return True."""
        self.origin = lat_deg, lon_deg, alt_m
        return True

    def use_source_set(self, number: float) -> int:
        """Refuse MAV_CMD_SET_EKF_SOURCE_SET (42007): PX4 has no source sets."""
        return mavlink.MAV_RESULT_UNSUPPORTED

    def set_mode(self, mode: int) -> bool:
        """Change the flight mode."""
        self.mode = mode
        return True

    def take_off(self, alt_m: float, truth: Truth) -> int:
        """Obey MAV_CMD_NAV_TAKEOFF, whose height is that above the sea."""
        self.mode = _TAKEOFF
        self._motion.take_off(alt_m - (truth.alt_m - truth.height_m))
        return _OK

    def why_not_arm(self, now_s: float) -> str | None:
        """Return the reason of the pre-arm checks, None where they pass."""
        return None if self.origin and self._is_valid(now_s) else "No valid global position"

    def arm(self, is_armed: bool) -> None:
        """Arm or disarm."""
        self.is_armed = is_armed

    def _take(self, truth: Truth, measured: Measurement, wind_m_s: complex, now_s: float) -> None:
        self.test_ratio = self.reckoning.test_ratio(truth, measured, _GATE_SD)
        if self.origin is None:
            self.origin = measured.lat_deg, measured.lon_deg, measured.alt_m
        if self.test_ratio <= 1:
            self.reckoning.fuse(truth, measured)
        elif now_s - self._gps_s > _RESET_AFTER_S:
            self.reckoning.reset_to(truth, measured.lat_deg, measured.lon_deg, measured.sd_m)
        else:
            return
        self._gps_s = self._fused_s = now_s
        self._wind_m_s += (wind_m_s - self._wind_m_s) * min(1.0, 0.2 / _WIND_LEARNT_IN_S)

    def _is_valid(self, now_s: float) -> bool:
        return now_s - self._aided_s <= self.parameters["EKF2_NOAID_TOUT"] / 1e6

    def _watch(self, now_s: float) -> None:
        """Land where the position is lost in flight. Landed, it disarms."""
        if self.is_armed and self.mode == _LAND and not self._motion.is_flying:
            self.is_armed = False
        is_lost = self.origin is not None and not self._is_valid(now_s)
        if is_lost and not self._has_failed and self.is_armed:
            self.texts.append((mavlink.MAV_SEVERITY_CRITICAL, "Failsafe activated: no valid position, landing"))
            self.mode = _LAND
            self._motion.land()
        self._has_failed = is_lost
