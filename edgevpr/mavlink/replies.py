"""The fixes that wait for their answers, and the answer of each.

COMMAND_ACK does not say which fix it answers. It is taken for the answer to the oldest fix that has been sent and has
waited for less than a second. With one fix a second, and an answer in some tens of milliseconds, there is only one such
fix. After a second a fix counts as unanswered, so that a lost answer shifts those that follow for a second at most
where fixes are that far apart. An answer that finds no fix (too late, or one of several to the same fix) is counted,
and belongs to none.
"""

import logging
import math
from collections import deque

from edgevpr.mavlink.answers import ANSWERED_WITHIN_S
from edgevpr.mavlink.outbox import Answer, Sending
from edgevpr.mavlink.reasons import GPS_IN_USE, TAKEN, Reason, State, why

log = logging.getLogger(__name__)


class Replies:
    """The fixes under way. `unanswered` counts those that had no answer, `refusal` is the reason of the last answer
    that refused one (None: none was refused), and `t_fix_s` the time of the newest fix that the autopilot may have
    taken: it said so, has not answered yet, or never did (-inf: there is none)."""

    def __init__(self) -> None:
        self.unanswered = 0
        self.refusal: Reason | None = None
        self.t_fix_s = -math.inf
        self._open: deque[Sending] = deque()
        self._taken_s = -math.inf  # or perhaps taken
        self._said: tuple[str, Reason] | None = None
        self._is_refusing = False
        self._news: tuple[bool, str] | None = None

    def __len__(self) -> int:
        """Return the number of fixes that wait for their answers."""
        return len(self._open)

    def note_sent(self, sending: Sending, now_s: float) -> None:
        """Note that a fix was handed to the port."""
        sending.t_sent_s = now_s
        self._open.append(sending)
        self._note_fixes()

    def note_unanswerable(self, sending: Sending, now_s: float) -> None:
        """Note that a fix was handed to the port in a message that has no answer: it may be taken."""
        sending.t_sent_s = self._taken_s = now_s
        self._note_fixes()
        sending.conclude(Answer(None, "its message has no answer", None))

    def hear(self, result: str, state: State, now_s: float) -> Sending | None:
        """Take in an answer, the name of a MAV_RESULT, of an autopilot in this state; return the fix that it answers,
        None where there is none."""
        self.time_out(now_s)
        reason = why(result, state)
        self._say(result, reason)
        sending = self._open.popleft() if self._open else None
        if result == "ACCEPTED":
            self._taken_s = now_s
        self._note_fixes()
        if sending:
            refused_why = None if reason is TAKEN else reason.sentence
            sending.conclude(Answer(result, refused_why, now_s - sending.t_sent_s))
        return sending

    def time_out(self, now_s: float) -> None:
        """Give up the fixes that have waited for too long."""
        while self._open and self._open[0].sent and now_s - self._open[0].t_sent_s > ANSWERED_WITHIN_S:
            self._give_up(self._open.popleft(), f"it had no answer within {ANSWERED_WITHIN_S:g} s")

    def break_off(self, reason: str) -> None:
        """Give up all fixes under way."""
        while self._open:
            self._give_up(self._open.popleft(), reason)

    def take_news(self) -> tuple[bool, str] | None:
        """Return once that fixes are refused now, or for another reason, or taken again: whether that is alarming, and
        a few words; None: there is no news."""
        news, self._news = self._news, None
        return news

    def _give_up(self, sending: Sending, reason: str) -> None:
        self._taken_s = max(self._taken_s, sending.t_sent_s)  # the other end may have it all the same
        self._note_fixes()
        if sending.sent:
            self.unanswered += 1
            sending.conclude(Answer(None, reason, None))

    def _note_fixes(self) -> None:
        # One value for other threads to read.
        self.t_fix_s = max(self._taken_s, self._open[-1].t_sent_s if self._open else -math.inf)

    def _say(self, result: str, reason: Reason) -> None:
        is_refused = result != "ACCEPTED"
        if (result, reason) != self._said:
            level = logging.WARNING if is_refused else logging.INFO
            log.log(level, "the autopilot's answer to position fixes: %s (%s)", result, reason.sentence)
            if is_refused:
                self._news = reason is not GPS_IN_USE, f"fixes refused: {reason.brief}"
            elif self._is_refusing:
                self._news = False, "fixes are taken again"
        self._said, self._is_refusing = (result, reason), is_refused
        self.refusal = reason if reason is not TAKEN else self.refusal
