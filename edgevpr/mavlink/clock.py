"""The autopilot's clock (seconds since its boot) as a function of our monotonic clock. It is synchronised by TIMESYNC
(ArduPilot `GCS_MAVLINK::handle_timesync`, PX4 `MavlinkTimesync::handle_message`), and detects its restarts."""

import logging
import math
from collections import deque
from typing import NamedTuple

from edgevpr.mavlink.ground import Announce
from edgevpr.mavlink.messages import Severity
from edgevpr.mavlink.wire import Message, mavlink

HEARTBEAT_TIMEOUT_S = 5.0  # five heartbeats, which are sent once a second
TIMESYNC_TIMEOUT_S = 5.0  # without an answer
_REQUEST_INTERVAL_S = 1.0
_URGENT_REQUEST_INTERVAL_S = 0.25  # while the clock is unknown, or after a gap
_MAX_ANSWER_AGE_S = 10.0  # two quartz clocks drift apart by at most 1 ms in this time
_MAX_CLOCK_DRIFT_S = 1e-3
_MAX_REQUESTS = 64  # requests with pending answers; only a very slow link has this many
_MIN_STEP_BACK_S = 1.0  # a boot time that goes back by more than this is that of another boot
_RESTART_CHECK_S = 3.0  # after a gap in heartbeats; without a boot time in it, the autopilot counts as restarted
_UTC_ROUNDING_S = 5e-3  # boot times are sent in whole milliseconds
_MAX_STAMP_ERROR_S = 1.0
_MAX_AHEAD_S = 0.5
JITTER_LAG_S = 0.5  # `max_lag_ms` of ArduPilot's JitterCorrection
_JITTER_SAMPLES = 200  # our timestamps affected by a foreign one: two rounds of `convergence_loops`, the first partial
# Only messages stamped when they are sent: others carry the time of a measurement, which may be old.
_BOOT_TIME_MESSAGES = ("ATTITUDE", "GLOBAL_POSITION_INT", "SCALED_IMU", "SYSTEM_TIME")
_WRAP_MS = 2**32
_WRAP_MARGIN_MS = 60_000
MAX_REPORT_DELAY_S = 0.5  # reports with a longer delay are not used: at 20 m/s they are wrong by 10 m
_MIN_PUNCTUAL_S = 10.0  # without a late report, before reports count as on time
# The messages that share ArduPilot's single timestamp correction per link, with the name of their timestamp field: all
# callers of `GCS_MAVLINK::correct_offboard_timestamp_usec_to_ms` except command 43003.
_STAMP_FIELDS = {
    "ATT_POS_MOCAP": "time_usec",
    "GLOBAL_VISION_POSITION_ESTIMATE": "usec",
    "LANDING_TARGET": "time_usec",
    "ODOMETRY": "time_usec",
    "VICON_POSITION_ESTIMATE": "usec",
    "VISION_POSITION_ESTIMATE": "usec",
    "VISION_SPEED_ESTIMATE": "usec",
}

log = logging.getLogger(__name__)


class _Answer(NamedTuple):
    """Bounds on the clock offset (boot time minus monotonic time) from an answer to TIMESYNC received at `t_s`."""

    t_s: float
    low_s: float
    high_s: float

    @property
    def round_trip_s(self) -> float:
        return self.high_s - self.low_s

    def contradicts(self, other: "_Answer") -> bool:
        return max(self.low_s, other.low_s) > min(self.high_s, other.high_s) + _MAX_CLOCK_DRIFT_S


