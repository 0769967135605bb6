"""Position fixes on their way to the autopilot: those that wait, those under way, and what their answers say.

A fix is never sent late, and an autopilot that answers none is sent none. COMMAND_ACK does not say which fix it
answers. It is taken for the answer to the oldest fix that has been sent and has waited for less than a second. With one
fix a second, and an answer in some tens of milliseconds, there is only one such fix. After a second a fix counts as
unanswered, so that a lost answer shifts those that follow for a second at most where fixes are that far apart. An
answer that finds no fix (too late, or one of several to the same fix) is counted, and belongs to none.
"""

import logging
import math
from collections import deque
from dataclasses import dataclass
from threading import Event

from edgevpr.core.types import FIX_MAX_AGE_S
from edgevpr.mavlink.messages import Fix
from edgevpr.mavlink.readiness import GPS_IN_USE, TAKEN, Reason
from edgevpr.mavlink.texts import News

FIXES_MAX = 8
# The longest that a fix may wait, from `put` on and in all buffers together, unless the configuration says another.
# This limits what the link adds to the age of a frame; types.FIX_MAX_AGE_S limits the age itself, which is mostly the
# time that matching took and which the autopilot is told. A fix must keep both limits.
MAX_FIX_WAIT_S = 1.0
UNANSWERED_MAX = 5  # so many fixes in a row without an answer stop the sending, until one is answered again
TRIED_AGAIN_AFTER_S = 10.0  # while the sending is stopped, one fix in so long asks whether it is answered again
# An answer takes some tens of milliseconds, over a radio up to half a second. So long after the last fix it is said
# that the sending is stopped; and so long after the first answer, those to the fixes before it have arrived, too.
ANSWERED_WITHIN_S = 1.0

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class FixAnswer:
    """Answer of the autopilot to a fix: the name of a MAV_RESULT, why it was refused in words (None: it was taken), and
    the time from sending to answer. Both `result` and `latency_s` are None for a fix that was not answered in time."""

    result: str | None
    why: str | None
    latency_s: float | None


class Sending:
    """A fix to be sent by `due_s`, and its outcome. `sent` is None while the fix waits, then True, or False (`why`
    gives the reason). `t_sent_s` is when the port was given it, and `outcome` the answer of the autopilot, each None
    until then. Once the fix is queued, only the link's thread changes these."""

    def __init__(self, fix: Fix, due_s: float) -> None:
        self.fix, self.due_s = fix, due_s
        self.sent: bool | None = None
        self.why: str | None = None
        self.t_sent_s: float | None = None
        self.outcome: FixAnswer | None = None
        self._settled = Event()

    @property
    def answer(self) -> str | None:
        """The answer of the autopilot, the name of a MAV_RESULT; None: no answer (yet)."""
        return self.outcome.result if self.outcome else None

    def settle(self, sent: bool, why: str | None = None) -> None:
        """Set the outcome: sent, or not sent and why."""
        self.sent, self.why = sent, why
        self._settled.set()

    def wait(self, timeout_s: float) -> None:
        """Wait until the fix is sent or given up, `timeout_s` seconds at most."""
        self._settled.wait(timeout_s)


