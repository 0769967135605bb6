"""The simulated ArduPilot: the rules of 4.7-dev (October 2025) for its filter NavEKF3 and command 43003.
Used by `controller`.

Times and limits are from the source code: AP_NavEKF3.h (deadReckonDeclare_ms, posRetryTimeNoVel_ms,
posRetryTimeUseVel_ms, tiltDriftTimeMax_ms), AP_NavEKF3_PosVelFusion.cpp (setLatLng). The
behaviour of a copter without GPS was observed in ArduPilot's own simulator.
"""

import math

from edgevpr.lab.simulate.firmware import (
    ARDUPILOT,
    ARDUPILOT_PLANE,
    DENIED,
    FAILED,
    GATE_SD,
    OK,
    POSITION_NOISE_M,
    Firmware,
)
from edgevpr.lab.simulate.motion import Motion
from edgevpr.lab.simulate.sensors import FIX_3D, Origin, PositionMeasurement
from edgevpr.mavlink.wire import Message, mavlink

_DEAD_RECKONING_S = 1.0
_POSITION_LOST_S, _POSITION_LOST_WITH_VELOCITY_S = 7.0, 10.0
_AIDING_LOST_S = 15.0
_OLDEST_FIX_S = 5.0
_ALIGNED_AFTER_S, _AGAIN_AFTER_S = 5.0, 0.5  # of GPS, at the start and later; a real one needs half a minute
# The share of a wind that comes up without GPS which neither accelerometers nor airspeed reveal to the filter. A plane
# in ArduPilot's simulator was 767 m off after 150 s in 6 m/s.
_UNNOTICED_SHARE = 0.85

_GPS, _EXTERNAL = 3, 6  # EK3_SRCn_POSXY


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
        self._used: PositionMeasurement | None = None
        self._good_since_s, self._aligned_after_s = math.inf, _ALIGNED_AFTER_S
        self._frozen: tuple[float, float] | None = None  # the position that is reported after aiding

    def lose_gps(self) -> None:
        self.parameters.set("SIM_GPS1_ENABLE", 0)
        here = (self.truth.lat_deg, self.truth.lon_deg, self.truth.alt_m)
        self._start_aiding(here, self.now_s - 2 * _DEAD_RECKONING_S)

    def _estimate(self, wind_m_s: complex, dt_s: float) -> None:
        if self._is_aiding and self.kind == "copter" and self.now_s - self._passed_s > _AIDING_LOST_S:
            self._is_aiding, self._good_since_s, self._frozen = False, math.inf, self.place
        measured, before, self._used = self._measured(), self._used, self._measured()
        self.estimator.predict(dt_s)
        if not self._is_aiding:
            self._wait_for_aiding(measured)
        elif measured is not None and measured != before and self._fuse(measured):
            self._learn_wind(wind_m_s)
        is_aided = measured is not None and self.now_s - measured.t_s < _DEAD_RECKONING_S
        if self._is_aiding and not is_aided:
            self._go_wrong(wind_m_s, dt_s, _UNNOTICED_SHARE)
        elif not self._is_aiding:
            self.estimator.velocity_error_m_s = -self.truth.velocity_m_s  # it takes itself for standing still
            if self._frozen:
                self._reset_to(*self._frozen, self.sd_m)

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
        sd_m = 0.0 if math.isnan(command.param3) else command.param3
        self._reset_to(command.x / 1e7, command.y / 1e7, max(sd_m, POSITION_NOISE_M), age_s)
        return OK

    def set_origin(self, at: Origin) -> bool:
        """Set the origin, unless there is one. Returns True if it was set."""
        return self.origin is None and super().set_origin(at)

    def use_source_set(self, number: float) -> int:
        if number not in (1, 2, 3):
            return DENIED
        self._source_set = int(number)
        return OK

    @property
    def _source(self) -> float:
        return self.parameters[f"EK3_SRC{self._source_set}_POSXY"]

    def _measured(self) -> PositionMeasurement | None:
        if self._source == _EXTERNAL:
            return self.external.measured(self.origin, self.now_s)
        primary = self.receivers.primary
        return primary if self._source == _GPS and primary.fix_type >= FIX_3D else None

    def _fuse(self, measured: PositionMeasurement) -> bool:
        """Fuse a measured position that is within the gate, `GATE_SD` standard deviations of the estimate, and its
        velocity. Reset the estimate to one outside of the gate if none was within it for ten seconds. Returns True in
        both cases."""
        sd_m = max(POSITION_NOISE_M, measured.sd_m) * measured.noise_scale
        innovation_m = self._innovation_m(measured.lat_deg, measured.lon_deg) + self.velocity_m_s * measured.age_s
        self.test_ratio = abs(innovation_m) / (GATE_SD * math.hypot(self.sd_m, sd_m))
        if self.test_ratio <= 1:
            self.estimator.correct(0, innovation_m, sd_m)
        elif self.now_s - self._passed_s > _POSITION_LOST_WITH_VELOCITY_S:
            self._reset_to(measured.lat_deg, measured.lon_deg, sd_m, measured.age_s)
        else:
            return False
        self._fuse_velocity(measured)
        self._passed_s = self.now_s
        return True

    def _wait_for_aiding(self, measured: PositionMeasurement | None) -> None:
        if measured is None:
            self._good_since_s = math.inf
            return
        self._good_since_s = min(self._good_since_s, self.now_s)
        if self.now_s - self._good_since_s >= self._aligned_after_s:
            self._start_aiding((measured.lat_deg, measured.lon_deg, measured.alt_m), self.now_s)

    def _start_aiding(self, at: Origin, passed_s: float) -> None:
        self._is_aiding, self._passed_s, self._aligned_after_s = True, passed_s, _AGAIN_AFTER_S
        self.set_origin(at)
        self._reset_to(at[0], at[1], POSITION_NOISE_M)
        self.estimator.velocity_error_m_s = 0j
