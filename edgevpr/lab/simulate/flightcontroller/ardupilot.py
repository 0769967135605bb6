"""The rules of ArduPilot 4.7-dev (October 2025): NavEKF3, the failsafe of the copter, arming, command 43003.

Times and limits are those of the source: AP_NavEKF3.h (deadReckonDeclare_ms, posRetryTimeNoVel_ms,
posRetryTimeUseVel_ms, tiltDriftTimeMax_ms), AP_NavEKF3_PosVelFusion.cpp (setLatLng), ekf_check.cpp, AP_Arming.cpp. What
a copter does without GPS was seen in its own simulator. How fast an estimate goes wrong is a plain model.
"""

import math

from edgevpr.lab.simulate.flightcontroller.lag import Lag
from edgevpr.lab.simulate.flightcontroller.parameters import ARDUPILOT, ARDUPILOT_KINDS, SIMULATOR, Parameters
from edgevpr.lab.simulate.flightcontroller.receivers import FIX_3D, ExternalNavigation, Measurement, Receivers
from edgevpr.lab.simulate.flightcontroller.reckoning import Reckoning
from edgevpr.lab.simulate.flightcontroller.truth import Motion, Truth
from edgevpr.mavlink.wire import Message, mavlink

_DEAD_RECKONING_S = 1.0
_POSITION_LOST_S, _POSITION_LOST_WITH_VELOCITY_S = 7.0, 10.0
_AIDING_LOST_S = 15.0
_OLDEST_FIX_S = 5.0
_GATE_SD = 5.0  # EK3_POS_I_GATE, EK3_VEL_I_GATE
_POSITION_NOISE_M = 0.5  # EK3_POSNE_M_NSE
_ALIGNED_AFTER_S, _AGAIN_AFTER_S = 5.0, 0.5  # with GPS, from the start and later; a real one starts in half a minute
_BAD_FOR_S = 1.0  # ten checks of the filter in a row, ten a second
_SD_GROWS_M_S = {"plane": 1.0, "copter": 3.0, "rover": 3.0}
_INERTIAL_M_S2 = 0.05 + 0j  # the error of the acceleration that a copter or a rover reckons with
_WIND_LEARNT_IN_S = 5.0
# Of the wind that came without GPS: accelerometers and air speed notice the rest. A plane in ArduPilot's simulator was
# 767 m off after 150 s in 6 m/s.
_UNNOTICED = 0.85

_GUIDED, _LAND, _HOLD = {"copter": 4, "plane": 15, "rover": 15}, 9, 4
_TAKEOFF, _AUTO = 13, 10  # of a plane
_NEEDS_POSITION = {"copter": {3, 4, 5, 6, 7, 16}, "rover": {10, 11, 12, 15}, "plane": set()}
_TYPES = {
    "copter": mavlink.MAV_TYPE_QUADROTOR,
    "plane": mavlink.MAV_TYPE_FIXED_WING,
    "rover": mavlink.MAV_TYPE_GROUND_ROVER,
}
_GPS, _EXTERNAL = 3, 6  # EK3_SRCn_POSXY
_OK, _FAILED, _DENIED = mavlink.MAV_RESULT_ACCEPTED, mavlink.MAV_RESULT_FAILED, mavlink.MAV_RESULT_DENIED
_HAS_POSITION = mavlink.EKF_POS_HORIZ_REL | mavlink.EKF_POS_HORIZ_ABS


