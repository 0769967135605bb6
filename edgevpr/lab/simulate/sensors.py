"""Sensors of a simulated flight controller: its GPS, a second GPS by GPS_INPUT messages, external navigation by
ODOMETRY messages. Used by `firmware`. Rules and numbers are those of ArduPilot 4.7-dev: AP_GPS,
AP_GPS_MAV and AP_VisualOdom."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

from edgevpr.lab.simulate.motion import TrueState, beside
from edgevpr.mavlink.wire import Message, mavlink

NO_FIX, FIX_3D = mavlink.GPS_FIX_TYPE_NO_FIX, mavlink.GPS_FIX_TYPE_3D_FIX
_BEST_FIX = mavlink.GPS_FIX_TYPE_RTK_FIXED  # as ArduPilot's simulator has it
_BY_MAVLINK = 14  # value of GPS1_TYPE and GPS2_TYPE
GPS_S = 0.2  # from one report of the simulated GPS to the next
_SIMULATED_SD_M = 0.3
_TIMEOUT_S = 4.0
_LEAST_NOISE_M, _MOST_NOISE_M = 0.2, 100.0  # VISO_POS_M_NSE, and the upper limit
_EXTERNAL_GOOD_FOR_S = 0.3

Origin = tuple[float, float, float]  # latitude, longitude, altitude above sea level


@dataclass(frozen=True, slots=True, kw_only=True)
class PositionMeasurement:
    """A measured position: degrees, altitude above sea level, the standard deviation of one axis, the time `t_s` of the
    measurement, the velocity (east + 1j * north), and the kind of fix (GPS_FIX_TYPE)."""

    lat_deg: float = 0.0
    lon_deg: float = 0.0
    alt_m: float = 0.0
    sd_m: float = 0.0
    t_s: float = 0.0
    velocity_m_s: complex = 0j
    fix_type: int = NO_FIX


NOTHING = PositionMeasurement()  # of a receiver that is silent


class Receivers:
    """The last reports of two GPS receivers. The first measures the true position plus the glitch that the parameters
    set, while enabled; the second is fed by GPS_INPUT. `primary` is the one in use; the other takes over with a better
    fix."""

    def __init__(self, parameters: Mapping[str, float]) -> None:
        self.first = self.second = NOTHING
        self._uses_second = False
        self._parameters = parameters
        self._due_s = 0.0

    @property
    def primary(self) -> PositionMeasurement:
        return self.second if self._uses_second else self.first

    @property
    def has_second(self) -> bool:
        """True if the parameters set the second receiver to GPS_INPUT messages."""
        return self._parameters.get("GPS2_TYPE", 0) == _BY_MAVLINK

    def step(self, truth: TrueState, now_s: float) -> None:
        """Let the first receiver report if it is due, forget a silent second one, and choose the one in use."""
        if now_s >= self._due_s:
            self._due_s = now_s + GPS_S - 1e-6
            seen = PositionMeasurement(
                lat_deg=truth.lat_deg + self._parameters["SIM_GPS1_GLTCH_X"],
                lon_deg=truth.lon_deg + self._parameters["SIM_GPS1_GLTCH_Y"],
                alt_m=truth.alt_m,
                sd_m=_SIMULATED_SD_M,
                t_s=now_s,
                velocity_m_s=truth.velocity_m_s,
                fix_type=_BEST_FIX,
            )
            if not self._parameters["SIM_GPS1_ENABLE"]:  # reports continue, without a fix
                seen = replace(seen if self.first is NOTHING else self.first, t_s=now_s, fix_type=NO_FIX)
            self.first = seen
        if now_s - self.second.t_s > _TIMEOUT_S:
            self.second = NOTHING
        other = self.first if self._uses_second else self.second
        self._uses_second ^= max(other.fix_type, FIX_3D - 1) > self.primary.fix_type

    def hear(self, message: Message, now_s: float) -> None:
        """Process a GPS_INPUT, if it is for the second receiver."""
        if self.has_second and message.gps_id == 1:
            self.second = PositionMeasurement(
                lat_deg=message.lat / 1e7,
                lon_deg=message.lon / 1e7,
                alt_m=message.alt,
                sd_m=message.horiz_accuracy,
                t_s=now_s,
                velocity_m_s=complex(message.ve, message.vn),
                fix_type=message.fix_type,
            )


class ExternalNavigation:
    """Receives positions relative to the estimator's origin: metres north, east and down, in ODOMETRY messages."""

    def __init__(self, parameters: Mapping[str, float]) -> None:
        self._parameters = parameters
        self._last: tuple[complex, float, float] | None = None  # position, standard deviation, time

    def hear(self, message: Message, now_s: float) -> None:
        """Process an ODOMETRY; one with wrong frames or low quality is ignored, and all are unless VISO_TYPE is set."""
        frames = (mavlink.MAV_FRAME_LOCAL_FRD, mavlink.MAV_FRAME_BODY_FRD)
        if not self._parameters.get("VISO_TYPE", 0) or (message.frame_id, message.child_frame_id) != frames:
            return
        if message.quality >= self._parameters["VISO_QUAL_MIN"]:
            variances = [message.pose_covariance[number] for number in (0, 6, 11)]
            # The cube root is ArduPilot's own.
            sd_m = 0.0 if math.isnan(variances[0]) else sum(variance**2 for variance in variances) ** (1 / 3)
            self._last = complex(message.y, message.x), min(_MOST_NOISE_M, max(_LEAST_NOISE_M, sd_m)), now_s

    def measured(self, origin: Origin | None, now_s: float) -> PositionMeasurement | None:
        """Return the last position in degrees; None if there is no recent one, or `origin` is None."""
        if self._last is None or origin is None or now_s - self._last[2] > _EXTERNAL_GOOD_FOR_S:
            return None
        step_m, sd_m, t_s = self._last
        lat_deg, lon_deg = beside(origin[0], origin[1], step_m)
        return PositionMeasurement(lat_deg=lat_deg, lon_deg=lon_deg, alt_m=origin[2], sd_m=sd_m, t_s=t_s)