class AutopilotClock:
    """Converts our monotonic time to the autopilot's time since boot, and to its UTC. The offset is taken from the
    answer with the shortest round trip within the last ten seconds. If TIMESYNC is not answered within five seconds,
    timestamps are taken from our own clock until the autopilot restarts."""

    def __init__(self, announce: Announce) -> None:
        self._announce = announce
        self._requests_ns: deque[int] = deque(maxlen=_MAX_REQUESTS)
        self._first_request_s = self._due_s = -math.inf  # times of the first request and of the next one
        self._answers: list[_Answer] = []
        self._best: _Answer | None = None
        self._uses_own_clock = False
        self._heartbeat_s = math.inf  # time of the last heartbeat
        self._boot_ms: dict[str, int] = {}  # last boot time by kind of message
        self._gap_end_s: float | None = None  # when heartbeats resumed after a gap; None: no restart suspected
        self._is_same_boot = False  # boot times have continued since the gap
        self._utc_minus_boot_s: float | None = None
        self._utc_minus_mono_s: float | None = None  # used if the boot time is unknown

    def make_request(self, now_s: float) -> Message | None:
        """Return the TIMESYNC to send at `now_s`; None if none is due."""
        if not self._requests_ns:
            self._first_request_s = now_s
        if self._best is None and not self._uses_own_clock and now_s - self._first_request_s > TIMESYNC_TIMEOUT_S:
            self._uses_own_clock = True
            log.warning("the autopilot does not answer TIMESYNC: using our own clock for timestamps")
            self._announce(Severity.WARNING, "no answer to TIMESYNC: our clock used", "clock")
        if now_s < self._due_s:
            return None
        is_urgent = self._gap_end_s is not None or (self._best is None and not self._uses_own_clock)
        self._due_s = now_s + (_URGENT_REQUEST_INTERVAL_S if is_urgent else _REQUEST_INTERVAL_S)
        self._requests_ns.append(round(now_s * 1e9))
        return mavlink.MAVLink_timesync_message(tc1=0, ts1=self._requests_ns[-1])

    def handle(self, message: Message, now_s: float) -> bool:
        """Process a message from the autopilot. Returns True if it shows that the autopilot has restarted: its boot
        time goes back or, after a gap in heartbeats, does not continue."""
        kind = message.get_type()
        if kind == "TIMESYNC" and message.tc1 > 0 and message.ts1 in self._requests_ns:
            if self._handle_answer(message.tc1 / 1e9, message.ts1 / 1e9, now_s):
                return True
        elif kind in _BOOT_TIME_MESSAGES:
            if self._handle_boot_time(kind, message.time_boot_ms):
                return True
            if kind == "SYSTEM_TIME" and message.time_unix_usec:
                self._handle_utc(message, now_s)
        elif kind == "HEARTBEAT":
            if now_s - self._heartbeat_s > HEARTBEAT_TIMEOUT_S:
                self._gap_end_s, self._due_s, self._is_same_boot = now_s, now_s, False
            self._heartbeat_s = now_s
        if self._gap_end_s is not None and now_s - self._gap_end_s > _RESTART_CHECK_S:
            self._gap_end_s = None
            return not self._is_same_boot
        return False

    def boot_time_s(self, t_mono_s: float) -> float | None:
        """Return the autopilot's time since boot at `t_mono_s`; None if it is unknown."""
        return t_mono_s + (self._best.low_s + self._best.high_s) / 2 if self._best else None

    def stamp_s(self, t_mono_s: float) -> float | None:
        """Return `t_mono_s` as a timestamp for the autopilot; None if its clock is unknown or may have restarted."""
        if self._gap_end_s is not None:
            return None
        return t_mono_s if self._uses_own_clock else self.boot_time_s(t_mono_s)

    def mono_time_s(self, boot_s: float, now_s: float) -> float:
        """Return our time of a report stamped `boot_s`; that of its arrival, `now_s`, if unknown or over 1 s ago."""
        delay_s = (self.boot_time_s(now_s) or 0.0) - boot_s
        return now_s - delay_s if 0.0 <= delay_s <= _MAX_STAMP_ERROR_S else now_s

    def utc_s(self, t_mono_s: float) -> float | None:
        """Return the autopilot's UTC at `t_mono_s` in seconds since 1970; None if it is unknown."""
        boot_s = self.boot_time_s(t_mono_s)
        if boot_s is not None and self._utc_minus_boot_s is not None:
            return boot_s + self._utc_minus_boot_s
        return None if self._utc_minus_mono_s is None else t_mono_s + self._utc_minus_mono_s

    def delay_s(self, boot_ms: int, now_s: float) -> float:
        """Return the transport delay in seconds of a report stamped `boot_ms`; 0.0 if the autopilot's clock is unknown.
        The delay is at least half the last round trip: if the report is not late, our messages are."""
        age_s = self._compute_age_s(boot_ms, now_s)
        return 0.0 if age_s is None else max(age_s, self._answers[-1].round_trip_s / 2)

    def has_stood_still(self, boot_ms: int, now_s: float) -> bool:
        """Return True if our monotonic clock stood still, as in a suspended computer: `boot_ms` is in our future."""
        age_s = self._compute_age_s(boot_ms, now_s)
        return age_s is not None and age_s < -_MAX_AHEAD_S and now_s - self._answers[-1].t_s <= _MAX_ANSWER_AGE_S

    def _compute_age_s(self, boot_ms: int, now_s: float) -> float | None:
        """Return the age of a report stamped `boot_ms`; negative if it is in our future, None if it is unknown."""
        boot_s = self.boot_time_s(now_s)
        return None if boot_s is None else math.remainder(boot_s - boot_ms / 1e3, _WRAP_MS / 1e3)

    def _handle_answer(self, boot_s: float, sent_s: float, now_s: float) -> bool:
        """Process the answer to the request sent at `sent_s`. Returns True if it is from another boot."""
        answer, old_best = _Answer(now_s, boot_s - now_s, boot_s - sent_s), self._best
        last = self._answers[-1] if self._answers else None
        if last and boot_s < last.t_s + last.low_s - _MIN_STEP_BACK_S:
            return True
        if self._gap_end_s is not None and old_best and answer.round_trip_s < _MIN_STEP_BACK_S:
            if answer.high_s < old_best.low_s - _MIN_STEP_BACK_S:
                return True
            self._gap_end_s = None
        # Answers that contradict the newest one are from before a pause of one of the clocks.
        valid = (old for old in self._answers if now_s - old.t_s <= _MAX_ANSWER_AGE_S and not old.contradicts(answer))
        self._answers = [*valid, answer]
        self._best = min(self._answers, key=lambda answer: answer.round_trip_s)
        return False

    def _handle_boot_time(self, kind: str, boot_ms: int) -> bool:
        """Process the boot time in a message of `kind`. Returns True if the time since boot has gone backwards."""
        last_ms = self._boot_ms.get(kind)
        self._boot_ms[kind] = boot_ms
        if last_ms is None:
            return False
        has_wrapped = last_ms > _WRAP_MS - _WRAP_MARGIN_MS and boot_ms < _WRAP_MARGIN_MS
        went_back = boot_ms < last_ms - _MIN_STEP_BACK_S * 1e3 and not has_wrapped
        self._is_same_boot |= not went_back
        return went_back

    def _handle_utc(self, message: Message, now_s: float) -> None:
        """Process a SYSTEM_TIME: UTC and boot time of one instant, from one clock. Their difference is constant except
        for the rounding of the boot time, so its first value is kept until it changes by more than that."""
        utc_s, boot_s = message.time_unix_usec / 1e6, message.time_boot_ms / 1e3
        self._utc_minus_mono_s = utc_s - now_s
        expected_s = self.boot_time_s(now_s)
        if expected_s is None:
            return
        boot_s += round((expected_s - boot_s) * 1e3 / _WRAP_MS) * _WRAP_MS / 1e3
        if self._utc_minus_boot_s is None or abs(utc_s - boot_s - self._utc_minus_boot_s) > _UTC_ROUNDING_S:
            self._utc_minus_boot_s = utc_s - boot_s


