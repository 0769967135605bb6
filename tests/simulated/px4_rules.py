"""The simulated PX4: the rules of 1.18-beta1 for its filter EKF2, command 43003, message 296 and ODOMETRY, with the
flags of a real one in its own simulator. Used by `controller`. They are from EKF2.cpp, ekf.cpp
(resetGlobalPosToExternalObservation), ekf_helper.cpp (updateHorizontalDeadReckoningstatus, get_ekf_soln_status),
gps_control.cpp, gnss_checks.cpp, aux_global_position.cpp and ev_pos_control.cpp. A 1.17.0 and a 1.18-beta1 were
compared with it.

GPS and our positions are fused side by side, each within its gate. One that contradicts the estimate resets it only
where the other is not active: a GPS that comes back while ours is active is refused."""

import math
from dataclasses import dataclass

from edgevpr.core.arrays import LatLon
from edgevpr.mavlink.wire import Message, mavlink
from simulated.firmware import FAILED, GATE_SD, NOT_NOW, OK, POSITION_NOISE_M, PX4, Firmware
from simulated.motion import Motion, displace
from simulated.sensors import FIX_3D, PositionMeasurement

_AIDING_GONE_S = 1.0  # no_aid_timeout_max
_GOOD_RATIO = 0.1
_RESET_AFTER_S = 7.0  # reset_timeout_max
_SENSOR_SILENT_AFTER_S = 5.0  # message 296
_VISION_SILENT_AFTER_S = 0.4  # ODOMETRY
_CHECKS_PASS_AFTER_S = 1.0  # since the last GPS check that failed, in flight
_GPS_POSITION = 1  # bits of EKF2_GPS_CTRL
_GPS_VELOCITY = 4
_BIAS_SHARE = 0.01  # by which the bias of ODOMETRY follows each message, ten a second
_OLDEST_FIX_S = 15.0
_DEFAULT_ACCURACY_M = 50.0


