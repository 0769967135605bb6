"""The GPS receivers of an autopilot, from their own messages: GPS_RAW_INT and GPS2_RAW.

These messages cannot contain our own positions, except those of the receiver that edgevpr simulates (GPS_INPUT), which
is excluded. The autopilot's estimate, in contrast, may be derived from our positions."""

import math
from dataclasses import dataclass, replace

from edgevpr.core.geodesy import distance_m, offset_m, offset_position
from edgevpr.core.types import Receiver
from edgevpr.mavlink.wire import Message, mavlink

GPS_REPORTS = ("GPS_RAW_INT", "GPS2_RAW")
GPS_TIMEOUT_S = 2.5  # reports arrive at least once a second, and one may be lost
MAX_FIX_AGE_S = 0.7  # when its report arrives; an older one is repeated, and the autopilot dead-reckons
DEFAULT_GPS_SD_M = 5.0  # of a receiver that does not report its accuracy
MAX_PLAUSIBLE_SD_M = 15.0  # a receiver with a larger standard deviation does not replace our positions
# Time from a receiver's measurement to the timestamp of its report: 0.1 s in ArduPilot's simulator. PX4's timestamps
# are UTC, so its reports count from their arrival; in its simulator they have almost no lag.
RECEIVER_LAG_S = 0.1
_ACCURACY_UNKNOWN = (0, 2**32 - 1)  # values of h_acc: not sent, and unknown
_SPEED_UNKNOWN = 2**16 - 1
_MAX_STEP_M = 8.0  # between two reports, beyond the motion from the receiver's velocity: more is a jump
_MAX_DISAGREEMENT_M = 10.0  # of two receivers, relative to the autopilot's estimate
_MAX_GAP_S = 1.5  # a receiver that is silent for longer is no longer steady


@dataclass(frozen=True, slots=True)
class _TrackedReceiver:
    """A receiver with a 3D fix: its newest report, the report's timestamp, and the time since which it is steady."""

    report: Receiver
    time_usec: int
    steady_since_s: float


class Receivers:
    """The receivers that have a 3D fix. A receiver is steady while its fixes have a plausible accuracy and follow each
    other without a gap, or a jump relative to its own velocity."""

    def __init__(self) -> None:
        self._tracked: dict[str, _TrackedReceiver] = {}
        self._received_s = {GPS_REPORTS[0]: -math.inf}  # when the last report arrived, by name, with or without a fix

    def handle(self, message: Message, t_s: float, now_s: float) -> None:
        """Process a GPS_RAW_INT or GPS2_RAW that arrived at `now_s`, whose fix is of time `t_s`."""
        name = message.get_type()
        self._received_s[name] = now_s
        if message.fix_type < mavlink.GPS_FIX_TYPE_3D_FIX:
            self._tracked.pop(name, None)
            return
        previous = self._tracked.get(name)
        # After a receiver is lost, its last position is still reported for some seconds, with an unchanged timestamp.
        if previous and message.time_usec and message.time_usec == previous.time_usec:
            report = replace(previous.report, age_at_report_s=now_s - previous.report.t_s)
            self._tracked[name] = replace(previous, report=report)
            return
        report = replace(_to_receiver(message, t_s), age_at_report_s=now_s - t_s)
        is_plausible = report.sd_m <= MAX_PLAUSIBLE_SD_M
        is_steady = previous is not None and is_plausible and _is_continuous(previous.report, report)
        since_s = previous.steady_since_s if previous and is_steady else t_s
        self._tracked[name] = _TrackedReceiver(report, message.time_usec, since_s)

    def get_received_s(self, name: str) -> float:
        """Return the time when the last report of a receiver arrived, by the name of its message; -inf if none has."""
        return self._received_s.get(name, -math.inf)

    def is_report_missing(self, now_s: float, timeout_s: float) -> bool:
        """Return True if no report of the first receiver, or none any more of the second, arrived in `timeout_s`."""
        return now_s - min(self._received_s.values()) > timeout_s

    def choose_best(
        self, now_s: float, own: str | None = None, estimate_deg: tuple[float, float] | None = None
    ) -> Receiver | None:
        """Return the newest report of the most accurate receiver with a fix in the last 2.5 s; None if there is none.
        Of receivers that contradict each other, the one nearest to the autopilot's estimate (`estimate_deg`, latitude
        and longitude; None: unknown) counts: the autopilot uses it. `own`: message name of the simulated one."""
        real = (tracked for name, tracked in self._tracked.items() if name != own)
        recent = [tracked for tracked in real if now_s - tracked.report.t_s <= GPS_TIMEOUT_S]
        if not recent:
            return None
        if estimate_deg:
            distances_m = [float(distance_m(*estimate_deg, *extrapolate(tracked.report, now_s))) for tracked in recent]
            max_m = min(distances_m) + _MAX_DISAGREEMENT_M
            recent = [tracked for tracked, away_m in zip(recent, distances_m, strict=True) if away_m <= max_m]
        best = min(recent, key=lambda tracked: tracked.report.sd_m)
        return replace(best.report, steady_for_s=best.report.t_s - best.steady_since_s)

    def is_silent(self, now_s: float, own: str | None = None) -> bool:
        """Return True if the reports of the first receiver have stopped while it had a fix: another program may have
        stopped them. An autopilot reports a lost receiver, but not a lost second one. `own`: as above."""
        name = GPS_REPORTS[0]
        tracked = self._tracked.get(name) if name != own else None
        is_repeated = tracked is not None and tracked.report.age_at_report_s > MAX_FIX_AGE_S
        return tracked is not None and not is_repeated and now_s - tracked.report.t_s > GPS_TIMEOUT_S


