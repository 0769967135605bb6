"""The simulated PX4: the rules of 1.18-beta1 for its filter EKF2, command 43003, message 296 and ODOMETRY, with the
flags of a real one in its own simulator. Used by `controller`. They are from EKF2.cpp, ekf.cpp
(resetGlobalPosToExternalObservation), ekf_helper.cpp (updateHorizontalDeadReckoningstatus, get_ekf_soln_status),
gps_control.cpp, gnss_checks.cpp, aux_global_position.cpp and ev_pos_control.cpp. A 1.17.0 and a 1.18-beta1 were held
beside it (test_px4_contract).

GPS and ours are fused side by side, each within its gate. One that contradicts the estimate resets it only where the
other is not active: a GPS that comes back while ours is active is refused.
"""

import math
from dataclasses import dataclass

from edgevpr.lab.simulate.firmware import FAILED, GATE_SD, NOT_NOW, OK, POSITION_NOISE_M, PX4, Firmware
from edgevpr.lab.simulate.motion import Motion, beside
from edgevpr.lab.simulate.sensors import FIX_3D, PositionMeasurement
from edgevpr.mavlink.wire import Message, mavlink

_AIDING_GONE_S = 1.0  # no_aid_timeout_max
_GOOD_RATIO = 0.1
_RESET_AFTER_S = 7.0  # reset_timeout_max
_SILENT_AFTER_S, _VISION_SILENT_AFTER_S = 5.0, 0.4  # of message 296, and of ODOMETRY
_CHECKS_PASS_AFTER_S = 1.0  # since the last GPS check that failed, in flight
_VISION_RESETS = 5  # _nb_ev_pos_reset_available
_GPS_POSITION, _GPS_VELOCITY = 1, 4  # bits of EKF2_GPS_CTRL
_BIAS_FOLLOWS_S = 10.0
_OLDEST_FIX_S = 15.0
_DEFAULT_ACCURACY_M = 50.0