class Fixes:
    """The fixes of a link, used in its turns only. It counts those `dropped` since they were too old, those `withheld`
    for a reason that is the autopilot's, and those `unanswered`. `refusal` is the reason of the last answer that
    refused a fix (None: none was refused)."""

    def __init__(self, max_wait_s: float = MAX_FIX_WAIT_S) -> None:
        self.dropped = self.withheld = self.unanswered = 0
        self.refusal: Reason | None = None
        self._max_wait_s = max_wait_s
        self._waiting: deque[Sending] = deque()
        self._under_way: deque[tuple[float, Sending]] = deque()  # with the time at which the port was given it
        self._taken_s = -math.inf  # the newest that was taken, or perhaps taken
        self._last_answer: tuple[str, Reason] | None = None
        self._news: News | None = None
        self._sent_s = -math.inf
        self.forget_row()

    def __len__(self) -> int:
        """Return the number of fixes that wait for their answers."""
        return len(self._under_way)

    def forget_row(self) -> None:
        """Begin a new row of fixes without an answer: those before went to another autopilot."""
        self._row = 0
        self._is_stopped = False  # as it was last said
        self._resumes_s = -math.inf

    @property
    def t_fix_s(self) -> float:
        """The time of the newest fix that the autopilot may have taken: it said so, has not answered yet, or never did
        (-inf: there is none)."""
        return max(self._taken_s, self._under_way[-1][0] if self._under_way else -math.inf)

    def put(self, fix: Fix, now_s: float) -> Sending:
        """Queue a fix, to be sent within the longest wait and before its frame is 5 s old, or not at all."""
        sending = Sending(fix, min(now_s + self._max_wait_s, fix.t_frame_s + FIX_MAX_AGE_S))
        age_s = now_s - fix.t_frame_s
        if age_s > FIX_MAX_AGE_S:
            self._drop(sending, f"its frame is {age_s:.1f} s old, and {FIX_MAX_AGE_S:g} s are the limit")
            return sending
        if len(self._waiting) == FIXES_MAX:
            self._drop(self._waiting.popleft(), "newer ones came before its turn")
        self._waiting.append(sending)
        return sending

    def next(self, now_s: float) -> Sending | None:
        """Return the oldest fix that may still be sent (None: no fix), and drop those that have waited too long."""
        self.drop_stale(now_s)
        return self._waiting.popleft() if self._waiting else None

    def drop_stale(self, now_s: float) -> None:
        """Drop the fixes that have waited too long."""
        for sending in self._waiting:
            if now_s > sending.due_s:
                self._drop(sending, f"no autopilot was there to take it within {self._max_wait_s:g} s")
        self._waiting = deque(sending for sending in self._waiting if sending.sent is None)

    def withhold(self, why: str) -> None:
        """Drop all fixes that wait, for a reason that is the autopilot's."""
        self.withheld += len(self._waiting)
        for sending in self._waiting:
            sending.settle(False, why)
        self._waiting.clear()

    def why_not(self, now_s: float) -> str | None:
        """Return the reason why a fix must not be sent at this moment, None where it may be sent."""
        if self._row >= UNANSWERED_MAX and now_s - self._sent_s < TRIED_AGAIN_AFTER_S:
            return "not sent: five fixes in a row had no answer"
        if now_s < self._resumes_s:
            return "not sent: the autopilot has only just begun to answer again"
        return None

    def note_sent(self, sending: Sending, now_s: float, has_answer: bool) -> None:
        """Note that a fix was handed to the port; in a message that has no answer it may be taken."""
        sending.t_sent_s = now_s
        if has_answer:
            self._row += 1
            self._sent_s = now_s
            self._under_way.append((now_s, sending))
        else:
            self._taken_s = now_s
            sending.outcome = FixAnswer(None, "its message has no answer", None)

    def note_lost(self, count: int) -> None:
        """Note that so many fixes were thrown away with the port: nobody could answer them. Once the sending is
        stopped, only an answer changes that."""
        if not self._is_stopped:
            self._row -= count
        self.break_off("the link was lost before its answer came")

    def hear(self, result: str, reason: Reason, now_s: float) -> Sending | None:
        """Take in an answer, the name of a MAV_RESULT, and the reason for it; return the fix that it answers, None
        where there is none. An answer names no fix, so any one ends the row of those without."""
        if self._is_stopped:
            # All those fixes may be answered now, and these answers must not pass for one to a new fix.
            self._resumes_s = now_s + ANSWERED_WITHIN_S
        self._row = 0
        self.time_out(now_s)
        self._note_answer(result, reason)
        if result == "ACCEPTED":
            self._taken_s = now_s
        if not self._under_way:
            return None
        sent_s, sending = self._under_way.popleft()
        sending.outcome = FixAnswer(result, None if reason is TAKEN else reason.sentence, now_s - sent_s)
        return sending

    def time_out(self, now_s: float) -> None:
        """Give up the fixes that have waited for their answers for too long."""
        while self._under_way and self._under_way[0][1].sent and now_s - self._under_way[0][0] > ANSWERED_WITHIN_S:
            self._give_up(f"it had no answer within {ANSWERED_WITHIN_S:g} s")

    def break_off(self, reason: str) -> None:
        """Give up all fixes under way."""
        while self._under_way:
            self._give_up(reason)

    def news_of_silence(self, reason: Reason, now_s: float) -> News | None:
        """Return once that the sending has stopped, since no fix is answered (for this reason), or that it goes on."""
        is_stopped = self._row >= UNANSWERED_MAX
        if is_stopped == self._is_stopped or (is_stopped and now_s - self._sent_s < ANSWERED_WITHIN_S):
            return None
        self._is_stopped = is_stopped
        if not is_stopped:
            log.warning("position fixes are answered again: they are sent again")
            return News(False, "fixes are answered again", "answers")
        log.warning(
            "five fixes in a row had no answer, and only one every %g s is sent until one is answered: %s",
            TRIED_AGAIN_AFTER_S,
            reason.sentence,
        )
        return News(True, f"fixes unanswered: {reason.brief}", "answers")

    def take_news(self) -> News | None:
        """Return once that fixes are refused now, or for another reason, or taken again."""
        news, self._news = self._news, None
        return news

    def _drop(self, sending: Sending, why: str) -> None:
        self.dropped += 1
        sending.settle(False, why)

    def _give_up(self, reason: str) -> None:
        """Give up the fix that waits longest for its answer; the other end may have it all the same."""
        sent_s, sending = self._under_way.popleft()
        self._taken_s = max(self._taken_s, sent_s)
        if sending.sent:
            self.unanswered += 1
            sending.outcome = FixAnswer(None, reason, None)

    def _note_answer(self, result: str, reason: Reason) -> None:
        if (result, reason) != self._last_answer:
            is_refused = result != "ACCEPTED"
            level = logging.WARNING if is_refused else logging.INFO
            log.log(level, "the autopilot's answer to position fixes: %s (%s)", result, reason.sentence)
            if is_refused:
                self._news = News(reason is not GPS_IN_USE, f"fixes refused: {reason.brief}", "fixes")
            elif self._last_answer:
                self._news = News(False, "fixes are taken again", "fixes")
        self._last_answer = result, reason
        self.refusal = self.refusal if reason is TAKEN else reason