class ArduPilot:
    """The estimator of a copter, plane or rover and what hangs on it. `motion` is landed where the failsafe says so."""

    firmware = mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA
    version = 4 << 24 | 7 << 16  # 4.7.0, type "dev"
    filter_report = mavlink.MAVLINK_MSG_ID_EKF_STATUS_REPORT
    default_hz: dict[int, float] = {}  # noqa: RUF012 - nothing but heartbeats unless it is asked for

    def __init__(self, kind: str, motion: Motion) -> None:
        self.kind, self.vehicle_type = kind, _TYPES[kind]
        self.parameters = Parameters({**ARDUPILOT, **ARDUPILOT_KINDS[kind], **SIMULATOR}, bytewise=False)
        self.receivers, self.external = Receivers(self.parameters), ExternalNavigation(self.parameters)
        self.reckoning = Reckoning()
        self.origin: tuple[float, float, float] | None = None
        self.mode, self.is_armed = (_GUIDED[kind] if motion.is_flying else 0), motion.is_flying
        self.texts: list[tuple[int, str]] = []
        self.test_ratio = 0.0
        self._motion = motion
        self._lag = Lag()
        self._source_set = 1
        self._is_aiding = False
        self._passed_s = -math.inf  # when a position last passed the gate
        self._used: Measurement | None = None
        self._good_since_s: float | None = None
        self._bad_since_s: float | None = None
        self._has_failed = self._has_ever_passed = False
        self._wind_m_s = 0j  # as the filter knows it
        self._frozen: tuple[float, float] | None = None  # the position that is reported without aiding

    def lose_gps(self, truth: Truth, now_s: float) -> None:
        """Be as one that had GPS until a while ago, and has none any more."""
        self.parameters.set("SIM_GPS1_ENABLE", 0)
        self._start_aiding(truth, (truth.lat_deg, truth.lon_deg, truth.alt_m), now_s - 2 * _DEAD_RECKONING_S)
        self.texts.clear()

    def step(self, truth: Truth, wind_m_s: complex, now_s: float, dt_s: float) -> None:
        """Let sensors report, and the estimator and its watchers follow."""
        self.receivers.step(truth, now_s)
        measured = self._measured(now_s)
        is_new, self._used = measured is not None and measured != self._used, measured
        if not self._is_aiding:
            self._wait_for_aiding(truth, measured, now_s)
        elif is_new:
            self._take(truth, measured, wind_m_s, now_s)
        if self._is_aiding:
            self._reckon(wind_m_s, now_s, dt_s)
        elif self._frozen:
            self.reckoning.reset_to(truth, *self._frozen, self.reckoning.sd_m)
        self._watch(truth, now_s)

    def flags(self, now_s: float) -> int:
        """Return the flags of EKF_STATUS_REPORT."""
        flags = mavlink.EKF_ATTITUDE | mavlink.EKF_VELOCITY_VERT | mavlink.EKF_POS_VERT_ABS
        if not self._is_aiding:
            return flags | mavlink.EKF_VELOCITY_HORIZ | mavlink.EKF_CONST_POS_MODE
        is_lost = self._is_position_lost(now_s)
        if not is_lost:
            flags |= mavlink.EKF_POS_HORIZ_ABS | mavlink.EKF_PRED_POS_HORIZ_ABS
        if not is_lost or self.kind == "plane":  # air speed and no sideslip: relative to the wind
            flags |= mavlink.EKF_VELOCITY_HORIZ | mavlink.EKF_POS_HORIZ_REL | mavlink.EKF_PRED_POS_HORIZ_REL
        return flags | (mavlink.EKF_GPS_GLITCHING if self.test_ratio > 1 else 0)

    def take_fix(self, command: Message, truth: Truth, now_s: float) -> int:
        """Judge command 43003, and set the position where it is accepted."""
        is_global = command.frame in (mavlink.MAV_FRAME_GLOBAL, mavlink.MAV_FRAME_GLOBAL_INT)
        if not is_global or not math.isnan(command.z):
            return _DENIED
        sent_s = self._lag.corrected(command.param1, now_s)
        if now_s - self._passed_s < _DEAD_RECKONING_S or not self._is_aiding or self.origin is None:
            return _FAILED
        # A processing time that is no number moves nothing; C casts it to 0.
        taken_s = sent_s - (command.param2 if math.isfinite(command.param2) else 0.0)
        age_s = now_s - max(min(taken_s, now_s), now_s - _OLDEST_FIX_S)
        sd_m = 0.0 if math.isnan(command.param3) else command.param3
        moved_m = self.reckoning.velocity_m_s(truth) * age_s
        self.reckoning.reset_to(truth, command.x / 1e7, command.y / 1e7, max(sd_m, _POSITION_NOISE_M))
        self.reckoning.error_m += moved_m
        return _OK

    def take_global_position(self, message: Message, truth: Truth, now_s: float) -> None:
        """Ignore a GLOBAL_POSITION_SENSOR (296): only an open pull request knows it."""

    def set_origin(self, lat_deg: float, lon_deg: float, alt_m: float, truth: Truth) -> bool:
        """Set the origin, once; return whether it was set."""
        if self.origin is not None:
            return False
        self.origin = lat_deg, lon_deg, alt_m
        return True

    def use_source_set(self, number: float) -> int:
        """Obey MAV_CMD_SET_EKF_SOURCE_SET (42007)."""
        if number not in (1, 2, 3):
            return _DENIED
        self._source_set = int(number)
        return _OK

    def set_mode(self, mode: int) -> bool:
        """Change the flight mode; one that needs a position is refused without one."""
        if mode in _NEEDS_POSITION[self.kind] and not self.origin:
            return False
        self.mode = mode
        return True

    def why_not_arm(self, now_s: float) -> str | None:
        """Return the reason of the pre-arm checks, None where they pass."""
        second = self.receivers.second
        if not self._is_aiding:
            return "Need Position Estimate"
        if self.parameters["VISO_TYPE"] and not self.external.is_healthy(now_s):
            return "VisOdom: not healthy"
        if self._source == _GPS and self.receivers.first.fix_type < FIX_3D:
            return "GPS 1: Bad fix"
        if self.receivers.has_second and second.fix_type < FIX_3D:
            return "GPS 2: Bad fix"
        if self.receivers.has_second and not second.is_healthy:
            return "GPS 2: not healthy"
        return None

    def take_off(self, height_m: float, truth: Truth) -> int:
        """Obey MAV_CMD_NAV_TAKEOFF, whose height is over home; only a copter in GUIDED does."""
        if self.kind != "copter" or self.mode != _GUIDED["copter"] or not self.is_armed:
            return _FAILED
        self._motion.take_off(height_m)
        return _OK

    def arm(self, is_armed: bool) -> None:
        """Arm or disarm; a plane whose mode is TAKEOFF or AUTO then takes off."""
        self.is_armed = is_armed
        if is_armed and self.kind == "plane" and self.mode in (_TAKEOFF, _AUTO):
            self._motion.take_off(self.parameters["TKOFF_ALT"])

    @property
    def _source(self) -> int:
        return self.parameters[f"EK3_SRC{self._source_set}_POSXY"]

    def _measured(self, now_s: float) -> Measurement | None:
        if self._source == _EXTERNAL:
            return self.external.measured(self.origin, now_s)
        primary = self.receivers.primary
        return primary.last if self._source == _GPS and primary.fix_type >= FIX_3D else None

    def _wait_for_aiding(self, truth: Truth, measured: Measurement | None, now_s: float) -> None:
        if measured is None:
            self._good_since_s = None
            return
        self._good_since_s = self._good_since_s if self._good_since_s is not None else now_s
        if now_s - self._good_since_s >= (_AGAIN_AFTER_S if self._has_ever_passed else _ALIGNED_AFTER_S):
            self._start_aiding(truth, (measured.lat_deg, measured.lon_deg, measured.alt_m), now_s)

    def _start_aiding(self, truth: Truth, at: tuple[float, float, float], passed_s: float) -> None:
        self._is_aiding, self._passed_s, self._frozen = True, passed_s, None
        if self.origin is None:
            self.origin = at
            self._say(mavlink.MAV_SEVERITY_INFO, "EKF3 IMU0 origin set")
        self.reckoning.reset_to(truth, at[0], at[1], _POSITION_NOISE_M)
        self.reckoning.drift_m_s = 0j
        is_by_gps = self._source == _GPS
        self._say(mavlink.MAV_SEVERITY_INFO, f"EKF3 IMU0 is using {'GPS' if is_by_gps else 'external nav data'}")

    def _take(self, truth: Truth, measured: Measurement, wind_m_s: complex, now_s: float) -> None:
        self.test_ratio = self.reckoning.test_ratio(truth, measured, _GATE_SD)
        if self.test_ratio <= 1:
            self.reckoning.fuse(truth, measured)
        elif now_s - self._passed_s > _POSITION_LOST_WITH_VELOCITY_S:
            self.reckoning.reset_to(truth, measured.lat_deg, measured.lon_deg, measured.sd_m)
        else:
            return  # velocities are still used: it does not drift
        self._passed_s = now_s
        self._wind_m_s += (wind_m_s - self._wind_m_s) * min(1.0, 0.2 / _WIND_LEARNT_IN_S)

    def _reckon(self, wind_m_s: complex, now_s: float, dt_s: float) -> None:
        """Go wrong: a plane by the wind that it does not know, the others by their accelerometers."""
        if self._used is not None and now_s - self._used.t_s < _DEAD_RECKONING_S:
            self.reckoning.drift_m_s = 0j
            self.reckoning.step(dt_s, 0.0)
            return
        if self.kind == "plane":
            self.reckoning.drift_m_s = _UNNOTICED * (self._wind_m_s - wind_m_s) if self._motion.is_flying else 0j
        elif self._motion.is_flying:
            self.reckoning.drift_m_s += _INERTIAL_M_S2 * dt_s
        self.reckoning.step(dt_s, _SD_GROWS_M_S[self.kind])

    def _is_position_lost(self, now_s: float) -> bool:
        return now_s - self._passed_s > (_POSITION_LOST_WITH_VELOCITY_S if self.kind == "plane" else _POSITION_LOST_S)

    def _watch(self, truth: Truth, now_s: float) -> None:
        """Stop aiding, and land a copter, when the position is lost for too long. Landed, it disarms."""
        if self.is_armed and self.kind == "copter" and self.mode == _LAND and not self._motion.is_flying:
            self.is_armed = False
        lost_s = now_s - self._passed_s
        if self._is_aiding and self.kind != "plane" and lost_s > _AIDING_LOST_S:
            self._is_aiding, self._good_since_s, self._frozen = False, None, self.reckoning.place(truth)
            self._say(mavlink.MAV_SEVERITY_WARNING, "EKF3 IMU0 stopped aiding")
        is_good = bool(self.flags(now_s) & _HAS_POSITION)
        self._has_ever_passed |= is_good
        if self.kind == "plane" or not self._has_ever_passed:
            return
        if is_good == (not self._has_failed):
            self._bad_since_s = None
            return
        self._bad_since_s = now_s if self._bad_since_s is None else self._bad_since_s
        if now_s - self._bad_since_s < _BAD_FOR_S:
            return
        self._has_failed, self._bad_since_s = not is_good, None
        if is_good:
            self._say(mavlink.MAV_SEVERITY_CRITICAL, "EKF Failsafe Cleared")
            return
        self._say(mavlink.MAV_SEVERITY_CRITICAL, "EKF variance")
        if self.is_armed and self.mode in _NEEDS_POSITION[self.kind]:
            self.mode = _LAND if self.kind == "copter" else _HOLD
            name = "LAND" if self.kind == "copter" else "HOLD"
            self._say(mavlink.MAV_SEVERITY_CRITICAL, f"EKF Failsafe: changed to {name} Mode")
            self._motion.land()

    def _say(self, severity: int, text: str) -> None:
        self.texts.append((severity, text))
