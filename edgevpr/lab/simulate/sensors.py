"""Sensors of a simulated flight controller: its GPS, a second GPS by GPS_INPUT messages, external navigation by
ODOMETRY messages. Used by `firmware`. Rules and numbers are those of ArduPilot 4.7-dev: AP_GPS,
AP_GPS_MAV and AP_VisualOdom."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

from edgevpr.lab.simulate.motion import TrueState, beside, from_to
from edgevpr.mavlink.wire import Message, mavlink

NO_FIX, FIX_3D = mavlink.GPS_FIX_TYPE_NO_FIX, mavlink.GPS_FIX_TYPE_3D_FIX
_BEST_FIX = mavlink.GPS_FIX_TYPE_RTK_FIXED  # as ArduPilot's simulator has it
_NMEA = 5  # value of SIM_GPS1_TYPE
_NONE, _BY_MAVLINK = 0, 14  # values of GPS1_TYPE and GPS2_TYPE
_FIRST_FOR_EVER, _BLEND, _PRIMARY_IF_3D = 0, 2, 4  # values of GPS_AUTO_SWITCH; 1: the better one
_SWITCH_TO_MORE_S = ((2, 5.0), (1, 20.0))  # satellites more, and the least time since the last switch
_BLEND_POSITIONS, _BLEND_SPEEDS = 1, 4  # bits of GPS_BLEND_MASK
_BLENDED_WITHIN_S = 0.4  # two intervals of the slower receiver
_MAVLINK_AGE_S = 0.2  # AP_GPS assumes so (GPS_Backend::get_lag) where GPSn_DELAY_MS is 0
_SATELLITES_WITHOUT_FIX = 3
GPS_S = 0.2  # from one report of the simulated GPS to the next
_SIMULATED_SD_M = _SIMULATED_SD_M_S = 0.3
_TIMEOUT_S = 4.0
_LEAST_NOISE_M, _MOST_NOISE_M = 0.2, 100.0  # VISO_POS_M_NSE, and the upper limit
_EXTERNAL_GOOD_FOR_S = 0.3

Origin = tuple[float, float, float]  # latitude, longitude, altitude above sea level


@dataclass(frozen=True, slots=True, kw_only=True)
class PositionMeasurement:
    """A measured position: degrees, altitude above sea level, the standard deviation of one axis, the time `t_s` of its
    arrival, and the kind of fix (GPS_FIX_TYPE). The velocity is east + 1j * north (None: not measured). `age_s` is the
    age that the autopilot assumes, and `noise_scale` the factor by which it takes the position for less accurate."""

    lat_deg: float = 0.0
    lon_deg: float = 0.0
    alt_m: float = 0.0
    sd_m: float = 0.0
    t_s: float = 0.0
    velocity_m_s: complex | None = None
    speed_sd_m_s: float = 0.0
    fix_type: int = NO_FIX
    satellites: int = 0
    age_s: float = 0.0

    @property
    def noise_scale(self) -> float:
        """Factor of the standard deviations of few satellites (NavEKF3_core::readGpsData)."""
        if self.fix_type == NO_FIX or self.satellites >= 6:
            return 1.0
        return 1.4 if self.satellites == 5 else 2.0


NOTHING = PositionMeasurement()  # of a receiver that is silent


class Receivers:
    """The last `reports` of two GPS receivers. One measures the true position plus the glitch that the parameters set,
    while enabled; one of type 14 is fed by GPS_INPUT. `primary` is the measurement in use: of the receiver that
    `AP_GPS::update_primary` chooses, or a blend of both."""

    def __init__(self, parameters: Mapping[str, float]) -> None:
        self.reports = [NOTHING, NOTHING]
        self.primary = NOTHING
        self._parameters = parameters
        self._index, self._is_blended, self._switched_s = 0, False, 0.0
        self._due_s = 0.0

    @property
    def first(self) -> PositionMeasurement:
        return self.reports[0]

    @property
    def second(self) -> PositionMeasurement:
        return self.reports[1]

    @property
    def has_second(self) -> bool:
        """True if the parameters set the second receiver to GPS_INPUT messages."""
        return self._type(1) == _BY_MAVLINK

    def step(self, truth: TrueState, now_s: float) -> None:
        """Let the real receiver report if it is due, forget a silent one, and choose the one in use."""
        real = next((index for index in (0, 1) if self._type(index) not in (_NONE, _BY_MAVLINK)), None)
        if now_s >= self._due_s and real is not None:
            self._due_s = now_s + GPS_S - 1e-6
            self.reports[real] = self._measured(truth, self.reports[real], now_s)
        self.reports = [report if now_s - report.t_s <= _TIMEOUT_S else NOTHING for report in self.reports]
        self.primary = self._choose(now_s)

    def hear(self, message: Message, now_s: float) -> None:
        """Process a GPS_INPUT, if it is for a receiver of type 14."""
        index = message.gps_id
        if index not in (0, 1) or self._type(index) != _BY_MAVLINK:
            return
        velocity_m_s = complex(message.ve, message.vn)
        age_s = self._parameters.get(f"GPS{index + 1}_DELAY_MS", 0) / 1e3 or _MAVLINK_AGE_S
        self.reports[index] = PositionMeasurement(
            lat_deg=message.lat / 1e7,
            lon_deg=message.lon / 1e7,
            alt_m=message.alt,
            sd_m=message.horiz_accuracy,
            t_s=now_s,
            velocity_m_s=velocity_m_s,
            speed_sd_m_s=message.speed_accuracy,
            fix_type=message.fix_type,
            satellites=message.satellites_visible,
            age_s=age_s,
        )

    def _type(self, index: int) -> float:
        return self._parameters.get(f"GPS{index + 1}_TYPE", 1 - index)

    def _measured(self, truth: TrueState, before: PositionMeasurement, now_s: float) -> PositionMeasurement:
        seen = PositionMeasurement(
            lat_deg=truth.lat_deg + self._parameters["SIM_GPS1_GLTCH_X"],
            lon_deg=truth.lon_deg + self._parameters["SIM_GPS1_GLTCH_Y"],
            alt_m=truth.alt_m,
            sd_m=_SIMULATED_SD_M,
            t_s=now_s,
            velocity_m_s=truth.velocity_m_s,
            speed_sd_m_s=_SIMULATED_SD_M_S,
            fix_type=FIX_3D if self._parameters["SIM_GPS1_TYPE"] == _NMEA else _BEST_FIX,
            satellites=int(self._parameters["SIM_GPS1_NUMSATS"]),
        )
        if self._parameters["SIM_GPS1_ENABLE"]:
            return seen
        # Reports continue, without a fix.
        last = seen if before is NOTHING else before
        return replace(last, t_s=now_s, fix_type=NO_FIX, satellites=_SATELLITES_WITHOUT_FIX)

    def _choose(self, now_s: float) -> PositionMeasurement:
        """Choose the receiver in use as `AP_GPS::update_primary` does. Blending starts and ends at once, where a real
        one counts failures for some cycles."""
        switch = self._parameters.get("GPS_AUTO_SWITCH", _FIRST_FOR_EVER)
        was_blended, self._is_blended = self._is_blended, False
        if switch == _BLEND and (blend := self._blend()):
            self._is_blended = True
            return blend
        primary = int(self._parameters.get("GPS_PRIMARY", 0))
        if primary not in (0, 1) or self._type(primary) == _NONE:
            primary = 0
        before = self._index
        if switch == _FIRST_FOR_EVER:
            self._index = primary
        elif was_blended:
            self._index = max((0, 1), key=lambda index: self._rank(index, now_s))
            self._switched_s = now_s
        elif switch == _PRIMARY_IF_3D and self.reports[primary].fix_type >= FIX_3D:
            self._index = primary
        else:
            self._index = self._better_index(now_s)
        if self._index != before:
            self._switched_s = now_s
        return self.reports[self._index]

    def _better_index(self, now_s: float) -> int:
        used, other = self.reports[self._index], self.reports[1 - self._index]
        more = other.satellites - used.satellites
        waits_s = next((wait_s for least, wait_s in _SWITCH_TO_MORE_S if more >= least), math.inf)
        is_more = other.fix_type == used.fix_type and now_s - self._switched_s >= waits_s
        return 1 - self._index if other.fix_type > used.fix_type or is_more else self._index

    def _rank(self, index: int, now_s: float) -> tuple[bool, int, int]:
        report = self.reports[index]
        return now_s - report.t_s <= _BLENDED_WITHIN_S, report.fix_type, report.satellites

    def _blend(self) -> PositionMeasurement | None:
        """Blend both receivers, weighted by the accuracies that they report (AP_GPS_Blended); None: not possible."""
        one, other = self.reports
        if min(one.fix_type, other.fix_type) <= NO_FIX or abs(one.t_s - other.t_s) >= _BLENDED_WITHIN_S:
            return None
        mask, weights = int(self._parameters.get("GPS_BLEND_MASK", _BLEND_POSITIONS | _BLEND_SPEEDS)), []
        for bit, sds in (
            (_BLEND_POSITIONS, (one.sd_m, other.sd_m)),
            (_BLEND_SPEEDS, (one.speed_sd_m_s, other.speed_sd_m_s)),
        ):
            if mask & bit and min(sds) > 0:
                weights.append(sds[0] ** 2 / (sds[0] ** 2 + sds[1] ** 2))  # of the other
        if not weights:
            return None
        weight = sum(weights) / len(weights)
        step_m = weight * from_to(one.lat_deg, one.lon_deg, other.lat_deg, other.lon_deg)
        lat_deg, lon_deg = beside(one.lat_deg, one.lon_deg, step_m)
        return PositionMeasurement(
            lat_deg=lat_deg,
            lon_deg=lon_deg,
            alt_m=one.alt_m + weight * (other.alt_m - one.alt_m),
            sd_m=min(one.sd_m, other.sd_m),
            t_s=max(one.t_s, other.t_s),
            velocity_m_s=(1 - weight) * (one.velocity_m_s or 0j) + weight * (other.velocity_m_s or 0j),
            speed_sd_m_s=min(one.speed_sd_m_s, other.speed_sd_m_s),
            fix_type=max(one.fix_type, other.fix_type),
            satellites=max(one.satellites, other.satellites),
            age_s=(1 - weight) * one.age_s + weight * other.age_s,
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