def extrapolate(receiver: Receiver, t_s: float, velocity_m_s: tuple[float, float] | None = None) -> tuple[float, float]:
    """Return latitude and longitude of a receiver at `t_s`, extrapolated from its report and lag with `velocity_m_s`,
    m/s (east, north; None: use the receiver's own velocity)."""
    elapsed_s = t_s - receiver.t_s + RECEIVER_LAG_S
    east_m, north_m = (elapsed_s * speed_m_s for speed_m_s in velocity_m_s or receiver.velocity_m_s or (0.0, 0.0))
    return offset_position(receiver.lat_deg, receiver.lon_deg, east_m, north_m)


def _to_receiver(message: Message, t_s: float) -> Receiver:
    return Receiver(
        lat_deg=message.lat / 1e7,
        lon_deg=message.lon / 1e7,
        sd_m=DEFAULT_GPS_SD_M if message.h_acc in _ACCURACY_UNKNOWN else message.h_acc / 1e3,
        t_s=t_s,
        velocity_m_s=_read_velocity(message),
        alt_m=message.alt / 1e3,
    )


def _read_velocity(message: Message) -> tuple[float, float] | None:
    """Return the velocity of a report in m/s (east, north); None if the report has none."""
    if _SPEED_UNKNOWN in (message.vel, message.cog):
        return None
    speed_m_s, course = message.vel / 100, math.radians(message.cog / 100)
    return speed_m_s * math.sin(course), speed_m_s * math.cos(course)


def _is_continuous(before: Receiver, report: Receiver) -> bool:
    """Return True if a report follows the report `before` without a gap or a jump."""
    interval_s = report.t_s - before.t_s
    if interval_s > _MAX_GAP_S:
        return False
    speeds = [velocity for velocity in (before.velocity_m_s, report.velocity_m_s) if velocity]
    if len(speeds) < 2:
        return True
    east_m, north_m = (interval_s * (start + end) / 2 for start, end in zip(*speeds, strict=True))
    expected = offset_position(before.lat_deg, before.lon_deg, east_m, north_m)
    return math.hypot(*map(float, offset_m(*expected, report.lat_deg, report.lon_deg))) <= _MAX_STEP_M
