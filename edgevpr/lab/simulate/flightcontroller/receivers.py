"""Sensors of position: the simulated GPS, a second GPS that a companion plays (GPS_INPUT), and external navigation
(ODOMETRY, VISION_POSITION_ESTIMATE). Rules and numbers are those of ArduPilot 4.7-dev: AP_GPS, AP_GPS_MAV and
AP_VisualOdom."""

import math
from dataclasses import dataclass, replace

from edgevpr.lab.simulate.flightcontroller.parameters import Parameters
from edgevpr.lab.simulate.flightcontroller.truth import Truth, beside
from edgevpr.mavlink.wire import Message, mavlink

NO_FIX, FIX_3D = mavlink.GPS_FIX_TYPE_NO_FIX, mavlink.GPS_FIX_TYPE_3D_FIX
_BEST_FIX = mavlink.GPS_FIX_TYPE_RTK_FIXED  # so good is that of ArduPilot's simulator
_BY_MAVLINK = 14  # of GPS1_TYPE and GPS2_TYPE
GPS_S = 0.2  # from one report of the simulated GPS to the next
SIMULATED_SD_M = 0.3
_TIMEOUT_S = 4.0
_MEAN_INTERVAL_S = 0.215  # a receiver that reports more rarely is not healthy, nor is one that is late twice in a row
_LATE_S, _LATE_TIMES = 0.245, 2
_UNSAID_SD_M = (
    1.0  # of a report without an accuracy: not ArduPilot's, which takes EK3_POSNE_M_NSE and counts satellites
)
_MEAN_OVER = 50  # reports
_POSITION_NOISE_M = (0.2, 100.0)  # VISO_POS_M_NSE, and the most
_EXTERNAL_GOOD_FOR_S = 0.3


@dataclass(frozen=True, slots=True, kw_only=True)
class Measurement:
    """A measured position, degrees, its standard deviation, and when it was measured."""

    lat_deg: float
    lon_deg: float
    alt_m: float
    sd_m: float
    t_s: float
    velocity_m_s: complex = 0j


class Gps:
    """A receiver as the autopilot sees it: its last report, and whether it comes often enough."""

    def __init__(self) -> None:
        self.fix_type = NO_FIX
        self.last: Measurement | None = None
        self._heard_s = -math.inf
        self._mean_s = 0.0
        self._late = 0

    @property
    def is_healthy(self) -> bool:
        """True while reports come at about 5 Hz or more."""
        return self.fix_type >= FIX_3D and 0 < self._mean_s < _MEAN_INTERVAL_S and self._late < _LATE_TIMES

    def report(self, fix_type: int, measured: Measurement) -> None:
        """Take in a report."""
        interval_s = measured.t_s - self._heard_s
        self._heard_s, self.fix_type, self.last = measured.t_s, fix_type, measured
        if interval_s > _TIMEOUT_S:
            self._mean_s = self._late = 0
            return
        self._late = self._late + 1 if interval_s > _LATE_S else 0
        self._mean_s = self._mean_s + (interval_s - self._mean_s) / _MEAN_OVER if self._mean_s else interval_s

    def age(self, now_s: float) -> None:
        """Give up a receiver that has been silent for four seconds."""
        if now_s - self._heard_s > _TIMEOUT_S:
            self.fix_type, self.last, self._mean_s = NO_FIX, None, 0.0


