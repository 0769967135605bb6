"""The GPS receivers of a simulated flight controller: its own, and one that GPS_INPUT messages feed. Rules and numbers
are those of AP_GPS, AP_GPS_MAV and AP_GPS_Blended in ArduPilot 4.7-dev. Vectors are east + 1j * north."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

from edgevpr.core.arrays import LatLon
from edgevpr.mavlink.wire import Message, mavlink
from simulated.motion import TrueState, displace, displacement_m

NO_FIX = mavlink.GPS_FIX_TYPE_NO_FIX
FIX_3D = mavlink.GPS_FIX_TYPE_3D_FIX
_BEST_FIX = mavlink.GPS_FIX_TYPE_RTK_FIXED  # as ArduPilot's simulator has it
_NMEA = 5  # value of SIM_GPS1_TYPE
_NONE = 0  # values of GPS1_TYPE and GPS2_TYPE
_BY_MAVLINK = 14
_FIRST_FOR_EVER = 0  # values of GPS_AUTO_SWITCH; 1: the better one
_BLEND = 2
_PRIMARY_IF_3D = 4
_SWITCH_TO_MORE_S = ((2, 5.0), (1, 20.0))  # satellites more, and the least time since the last switch
_BLENDED_WITHIN_S = 0.4  # two intervals of the slower receiver
_MAVLINK_AGE_S = 0.2  # AP_GPS assumes so (GPS_Backend::get_lag) where GPSn_DELAY_MS is 0
_SATELLITES_WITHOUT_FIX = 3
_INTERVAL_S = 0.2  # of the simulated receiver
_SIMULATED_SD_M = _SIMULATED_SD_M_S = 0.3
_TIMEOUT_S = 4.0


@dataclass(frozen=True, slots=True, kw_only=True)
class PositionMeasurement:
    """A measured position: a point and its altitude above sea level, the standard deviation of one axis, the time `t_s`
    of its arrival, and the kind of fix (GPS_FIX_TYPE). `velocity_m_s` None: not measured. `age_s` is the age that the
    autopilot assumes. `can_align`: it is good enough for a filter to start (NavEKF3_core::calcGpsGoodToAlign)."""

    point: LatLon = (0.0, 0.0)
    alt_m: float = 0.0
    sd_m: float = 0.0
    t_s: float = 0.0
    velocity_m_s: complex | None = None
    speed_sd_m_s: float = 0.0
    fix_type: int = NO_FIX
    satellites: int = 0
    age_s: float = 0.0
    can_align: bool = True


NOTHING = PositionMeasurement()  # of a receiver that is silent


class Receivers:
    """The last `reports` of two GPS receivers. One measures the true position while enabled; one of
    type 14 is fed by GPS_INPUT. `primary` is the measurement in use: of the receiver that
    `AP_GPS::update_primary` chooses, or a blend of both."""

    def __init__(self, parameters: Mapping[str, float]) -> None:
        self.reports = [NOTHING, NOTHING]
        self.primary = NOTHING
        self._parameters = parameters
        self._index = 0
        self._switched_s = 0.0
        self._due_s = 0.0
        self.error_m = 0j  # of the position that the simulated receiver measures

    @property
    def has_second(self) -> bool:
        """True if the parameters set the second receiver to GPS_INPUT messages."""
        return self._type(1) == _BY_MAVLINK

    def step(self, truth: TrueState, now_s: float) -> None:
        """Let the simulated receiver report if it is due, forget a silent one, and choose the one in use."""
        own = next((index for index in (0, 1) if self._type(index) not in (_NONE, _BY_MAVLINK)), None)
        if now_s >= self._due_s and own is not None:
            self._due_s = now_s + _INTERVAL_S - 1e-6
            self.reports[own] = self._measure(truth, self.reports[own], now_s)
        self.reports = [report if now_s - report.t_s <= _TIMEOUT_S else NOTHING for report in self.reports]
        is_blended = self._parameters.get("GPS_AUTO_SWITCH") == _BLEND
        self.primary = (is_blended and self._blend()) or self._choose(now_s)

    def receive(self, message: Message, now_s: float) -> None:
        """Process a GPS_INPUT, if it is for a receiver of type 14."""
        index = message.gps_id
        if index in (0, 1) and self._type(index) == _BY_MAVLINK:
            hdop = math.inf if message.ignore_flags & mavlink.GPS_INPUT_IGNORE_FLAG_HDOP else message.hdop
            is_precise = message.horiz_accuracy <= 5.0 and message.speed_accuracy <= 1.0 and hdop <= 2.5
            self.reports[index] = PositionMeasurement(
                point=(message.lat / 1e7, message.lon / 1e7),
                alt_m=message.alt,
                sd_m=message.horiz_accuracy,
                t_s=now_s,
                velocity_m_s=complex(message.ve, message.vn),
                speed_sd_m_s=message.speed_accuracy,
                fix_type=message.fix_type,
                satellites=message.satellites_visible,
                age_s=self._parameters.get(f"GPS{index + 1}_DELAY_MS", 0) / 1e3 or _MAVLINK_AGE_S,
                can_align=is_precise and message.satellites_visible >= 6,
            )

    def _type(self, index: int) -> float:
        return self._parameters.get(f"GPS{index + 1}_TYPE", 1 - index)

    def _measure(self, truth: TrueState, before: PositionMeasurement, now_s: float) -> PositionMeasurement:
        parameters = self._parameters
        report = PositionMeasurement(
            point=displace(truth.point, self.error_m),
            alt_m=truth.alt_m,
            sd_m=_SIMULATED_SD_M,
            t_s=now_s,
            velocity_m_s=truth.velocity_m_s,
            speed_sd_m_s=_SIMULATED_SD_M_S,
            fix_type=FIX_3D if parameters["SIM_GPS1_TYPE"] == _NMEA else _BEST_FIX,
            satellites=int(parameters["SIM_GPS1_NUMSATS"]),
        )
        if parameters["SIM_GPS1_ENABLE"]:
            return report
        # Reports continue, without a fix.
        last = report if before is NOTHING else before
        return replace(last, t_s=now_s, fix_type=NO_FIX, satellites=_SATELLITES_WITHOUT_FIX)

    def _choose(self, now_s: float) -> PositionMeasurement:
        """Choose the receiver in use as `AP_GPS::update_primary` does."""
        switch = self._parameters.get("GPS_AUTO_SWITCH", _FIRST_FOR_EVER)
        primary = int(self._parameters.get("GPS_PRIMARY", 0))
        if primary not in (0, 1) or self._type(primary) == _NONE:
            primary = 0
        if switch == _FIRST_FOR_EVER or (switch == _PRIMARY_IF_3D and self.reports[primary].fix_type >= FIX_3D):
            index = primary
        else:
            index = self._better_index(now_s)
        if index != self._index:
            self._index, self._switched_s = index, now_s
        return self.reports[index]

    def _better_index(self, now_s: float) -> int:
        used, other = self.reports[self._index], self.reports[1 - self._index]
        more = other.satellites - used.satellites
        waits_s = next((wait_s for least, wait_s in _SWITCH_TO_MORE_S if more >= least), math.inf)
        is_more = other.fix_type == used.fix_type and now_s - self._switched_s >= waits_s
        return 1 - self._index if other.fix_type > used.fix_type or is_more else self._index

    def _blend(self) -> PositionMeasurement | None:
        """Blend both receivers by the accuracies that they report (GPS_BLEND_MASK 5, the default); None: impossible."""
        one, other = self.reports
        sds = (one.sd_m, other.sd_m), (one.speed_sd_m_s, other.speed_sd_m_s)
        is_late = abs(one.t_s - other.t_s) >= _BLENDED_WITHIN_S
        if min(one.fix_type, other.fix_type) <= NO_FIX or is_late or not all(map(all, sds)):
            return None
        weight = sum(sd**2 / (sd**2 + other_sd**2) for sd, other_sd in sds) / 2  # of the other
        return PositionMeasurement(
            point=displace(one.point, weight * displacement_m(one.point, other.point)),
            alt_m=one.alt_m + weight * (other.alt_m - one.alt_m),
            sd_m=min(one.sd_m, other.sd_m),
            t_s=max(one.t_s, other.t_s),
            velocity_m_s=(1 - weight) * (one.velocity_m_s or 0j) + weight * (other.velocity_m_s or 0j),
            speed_sd_m_s=min(one.speed_sd_m_s, other.speed_sd_m_s),
            fix_type=max(one.fix_type, other.fix_type),
            satellites=max(one.satellites, other.satellites),
            age_s=(1 - weight) * one.age_s + weight * other.age_s,
        )