@dataclass(slots=True)
class _Aid:
    """A source of positions: `is_active` while EKF2 fuses it. The times are those of the last measurement, and of the
    last one that was fused."""

    is_active: bool = False
    heard_s: float = -math.inf
    fused_s: float = -math.inf


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
        self._velocity_s = -math.inf  # when the velocity of GPS was last fused
        self._gps, self._ours = _Aid(), _Aid()
        self._is_vision, self._vision_resets = False, _VISION_RESETS  # ours is ODOMETRY
        self._vision_bias_m: complex | None = None  # of ODOMETRY beside GPS
        self._is_gps_faulty = False
        self._checks_failed_s = self._checks_passed_s = -math.inf
        self._aided_s = -math.inf  # last not purely inertial

    def lose_gps(self) -> None:
        self.parameters.set("SIM_GPS1_ENABLE", 0)
        self.origin = self.truth.lat_deg, self.truth.lon_deg, self.truth.alt_m
        self._gps.fused_s = self.now_s - 2 * _AIDING_GONE_S
        self._aided_s = self.now_s - _AIDING_GONE_S

    def _estimate(self, wind_m_s: complex, dt_s: float) -> None:
        self.estimator.predict(dt_s)
        if self.now_s - self._ours.heard_s > self._silent_s:
            self._ours.is_active = False
        first = self.receivers.first
        if first.t_s != self._gps.heard_s:
            self._gps.heard_s = first.t_s
            if self._hear_gps(first):
                self._learn_wind(wind_m_s)
        fused_s = max(self._gps.fused_s, self._ours.fused_s)
        is_aided, is_flying = self.now_s - fused_s < _AIDING_GONE_S, self.motion.is_flying
        if not is_aided:
            self._go_wrong(wind_m_s, dt_s, 1.0)
        if is_aided or self.kind == "plane" or not is_flying:
            self._aided_s = self.now_s

    def _hear_gps(self, measured: PositionMeasurement) -> bool:
        """Process a report of GPS (Ekf::controlGpsFusion). Returns True if its position was used."""
        control, gps = int(self.parameters["EKF2_GPS_CTRL"]), self._gps
        if not control & _GPS_POSITION:
            gps.is_active = False
        if measured.fix_type < FIX_3D or self.parameters["SIM_GPS_SPOOF"] or not control:
            self._checks_failed_s = self.now_s
        if self.now_s - self._checks_failed_s <= _CHECKS_PASS_AFTER_S:
            gps.is_active &= self.now_s - self._checks_passed_s <= _RESET_AFTER_S
            return False
        self._checks_passed_s = self.now_s
        self.origin = self.origin or (measured.lat_deg, measured.lon_deg, measured.alt_m)
        if control & _GPS_VELOCITY and not self._is_gps_faulty:
            self._velocity_s = self.now_s
            self._fuse_velocity(measured, math.inf)  # nothing else measures it, so one that contradicts resets it
        sd_m = max(POSITION_NOISE_M, measured.sd_m)
        innovation_m = self._innovation_m(measured.lat_deg, measured.lon_deg)
        self.test_ratio = abs(innovation_m) / (GATE_SD * math.hypot(self.sd_m, sd_m))
        if not control & _GPS_POSITION:
            return False
        if self.test_ratio <= 1:
            self.estimator.correct(0, innovation_m, sd_m)
        elif gps.is_active and self.now_s - gps.fused_s <= _RESET_AFTER_S:
            return False
        elif not self._is_gps_faulty and not self._ours.is_active:
            self._reset_to(measured.lat_deg, measured.lon_deg, sd_m)
        else:
            self._is_gps_faulty |= gps.is_active
            gps.is_active = False
            return False
        if not gps.is_active:
            self._vision_bias_m = None  # the next ODOMETRY sets it
        gps.is_active, gps.fused_s, self._is_gps_faulty = True, self.now_s, False
        return True

    @property
    def velocity_ratio(self) -> float:
        """Innovation of the velocity of GPS to its gate; NaN while none is fused."""
        return _GOOD_RATIO if self.now_s - self._velocity_s < _AIDING_GONE_S else math.nan

    def flags(self) -> int:
        flags: int = mavlink.ESTIMATOR_ATTITUDE | mavlink.ESTIMATOR_VELOCITY_VERT | mavlink.ESTIMATOR_POS_VERT_ABS
        if self.origin is None:
            return flags | int(mavlink.ESTIMATOR_CONST_POS_MODE)
        if self._is_valid():
            flags |= mavlink.ESTIMATOR_VELOCITY_HORIZ | mavlink.ESTIMATOR_POS_HORIZ_REL
            flags |= mavlink.ESTIMATOR_POS_HORIZ_ABS
        if self._ours.is_active or self._gps.is_active:
            flags |= mavlink.ESTIMATOR_PRED_POS_HORIZ_REL
        if self._gps.is_active or (self._ours.is_active and not self._is_vision):
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
        self._ours.heard_s = self.now_s
        lat_deg, lon_deg = message.lat / 1e7, message.lon / 1e7
        if self.origin is None:
            self.origin = lat_deg, lon_deg, message.alt
            self._reset_to(lat_deg, lon_deg, noise_m)
            self._ours.is_active, self._ours.fused_s = True, self.now_s
        else:
            self._take_position(lat_deg, lon_deg, noise_m)

    def _take_position(self, lat_deg: float, lon_deg: float, noise_m: float) -> None:
        """Fuse a position of message 296 (AgpSource::update)."""
        delay_s, ours = self.parameters["EKF2_AGP0_DELAY"] / 1e3, self._ours
        if self._correct_within(lat_deg, lon_deg, noise_m, delay_s, self.parameters["EKF2_AGP0_GATE"]):
            pass
        elif ours.is_active and self.now_s - ours.fused_s <= _RESET_AFTER_S:
            return
        elif not self._gps.is_active:
            self._reset_to(lat_deg, lon_deg, noise_m, delay_s)
        else:
            ours.is_active = False
            return
        ours.is_active, ours.fused_s = True, self.now_s

    def take_odometry(self, message: Message) -> None:
        """Fuse the position of an ODOMETRY in the local frame, as external vision. Its time stamp is ignored."""
        variance_m2, is_used = message.pose_covariance[0], int(self.parameters["EKF2_EV_CTRL"]) & 1
        if not is_used or self.origin is None or message.frame_id != mavlink.MAV_FRAME_LOCAL_NED:
            return
        if not all(map(math.isfinite, (message.x, message.y, message.z, variance_m2))):
            return
        lat_deg, lon_deg = beside(self.origin[0], self.origin[1], complex(message.y, message.x))
        noise_m = max(math.sqrt(variance_m2), self.parameters["EKF2_EVP_NOISE"])
        self._is_vision, self._ours.heard_s = True, self.now_s
        self._take_vision(lat_deg, lon_deg, noise_m)

    def _take_vision(self, lat_deg: float, lon_deg: float, noise_m: float) -> None:
        """Fuse a position of ODOMETRY (Ekf::controlEvPosFusion). Beside GPS it only shows how the vehicle moves: what
        it is off by is a bias, which stays when GPS is lost."""
        ours, delay_s = self._ours, self.parameters["EKF2_EV_DELAY"] / 1e3
        off_m = self._innovation_m(lat_deg, lon_deg) + self.velocity_m_s * delay_s
        if self._gps.is_active:
            if self._vision_bias_m is None or not ours.is_active:
                self._vision_bias_m = off_m
            self._vision_bias_m += (off_m - self._vision_bias_m) * min(1.0, 0.1 / _BIAS_FOLLOWS_S)
        lat_deg, lon_deg = beside(lat_deg, lon_deg, -(self._vision_bias_m or 0j))
        is_used = ours.is_active and self._correct_within(
            lat_deg, lon_deg, noise_m, delay_s, self.parameters["EKF2_EVP_GATE"]
        )
        if not is_used:
            if ours.is_active and self.now_s - ours.fused_s <= _AIDING_GONE_S:
                return
            if ours.is_active and self._vision_resets == 0:
                ours.is_active = False
                return
            self._vision_resets = self._vision_resets - 1 if ours.is_active else _VISION_RESETS
            if self._gps.is_active:
                self._vision_bias_m = off_m
            else:
                self._reset_to(lat_deg, lon_deg, noise_m, delay_s)
        ours.is_active, ours.fused_s = True, self.now_s

    def _correct_within(self, lat_deg: float, lon_deg: float, noise_m: float, delay_s: float, gate_sd: float) -> bool:
        """Fuse a position that is `delay_s` old if it is within the gate. Returns True if it was."""
        innovation_m = self._innovation_m(lat_deg, lon_deg) + self.velocity_m_s * delay_s
        if abs(innovation_m) > gate_sd * math.hypot(self.sd_m, noise_m):
            return False
        self.estimator.correct(0, innovation_m, noise_m)
        return True

    @property
    def _silent_s(self) -> float:
        """The time after which no position of ours is fused any more."""
        return _VISION_SILENT_AFTER_S if self._is_vision else _SILENT_AFTER_S

    def _is_valid(self) -> bool:
        return self.now_s - self._aided_s <= self.parameters["EKF2_NOAID_TOUT"] / 1e6
