"""Position fixes in transit to the autopilot: queued, or awaiting an answer. Used by `conversation` only inside turns.

A fix is never sent late, and after five consecutive unanswered fixes only occasional ones are sent. COMMAND_ACK does
not identify the fix that it answers, so it is matched to the oldest fix sent less than a second ago. With one fix a
second, and answers within tens of milliseconds, there is only one such fix. An answer without a fix is only counted."""

import logging
import math
from collections import deque
from dataclasses import dataclass, replace
from threading import Event

from edgevpr.core.geodesy import offset_position
from edgevpr.core.reasons import Reason, ReasonCode
from edgevpr.core.types import MAX_FIX_AGE_S, Vehicle
from edgevpr.mavlink.ground import Announce
from edgevpr.mavlink.messages import Fix, Severity

MAX_QUEUED_FIXES = 8
# Longest time from `put` until a fix is sent, in all buffers together. types.MAX_FIX_AGE_S limits the age of its frame.
MAX_FIX_WAIT_S = 1.0
MAX_UNANSWERED = 5  # after this many consecutive unanswered fixes, sending stops until one is answered
RETRY_INTERVAL_S = 10.0  # interval of the fixes sent while sending is stopped
ANSWER_TIMEOUT_S = 1.0  # answers take tens of milliseconds, over a radio up to half a second

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class FixAnswer:
    """The autopilot's answer to a fix. `result`: name of a MAV_RESULT (None: no answer in time). `why`: reason (None:
    accepted). `latency_s`: time from sending to answer."""

    result: str | None
    why: Reason | None
    latency_s: float | None


class FixTransmission:
    """A fix to send by `due_s`. `sent`: None while it is queued, then True, or False with the reason in `why`.
    `t_sent_s`: when it was handed to the port. `outcome`: the autopilot's answer."""

    def __init__(self, fix: Fix, due_s: float) -> None:
        self.fix, self.due_s = fix, due_s
        self.sent: bool | None = None
        self.why: Reason | None = None
        self.t_sent_s: float | None = None
        self.outcome: FixAnswer | None = None
        self._settled = Event()

    @property
    def answer(self) -> str | None:
        """The name of a MAV_RESULT; None if there is no answer."""
        return self.outcome.result if self.outcome else None

    def settle(self, sent: bool, why: Reason | None = None) -> None:
        """Record whether the fix was sent and, if not, `why`. Wakes the threads in `wait`."""
        self.sent, self.why = sent, why
        self._settled.set()

    def wait(self, timeout_s: float) -> None:
        """Wait up to `timeout_s` seconds until the fix is sent or dropped."""
        self._settled.wait(timeout_s)


