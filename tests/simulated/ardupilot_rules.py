"""The simulated ArduPilot: the rules of 4.7-dev (October 2025) for its filter NavEKF3, ODOMETRY and command 43003.
Used by `controller`.

Times and limits are from the source code: AP_NavEKF3.h (deadReckonDeclare_ms, posRetryTimeNoVel_ms,
posRetryTimeUseVel_ms, tiltDriftTimeMax_ms), AP_NavEKF3_PosVelFusion.cpp (setLatLng), AP_VisualOdom. The
behaviour of a copter without GPS was observed in ArduPilot's own simulator."""

import math

from edgevpr.core.arrays import LatLon
from edgevpr.mavlink.wire import Message, mavlink
from simulated.firmware import ARDUPILOT, ARDUPILOT_PLANE, DENIED, FAILED, OK, POSITION_NOISE_M, Firmware
from simulated.motion import Motion, displace
from simulated.sensors import FIX_3D, PositionMeasurement

_DEAD_RECKONING_S = 1.0
_POSITION_LOST_S = 7.0
_POSITION_LOST_WITH_VELOCITY_S = 10.0
_AIDING_LOST_S = 15.0
_OLDEST_FIX_S = 5.0
_ALIGNED_AFTER_S = 5.0  # of GPS, at the start; a real one needs half a minute
_REALIGNED_AFTER_S = 0.5
_ODOMETRY_GOOD_FOR_S = 0.3
_MIN_NOISE_M = 0.2  # of ODOMETRY: VISO_POS_M_NSE
_MAX_NOISE_M = 100.0
# The share of a wind that comes up without GPS which neither accelerometers nor airspeed reveal to the filter. A plane
# in ArduPilot's simulator was 767 m off after 150 s in 6 m/s.
_UNNOTICED_SHARE = 0.85
_GPS = 3  # EK3_SRCn_POSXY
_EXTERNAL = 6