@dataclass(slots=True)
class _Aid:
    """A source of positions: `is_active` while EKF2 fuses it. Times: of the last measurement and the last fused."""

    is_active: bool = False
    received_s: float = -math.inf
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
        self._is_vision = False  # ours is ODOMETRY
        self._vision_bias_m: complex | None = None  # of ODOMETRY while GPS is fused
        self._is_gps_faulty = False
        self._checks_failed_s = self._checks_passed_s = -math.inf
        self._aided_s = -math.inf  # last not purely inertial

    def lose_gps(self) -> None:
        self.parameters.set("SIM_GPS1_ENABLE", 0)
        self.origin = (*self.truth.point, self.truth.alt_m)
        self._gps.fused_s = self.now_s - 2 * _AIDING_GONE_S
        self._aided_s = self.now_s - _AIDING_GONE_S

    def _estimate(self, wind_m_s: complex, dt_s: float) -> None:
        self.estimator.predict(dt_s)
        silent_s = _VISION_SILENT_AFTER_S if self._is_vision else _SENSOR_SILENT_AFTER_S
        self._ours.is_active &= self.now_s - self._ours.received_s <= silent_s
        report = self.receivers.reports[0]
        if report.t_s != self._gps.received_s:
            self._gps.received_s = report.t_s
            if self._take_gps(report):
                self._learn_wind(wind_m_s)
        is_aided = self.now_s - max(self._gps.fused_s, self._ours.fused_s) < _AIDING_GONE_S
        if not is_aided:
            self._drift(wind_m_s, dt_s, 1.0)
        if is_aided or self.kind == "plane":
            self._aided_s = self.now_s

    def _take_gps(self, measured: PositionMeasurement) -> bool:
        """Process a report of GPS (Ekf::controlGpsFusion). Returns True if its position was used."""
        control, gps = int(self.parameters["EKF2_GPS_CTRL"]), self._gps
        takes_position = bool(control & _GPS_POSITION)
        gps.is_active &= takes_position
        if measured.fix_type < FIX_3D or self.parameters["SIM_GPS_SPOOF"] or not control:
            self._checks_failed_s = self.now_s
        if self.now_s - self._checks_failed_s <= _CHECKS_PASS_AFTER_S:
            gps.is_active &= self.now_s - self._checks_passed_s <= _RESET_AFTER_S
            return False
        self._checks_passed_s = self.now_s
        self.origin = self.origin or (*measured.point, measured.alt_m)
        if control & _GPS_VELOCITY and not self._is_gps_faulty:
            self._velocity_s = self.now_s
            self._fuse_velocity(measured, math.inf)  # nothing else measures it, so one that contradicts resets it
        sd_m = max(POSITION_NOISE_M, measured.sd_m)
        self.test_ratio = self._ratio(measured.point, sd_m)
        if not takes_position:
            return False
        was_active, may_reset = gps.is_active, not self._is_gps_faulty and not self._ours.is_active
        is_used = self._fuse_or_reset(gps, measured.point, sd_m, may_reset=may_reset)
        if is_used and not was_active:
            self._vision_bias_m = None  # the next ODOMETRY sets it
        self._is_gps_faulty = not is_used and (self._is_gps_faulty or (was_active and not gps.is_active))
        return is_used

    def _fuse_or_reset(
        self, aid: _Aid, point: LatLon, sd_m: float, *, may_reset: bool, gate_sd: float = GATE_SD
    ) -> bool:
        """Fuse a position within the gate. One that stays outside of it resets the estimate after 7 s or, unless it
        `may_reset`, is no longer fused. Returns True if it was used."""
        if not self._fuse_position(point, sd_m, gate_sd=gate_sd):
            if aid.is_active and self.now_s - aid.fused_s <= _RESET_AFTER_S:
                return False
            if not may_reset:
                aid.is_active = False
                return False
            self._reset_to(point, sd_m)
        aid.is_active, aid.fused_s = True, self.now_s
        return True

    @property
    def velocity_ratio(self) -> float:  # type: ignore[override]
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
        self._reset_to((lat_deg, lon_deg), accuracy_m, age_s)
        return OK

    def take_global_position(self, message: Message) -> None:
        """Fuse a GLOBAL_POSITION_SENSOR (296, AgpSource::update). Its time stamps are ignored."""
        parameters, ours, point = self.parameters, self._ours, (message.lat / 1e7, message.lon / 1e7)
        is_ours = message.id == parameters["EKF2_AGP0_ID"] != 0  # 0: the slot is off
        if not message.eph > 0 or not is_ours or not int(parameters["EKF2_AGP0_CTRL"]) & 1:
            return
        sd_m = max(message.eph, parameters["EKF2_AGP0_NOISE"])
        self._is_vision, ours.received_s = False, self.now_s
        if self.origin is None:
            self.origin = (*point, message.alt)
            self._reset_to(point, sd_m)
        self._fuse_or_reset(ours, point, sd_m, may_reset=not self._gps.is_active, gate_sd=parameters["EKF2_AGP0_GATE"])

    def take_odometry(self, message: Message) -> None:
        """Fuse the position of an ODOMETRY in the local frame, as external vision (Ekf::controlEvPosFusion). Its time
        stamp is ignored. While GPS is fused it only shows motion: what it is off by is a bias, which stays."""
        parameters, ours, variance_m2 = self.parameters, self._ours, message.pose_covariance[0]
        if not int(parameters["EKF2_EV_CTRL"]) & 1 or message.frame_id != mavlink.MAV_FRAME_LOCAL_NED:
            return
        is_whole = all(map(math.isfinite, (message.x, message.y, message.z, variance_m2)))
        if self.origin is None or not is_whole:
            return
        self._is_vision, ours.received_s = True, self.now_s
        point = displace(self.origin[:2], complex(message.y, message.x))
        sd_m, gate_sd = max(math.sqrt(variance_m2), parameters["EKF2_EVP_NOISE"]), parameters["EKF2_EVP_GATE"]
        off_m = self._innovation_m(point)
        if self._gps.is_active:
            if self._vision_bias_m is None or not ours.is_active:
                self._vision_bias_m = off_m
            self._vision_bias_m += (off_m - self._vision_bias_m) * _BIAS_SHARE
        point = displace(point, -(self._vision_bias_m or 0j))
        if not ours.is_active or not self._fuse_position(point, sd_m, gate_sd=gate_sd):
            if ours.is_active and self.now_s - ours.fused_s <= _AIDING_GONE_S:
                return
            if self._gps.is_active:
                self._vision_bias_m = off_m
            else:
                self._reset_to(point, sd_m)
        ours.is_active, ours.fused_s = True, self.now_s

    def _is_valid(self) -> bool:
        return self.now_s - self._aided_s <= self.parameters["EKF2_NOAID_TOUT"] / 1e6
