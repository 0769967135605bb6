"""The simulated PX4: the rules of 1.18-beta1 for its filter EKF2, command 43003, message 296 and ODOMETRY, with the
flags of a real one in its own simulator. Used by `controller`. They are from EKF2.cpp, ekf.cpp
(resetGlobalPosToExternalObservation), ekf_helper.cpp (updateHorizontalDeadReckoningstatus), aux_global_position.cpp and
ev_pos_control.cpp. A 1.17.0 and a 1.18-beta1 were held beside it (test_px4_contract)."""

import math

from edgevpr.lab.simulate.firmware import FAILED, NOT_NOW, OK, PX4, SD_GROWS_M_S, Firmware
from edgevpr.lab.simulate.motion import Motion, beside
from edgevpr.lab.simulate.sensors import FIX_3D
from edgevpr.mavlink.wire import Message, mavlink

_AIDING_GONE_S = 1.0  # no_aid_timeout_max
_RESET_AFTER_S = 7.0  # reset_timeout_max
_SILENT_AFTER_S, _VISION_SILENT_AFTER_S = 5.0, 0.4  # of message 296, and of ODOMETRY
_OLDEST_FIX_S = 15.0
_DEFAULT_ACCURACY_M = 50.0


class Px4(Firmware):
    """A copter or a plane with PX4."""

    number = mavlink.MAV_AUTOPILOT_PX4
    version = 1 << 24 | 18 << 16 | mavlink.FIRMWARE_VERSION_TYPE_BETA
    filter_report = mavlink.MAVLINK_MSG_ID_ESTIMATOR_STATUS
    default_hz = {  # noqa: RUF012 - of a link in the mode "onboard"
        mavlink.MAVLINK_MSG_ID_ATTITUDE: 20.0,
        mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: 10.0,
        mavlink.MAVLINK_MSG_ID_GPS_RAW_INT: 5.0,
        mavlink.MAVLINK_MSG_ID_ESTIMATOR_STATUS: 1.0,
        mavlink.MAVLINK_MSG_ID_SYSTEM_TIME: 1.0,
    }

    def __init__(self, kind: str, motion: Motion) -> None:
        super().__init__(kind, motion, PX4)
        self._fused_s = self._gps_s = self._aided_s = -math.inf  # last fused; GPS was; last not purely inertial
        self._other_s = self._other_heard_s = -math.inf  # message 296 or ODOMETRY: last fused, last received
        self._is_vision = False  # it was ODOMETRY

    def lose_gps(self) -> None:
        self.parameters.set("SIM_GPS1_ENABLE", 0)
        self.origin = self.truth.lat_deg, self.truth.lon_deg, self.truth.alt_m
        self._passed_s = self._fused_s = self._gps_s = self.now_s - 2 * _AIDING_GONE_S
        self._aided_s = self.now_s - _AIDING_GONE_S

    def _estimate(self, wind_m_s: complex, dt_s: float) -> None:
        first = self.receivers.first
        uses_gps = first.fix_type >= FIX_3D and int(self.parameters["EKF2_GPS_CTRL"]) & 1
        measured, before = first if uses_gps else None, self._used
        self._used = measured
        if measured is not None and measured != before:
            self.origin = self.origin or (measured.lat_deg, measured.lon_deg, measured.alt_m)
            if self._fuse(measured, wind_m_s, _RESET_AFTER_S):
                self._fused_s = self._gps_s = self.now_s
        is_aided, is_flying = self.now_s - self._fused_s < _AIDING_GONE_S, self.motion.is_flying
        if is_aided:
            self.drift_m_s = 0j
        else:
            self._go_wrong(wind_m_s, dt_s, 1.0)
        if is_aided or self.kind == "plane" or not is_flying:
            self._aided_s = self.now_s
        self._reckon(dt_s, SD_GROWS_M_S[self.kind] if is_flying and not is_aided else 0.0)

    def flags(self) -> int:
        flags: int = mavlink.ESTIMATOR_ATTITUDE | mavlink.ESTIMATOR_VELOCITY_VERT | mavlink.ESTIMATOR_POS_VERT_ABS
        if self.origin is None:
            return flags | int(mavlink.ESTIMATOR_CONST_POS_MODE)
        if self._is_valid():
            flags |= mavlink.ESTIMATOR_VELOCITY_HORIZ | mavlink.ESTIMATOR_POS_HORIZ_REL
            flags |= mavlink.ESTIMATOR_POS_HORIZ_ABS
        has_ours = self._other_s > -math.inf and self.now_s - self._other_heard_s <= self._silent_s
        has_gps = self.now_s - self._gps_s < _AIDING_GONE_S
        if has_ours or has_gps:
            flags |= mavlink.ESTIMATOR_PRED_POS_HORIZ_REL
        if has_gps or (has_ours and not self._is_vision):
            flags |= mavlink.ESTIMATOR_PRED_POS_HORIZ_ABS
        if not self.motion.is_flying:  # at rest, whatever it knows
            flags |= mavlink.ESTIMATOR_CONST_POS_MODE
        return flags | (mavlink.ESTIMATOR_GPS_GLITCH if self.test_ratio > 1 else 0)

    def take_fix(self, command: Message) -> int:
        """Process command 43003 and return a MAV_RESULT. The command's time of sending and frame are ignored. It is
        taken while there is GPS too, in the releases 1.17.0 and 1.18-beta1."""
        if not math.isfinite(command.param2):
            return NOT_NOW
        lat_deg, lon_deg = command.x / 1e7, command.y / 1e7
        if not (abs(lat_deg) <= 90 and abs(lon_deg) <= 180):
            return FAILED
        accuracy_m = command.param3 if math.isfinite(command.param3) and command.param3 > 0 else _DEFAULT_ACCURACY_M
        self.origin = self.origin or (lat_deg, lon_deg, self.truth.alt_m)
        # Within the gate PX4 corrects velocity and wind too, which is not simulated; the position follows either way.
        age_s = min(max(command.param2, 0.0), _OLDEST_FIX_S) if self._is_valid() else 0.0
        self._reset_to(lat_deg, lon_deg, accuracy_m, age_s)
        return OK

    def take_global_position(self, message: Message) -> None:
        """Fuse a GLOBAL_POSITION_SENSOR (296). Its time stamps are ignored: EKF2_AGP0_DELAY (ms) is its age."""
        is_ours = message.id == self.parameters["EKF2_AGP0_ID"] != 0  # 0: the slot is off
        if not message.eph > 0 or not is_ours or not int(self.parameters["EKF2_AGP0_CTRL"]) & 1:
            return
        self._is_vision, noise_m = False, max(message.eph, self.parameters["EKF2_AGP0_NOISE"])
        self._take(message.lat / 1e7, message.lon / 1e7, message.alt, noise_m)

    def take_odometry(self, message: Message) -> None:
        """Fuse the position of an ODOMETRY in the local frame, as external vision. Its time stamp is ignored."""
        variance_m2, is_used = message.pose_covariance[0], int(self.parameters["EKF2_EV_CTRL"]) & 1
        if not is_used or self.origin is None or message.frame_id != mavlink.MAV_FRAME_LOCAL_NED:
            return
        if not all(map(math.isfinite, (message.x, message.y, message.z, variance_m2))):
            return
        lat_deg, lon_deg = beside(self.origin[0], self.origin[1], complex(message.y, message.x))
        self._is_vision, noise_m = True, max(math.sqrt(variance_m2), self.parameters["EKF2_EVP_NOISE"])
        self._take(lat_deg, lon_deg, self.origin[2], noise_m)

    @property
    def _silent_s(self) -> float:
        """The time after which no position of ours is fused any more."""
        return _VISION_SILENT_AFTER_S if self._is_vision else _SILENT_AFTER_S

    def _take(self, lat_deg: float, lon_deg: float, alt_m: float, noise_m: float) -> None:
        """Fuse a position, good to `noise_m`."""
        is_starting = self.now_s - self._other_heard_s > self._silent_s
        is_late = self.now_s - self._other_s > _RESET_AFTER_S
        self._other_heard_s = self.now_s
        delay, gate = ("EKF2_EV_DELAY", "EKF2_EVP_GATE") if self._is_vision else ("EKF2_AGP0_DELAY", "EKF2_AGP0_GATE")
        delay_s = self.parameters[delay] / 1e3
        moved_m = self.velocity_m_s * delay_s
        innovation_m = self._innovation_m(lat_deg, lon_deg) + moved_m
        variance_m2 = self.sd_m**2 + noise_m**2
        if self.origin is None:
            self.origin = lat_deg, lon_deg, alt_m
            self._reset_to(lat_deg, lon_deg, noise_m)
        elif abs(innovation_m) <= self.parameters[gate] * math.sqrt(variance_m2):
            gain = self.sd_m**2 / variance_m2
            self.error_m += gain * innovation_m
            self.sd_m *= math.sqrt(1 - gain)
        elif self.now_s - self._passed_s > _AIDING_GONE_S and (is_starting or is_late):
            self._reset_to(lat_deg, lon_deg, noise_m, delay_s)
        else:
            return
        self._other_s = self._fused_s = self.now_s

    def _is_valid(self) -> bool:
        return self.now_s - self._aided_s <= self.parameters["EKF2_NOAID_TOUT"] / 1e6