class ArduPilot(Firmware):
    """A copter or plane with ArduPilot."""

    number = mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA
    version = 4 << 24 | 7 << 16  # 4.7.0, type "dev"
    filter_report = mavlink.MAVLINK_MSG_ID_EKF_STATUS_REPORT  # nothing but heartbeats comes without being asked for

    def __init__(self, kind: str, motion: Motion) -> None:
        super().__init__(kind, motion, {**ARDUPILOT, **(ARDUPILOT_PLANE if kind == "plane" else {})})
        self._source_set = 1
        self._is_aiding = False
        self._passed_s = -math.inf  # when a measured position was last within the gate
        self._odometry: tuple[complex, float, float] | None = None  # vector from the origin, standard deviation, time
        self._used: PositionMeasurement | None = None
        self._good_since_s, self._aligned_after_s = math.inf, _ALIGNED_AFTER_S

    def lose_gps(self) -> None:
        self.parameters.set("SIM_GPS1_ENABLE", 0)
        self._start_aiding(self.truth.point, self.truth.alt_m, self.now_s - 2 * _DEAD_RECKONING_S)

    def _estimate(self, wind_m_s: complex, dt_s: float) -> None:
        if self._is_aiding and self.kind == "copter" and self.now_s - self._passed_s > _AIDING_LOST_S:
            self._is_aiding, self._good_since_s = False, math.inf
        measured, before = self._measure(), self._used
        self._used = measured
        self.estimator.predict(dt_s)
        if not self._is_aiding:
            self._wait_for_aiding(measured)
        elif measured is not None and measured != before and self._fuse(measured):
            self._learn_wind(wind_m_s)
        is_aided = measured is not None and self.now_s - measured.t_s < _DEAD_RECKONING_S
        if self._is_aiding and not is_aided:
            self._drift(wind_m_s, dt_s, _UNNOTICED_SHARE)
        elif not self._is_aiding:
            self.estimator.velocity_error_m_s = -self.truth.velocity_m_s  # it takes itself for standing still

    def flags(self) -> int:
        flags: int = mavlink.EKF_ATTITUDE | mavlink.EKF_VELOCITY_VERT | mavlink.EKF_POS_VERT_ABS
        if not self._is_aiding:
            return flags | int(mavlink.EKF_VELOCITY_HORIZ | mavlink.EKF_CONST_POS_MODE)
        is_plane = self.kind == "plane"
        is_lost = self.now_s - self._passed_s > (_POSITION_LOST_WITH_VELOCITY_S if is_plane else _POSITION_LOST_S)
        if not is_lost:
            flags |= mavlink.EKF_POS_HORIZ_ABS | mavlink.EKF_PRED_POS_HORIZ_ABS
        if not is_lost or is_plane:  # air speed and no sideslip: relative to the wind
            flags |= mavlink.EKF_VELOCITY_HORIZ | mavlink.EKF_POS_HORIZ_REL | mavlink.EKF_PRED_POS_HORIZ_REL
        return flags | (mavlink.EKF_GPS_GLITCHING if self.test_ratio > 1 else 0)

    def take_fix(self, command: Message) -> int:
        is_global = command.frame in (mavlink.MAV_FRAME_GLOBAL, mavlink.MAV_FRAME_GLOBAL_INT)
        if not is_global or not math.isnan(command.z):
            return DENIED
        if self.now_s - self._passed_s < _DEAD_RECKONING_S or not self._is_aiding or self.origin is None:
            return FAILED
        # A processing time that is not finite counts as 0, as ArduPilot casts it.
        age_s = min(max(command.param2, 0.0), _OLDEST_FIX_S) if math.isfinite(command.param2) else 0.0
        sd_m = POSITION_NOISE_M if math.isnan(command.param3) else max(command.param3, POSITION_NOISE_M)
        self._reset_to((command.x / 1e7, command.y / 1e7), sd_m, age_s)
        return OK

    def take_odometry(self, message: Message) -> None:
        """Take the position of an ODOMETRY if its frames are right, its quality is high and VISO_TYPE is set."""
        frames = (mavlink.MAV_FRAME_LOCAL_FRD, mavlink.MAV_FRAME_BODY_FRD)
        is_taken = self.parameters["VISO_TYPE"] and message.quality >= self.parameters["VISO_QUAL_MIN"]
        if is_taken and (message.frame_id, message.child_frame_id) == frames:
            variances = [message.pose_covariance[number] for number in (0, 6, 11)]
            # The cube root is ArduPilot's own.
            sd_m = 0.0 if math.isnan(variances[0]) else sum(variance**2 for variance in variances) ** (1 / 3)
            sd_m = min(_MAX_NOISE_M, max(_MIN_NOISE_M, sd_m))
            self._odometry = complex(message.y, message.x), sd_m, self.now_s

    def use_source_set(self, number: float) -> int:
        if number not in (1, 2, 3):
            return DENIED
        self._source_set = int(number)
        return OK

    @property
    def _source(self) -> float:
        return self.parameters[f"EK3_SRC{self._source_set}_POSXY"]

    def _measure(self) -> PositionMeasurement | None:
        """Return the last position by the source in use; None if there is no recent one."""
        if self._source == _GPS:
            return self.receivers.primary if self.receivers.primary.fix_type >= FIX_3D else None
        if self._source != _EXTERNAL or self._odometry is None or self.origin is None:
            return None
        vector_m, sd_m, t_s = self._odometry
        if self.now_s - t_s > _ODOMETRY_GOOD_FOR_S:
            return None
        return PositionMeasurement(point=displace(self.origin[:2], vector_m), alt_m=self.origin[2], sd_m=sd_m, t_s=t_s)

    def _fuse(self, measured: PositionMeasurement) -> bool:
        """Fuse a measured position that is within the gate, and its velocity. Reset the estimate to one outside of the
        gate if none was within it for ten seconds. Returns True in both cases."""
        sd_m = max(POSITION_NOISE_M, measured.sd_m)
        self.test_ratio = self._ratio(measured.point, sd_m, measured.age_s)
        if not self._fuse_position(measured.point, sd_m, measured.age_s):
            if self.now_s - self._passed_s <= _POSITION_LOST_WITH_VELOCITY_S:
                return False
            self._reset_to(measured.point, sd_m, measured.age_s)
        self._fuse_velocity(measured)
        self._passed_s = self.now_s
        return True

    def _wait_for_aiding(self, measured: PositionMeasurement | None) -> None:
        is_good = measured is not None and measured.can_align
        self._good_since_s = min(self._good_since_s, self.now_s) if is_good else math.inf
        if measured is not None and not is_good:
            self._aligned_after_s = _ALIGNED_AFTER_S
        if measured is not None and self.now_s - self._good_since_s >= self._aligned_after_s:
            self._start_aiding(measured.point, measured.alt_m, self.now_s)

    def _start_aiding(self, point: LatLon, alt_m: float, passed_s: float) -> None:
        self._is_aiding, self._passed_s, self._aligned_after_s = True, passed_s, _REALIGNED_AFTER_S
        self.origin = self.origin or (*point, alt_m)
        self._reset_to(point, POSITION_NOISE_M)
        self.estimator.velocity_error_m_s = 0j