class Receivers:
    """The first GPS, which sees the true position (and its glitch) while it is enabled, and the second one."""

    def __init__(self, parameters: Parameters) -> None:
        self.first, self.second = Gps(), Gps()
        self._parameters = parameters
        self._due_s = 0.0
        self._is_second_primary = False

    @property
    def has_second(self) -> bool:
        """True where the second GPS is one that comes by MAVLink."""
        return self._parameters.get("GPS2_TYPE", 0) == _BY_MAVLINK

    @property
    def primary(self) -> Gps:
        """The receiver in use: another one takes over when it has the better fix."""
        return self.second if self._is_second_primary else self.first

    def step(self, truth: Truth, now_s: float) -> None:
        """Let the simulated receiver report, and the silent ones be given up."""
        if now_s >= self._due_s:
            self._due_s = now_s + GPS_S - 1e-6
            north_deg, east_deg = self._parameters["SIM_GPS1_GLTCH_X"], self._parameters["SIM_GPS1_GLTCH_Y"]
            seen = Measurement(
                lat_deg=truth.lat_deg + north_deg,
                lon_deg=truth.lon_deg + east_deg,
                alt_m=truth.alt_m,
                sd_m=SIMULATED_SD_M,
                t_s=now_s,
                velocity_m_s=truth.velocity_m_s,
            )
            if self._parameters["SIM_GPS1_ENABLE"]:
                self.first.report(_BEST_FIX, seen)
            else:  # it goes on to report, without a fix
                self.first.report(NO_FIX, replace(self.first.last or seen, t_s=now_s))
        self.second.age(now_s)
        primary, other = (self.second, self.first) if self._is_second_primary else (self.first, self.second)
        if max(other.fix_type, FIX_3D - 1) > primary.fix_type:
            self._is_second_primary = not self._is_second_primary

    def hear(self, message: Message, now_s: float) -> None:
        """Take in a GPS_INPUT, where it is for the second receiver."""
        if not self.has_second or message.gps_id != 1:
            return
        has_accuracy = not message.ignore_flags & mavlink.GPS_INPUT_IGNORE_FLAG_HORIZONTAL_ACCURACY
        has_velocity = not message.ignore_flags & mavlink.GPS_INPUT_IGNORE_FLAG_VEL_HORIZ
        self.second.report(
            message.fix_type,
            Measurement(
                lat_deg=message.lat / 1e7,
                lon_deg=message.lon / 1e7,
                alt_m=message.alt,
                sd_m=message.horiz_accuracy if has_accuracy else _UNSAID_SD_M,
                t_s=now_s,
                velocity_m_s=complex(message.ve, message.vn) if has_velocity else 0j,
            ),
        )


class ExternalNavigation:
    """Positions relative to the origin of the estimator, metres north, east and down."""

    def __init__(self, parameters: Parameters) -> None:
        self._parameters = parameters
        self._heard_s = -math.inf
        self._last: tuple[complex, float, float] | None = None  # position, standard deviation, time

    def is_healthy(self, now_s: float) -> bool:
        """Tell whether a message came in the last 0.3 s; it may be one of too low a quality."""
        return now_s - self._heard_s < _EXTERNAL_GOOD_FOR_S

    def hear(self, message: Message, now_s: float) -> None:
        """Take in an ODOMETRY or a VISION_POSITION_ESTIMATE."""
        is_odometry = message.get_type() == "ODOMETRY"
        frames = (mavlink.MAV_FRAME_LOCAL_FRD, mavlink.MAV_FRAME_BODY_FRD)
        if not self._parameters.get("VISO_TYPE", 0):
            return
        if is_odometry and (message.frame_id, message.child_frame_id) != frames:
            return
        self._heard_s = now_s
        if (message.quality if is_odometry else 0) < self._parameters["VISO_QUAL_MIN"]:
            return
        covariance = message.pose_covariance if is_odometry else message.covariance
        # The cube root is ArduPilot's own.
        sd_m = 0.0 if math.isnan(covariance[0]) else sum(covariance[each] ** 2 for each in (0, 6, 11)) ** (1 / 3)
        least_m, most_m = _POSITION_NOISE_M
        self._last = complex(message.y, message.x), min(most_m, max(least_m, sd_m)), now_s

    def measured(self, origin: tuple[float, float, float] | None, now_s: float) -> Measurement | None:
        """Return the last position on the Earth; None where there is none, or no origin."""
        if self._last is None or origin is None or now_s - self._last[2] > _EXTERNAL_GOOD_FOR_S:
            return None
        step_m, sd_m, t_s = self._last
        lat_deg, lon_deg = beside(origin[0], origin[1], step_m)
        return Measurement(lat_deg=lat_deg, lon_deg=lon_deg, alt_m=origin[2], sd_m=sd_m, t_s=t_s)