class Fixes:
    """The fixes of one link, queued or awaiting an answer. Counts fixes `dropped` (too old or too many), `withheld` (by
    `find_objection` or a pause) and `unanswered`. `refusal`: reason of the last refusal (None: none)."""

    def __init__(self, max_wait_s: float = MAX_FIX_WAIT_S, announce: Announce = lambda *_: None) -> None:
        self._announce = announce
        self.dropped = self.withheld = self.unanswered = 0
        self.refusal: Reason | None = None
        self._max_wait_s = max_wait_s
        self._waiting: deque[FixTransmission] = deque()
        self._awaited: deque[tuple[float, FixTransmission]] = deque()  # sent, with the time of sending
        self._accepted_s = -math.inf  # time of the newest fix that was, or may have been, accepted
        self._last_answer: tuple[str, Reason] | None = None
        self._sent_s = -math.inf
        self._consecutive_unanswered = 0
        self._is_stopped = False  # last announced state
        self._resumes_s = -math.inf

    def __len__(self) -> int:
        """Return the number of fixes that await an answer."""
        return len(self._awaited)

    @property
    def t_fix_s(self) -> float:
        """Time of the newest fix that the autopilot may be using, because it has not refused it (-inf: none)."""
        return max(self._accepted_s, self._awaited[-1][0] if self._awaited else -math.inf)

    def put(self, fix: Fix, now_s: float) -> FixTransmission:
        """Queue a fix. It is sent within `max_wait_s` seconds and before its frame is 5 s old, or not at all."""
        transmission = FixTransmission(fix, min(now_s + self._max_wait_s, fix.t_frame_s + MAX_FIX_AGE_S))
        age_s = now_s - fix.t_frame_s
        if age_s > MAX_FIX_AGE_S:
            self._drop(transmission, Reason(ReasonCode.FRAME_TOO_OLD, {"age_s": age_s, "limit_s": MAX_FIX_AGE_S}))
            return transmission
        if len(self._waiting) == MAX_QUEUED_FIXES:
            self._drop(self._waiting.popleft(), Reason(ReasonCode.SUPERSEDED))
        self._waiting.append(transmission)
        return transmission

    def next(self, now_s: float) -> FixTransmission | None:
        """Drop the fixes that have waited too long; return the oldest remaining one (None: none is queued)."""
        self.drop_stale(now_s)
        return self._waiting.popleft() if self._waiting else None

    def drop_stale(self, now_s: float, why: ReasonCode = ReasonCode.NO_AUTOPILOT) -> None:
        """Drop the fixes that have waited too long, with the reason `why`."""
        for transmission in self._waiting:
            if now_s > transmission.due_s:
                self._drop(transmission, Reason(why, {"limit_s": self._max_wait_s}))
        self._waiting = deque(transmission for transmission in self._waiting if transmission.sent is None)

    def withhold(self, why: Reason) -> None:
        """Drop all queued fixes, with the reason `why`."""
        self.withheld += len(self._waiting)
        for transmission in self._waiting:
            transmission.settle(False, why)
        self._waiting.clear()

    def find_objection(self, now_s: float) -> Reason | None:
        """Return the reason why no fix may be sent now; None if fixes may be sent."""
        if self._consecutive_unanswered >= MAX_UNANSWERED and now_s - self._sent_s < RETRY_INTERVAL_S:
            return Reason(ReasonCode.FIXES_UNANSWERED)
        return Reason(ReasonCode.ANSWERS_RESUMED) if now_s < self._resumes_s else None

    def record_sent(self, transmission: FixTransmission, now_s: float) -> None:
        """Record that a fix was handed to the port."""
        transmission.t_sent_s = self._sent_s = now_s
        self._consecutive_unanswered += 1
        self._awaited.append((now_s, transmission))

    def record_lost(self, count: int) -> None:
        """Record that `count` fixes were lost with the port. They do not count as unanswered, except while sending is
        stopped: only an answer ends that state."""
        if not self._is_stopped:
            self._consecutive_unanswered -= count
        self.cancel_awaited(Reason(ReasonCode.LINK_LOST_BEFORE_ANSWER))

    def handle(self, result: str, reason: Reason, now_s: float) -> FixTransmission | None:
        """Process an answer. `result`: name of a MAV_RESULT. `reason`: explains it. Returns its fix, if any."""
        if self._is_stopped:
            # Late answers may arrive now, and must not be matched to a new fix.
            self._resumes_s = now_s + ANSWER_TIMEOUT_S
        self._consecutive_unanswered = 0
        self.expire_unanswered(now_s)
        is_accepted = result == "ACCEPTED"
        if (result, reason) != self._last_answer:
            level = logging.INFO if is_accepted else logging.WARNING
            log.log(level, "the autopilot's answer to position fixes: %s (%s)", result, reason)
            severity = Severity.INFO if is_accepted or reason.code is ReasonCode.GPS_IN_USE else Severity.WARNING
            text = "fixes are accepted again" if is_accepted else f"fixes refused: {reason.code.summary}"
            if self._last_answer or not is_accepted:
                self._announce(severity, text, "fixes")
        self._last_answer = result, reason
        if is_accepted:
            self._accepted_s = now_s
        else:
            self.refusal = reason
        if not self._awaited:
            return None
        sent_s, transmission = self._awaited.popleft()
        transmission.outcome = FixAnswer(result, None if is_accepted else reason, now_s - sent_s)
        return transmission

    def expire_unanswered(self, now_s: float) -> None:
        """Count the fixes sent more than a second ago as unanswered."""
        while self._awaited and self._awaited[0][1].sent and now_s - self._awaited[0][0] > ANSWER_TIMEOUT_S:
            self._give_up(Reason(ReasonCode.NO_ANSWER, {"limit_s": ANSWER_TIMEOUT_S}))

    def cancel_awaited(self, reason: Reason) -> None:
        """Stop waiting for answers to the fixes sent, with the reason `reason`."""
        while self._awaited:
            self._give_up(reason)

    def report_silence(self, why: Reason, now_s: float) -> None:
        """Report when fixes are no longer answered (with the likely reason `why`), or are answered again."""
        self.expire_unanswered(now_s)
        is_stopped = self._consecutive_unanswered >= MAX_UNANSWERED
        if is_stopped == self._is_stopped or (is_stopped and now_s - self._sent_s < ANSWER_TIMEOUT_S):
            return
        self._is_stopped = is_stopped
        if is_stopped:
            log.warning("no answer to five consecutive fixes (%s): now sending one every %g s", why, RETRY_INTERVAL_S)
            self._announce(Severity.WARNING, f"fixes unanswered: {why.code.summary}", "answers")
        else:
            log.warning("position fixes are answered again: sending has resumed")
            self._announce(Severity.INFO, "fixes are answered again", "answers")

    def _drop(self, transmission: FixTransmission, why: Reason) -> None:
        self.dropped += 1
        transmission.settle(False, why)

    def _give_up(self, reason: Reason) -> None:
        """Stop waiting for the answer to the oldest fix sent; the autopilot may still use that fix."""
        sent_s, transmission = self._awaited.popleft()
        self._accepted_s = max(self._accepted_s, sent_s)
        if transmission.sent:
            self.unanswered += 1
            transmission.outcome = FixAnswer(None, reason, None)


def compensate_lag(fix: Fix, now_s: float, lag_s: float, vehicle: Vehicle | None) -> Fix:
    """Adapt a fix for an autopilot that treats a message received at `now_s` as sent `lag_s` earlier: reduce its age by
    `lag_s` or, for the part that exceeds its age, move its position back by the vehicle's velocity."""
    age_reduction_s = min(lag_s, max(0.0, now_s - fix.t_frame_s))
    fix = replace(fix, t_frame_s=fix.t_frame_s + age_reduction_s)
    if age_reduction_s == lag_s or vehicle is None or vehicle.velocity_m_s is None:
        return fix
    east_m, north_m = (-(lag_s - age_reduction_s) * speed_m_s for speed_m_s in vehicle.velocity_m_s)
    lat_deg, lon_deg = offset_position(fix.lat_deg, fix.lon_deg, east_m, north_m)
    return replace(fix, lat_deg=lat_deg, lon_deg=lon_deg)