class ReportDelay:
    """Decides from their delay whether the autopilot's reports are used, and announces changes. `is_late`: the newest
    report arrived over MAX_REPORT_DELAY_S after it was sent, because the link is saturated or our process paused."""

    def __init__(self, announce: Announce) -> None:
        self.is_late = False
        self._announce = announce
        self._late_s: float | None = None  # when a report last arrived too late; None: reports arrive on time

    def update(self, delay_s: float, now_s: float) -> None:
        """Process the delay of a report received at `now_s`."""
        self.is_late = delay_s > MAX_REPORT_DELAY_S
        if self.is_late:
            if self._late_s is None:
                log.warning(
                    "the autopilot's reports arrive %.1f s late and are not used: the link is saturated; raise its "
                    "baud rate, or have the other programs on the link request fewer messages", delay_s,
                )  # fmt: skip
                self._announce(Severity.WARNING, f"link saturated: reports {delay_s:.1f} s late", "delay")
            self._late_s = now_s
        elif self._late_s is not None and now_s - self._late_s > _MIN_PUNCTUAL_S:
            self._late_s = None
            self._announce(Severity.INFO, "reports on time again", "delay")


class ForeignStamps:
    """Finds timestamps of other programs that are not in the autopilot's time. ArduPilot has one timestamp correction
    for all senders of a link (`JitterCorrection`). After a timestamp ahead of its own time, it treats our messages as
    sent 0.5 s before they arrive."""

    def __init__(self) -> None:
        self._reported: set[tuple[str, str]] = set()
        self._spoilt_stamps = 0  # number of our next timestamps that ArduPilot will treat as too old

    def take_lag_s(self) -> float:
        """Return the seconds by which ArduPilot will treat the timestamp that we send now as too old."""
        if self._spoilt_stamps == 0:
            return 0.0
        self._spoilt_stamps -= 1
        return JITTER_LAG_S

    def find(self, message: Message, boot_s: float | None) -> str | None:
        """Return sender and name of a message if its timestamp is wrong by more than a second and this was not reported
        before, else None. `boot_s`: the autopilot's time since boot."""
        kind = message.get_type()
        if kind in _STAMP_FIELDS:
            stamp_s = getattr(message, _STAMP_FIELDS[kind]) / 1e6
        elif kind == "COMMAND_INT" and message.command == mavlink.MAV_CMD_EXTERNAL_POSITION_ESTIMATE:
            kind, stamp_s = "43003", message.param1
        else:
            return None
        sender = f"{message.get_srcSystem()}/{message.get_srcComponent()}"
        if boot_s is None or abs(stamp_s - boot_s) <= _MAX_STAMP_ERROR_S:
            return None
        if stamp_s > boot_s:
            self._spoilt_stamps = _JITTER_SAMPLES
        if (sender, kind) in self._reported:
            return None
        self._reported.add((sender, kind))
        cause = "ArduPilot has one timestamp correction per link, so it now treats our ODOMETRY as up to 0.5 s too old"
        advice = "have that program use TIMESYNC, or connect it to another port"
        fault = f"the timestamps of {kind} from {sender} differ from the autopilot's time by {stamp_s - boot_s:.1f} s"
        log.warning("%s: %s; %s", fault, cause, advice)
        return f"{sender} {kind}"
