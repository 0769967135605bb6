"""The answers to our fixes: an autopilot that gives none is sent none."""

import math

UNANSWERED_MAX = 5
TRIED_AGAIN_AFTER_S = 10.0  # while the sending is stopped, one fix in so long asks whether it is answered again
# An answer takes some tens of milliseconds, over a radio up to half a second. So long after the last fix it is said
# that the sending is stopped; and so long after the first answer, those to the fixes before it have arrived, too.
ANSWERED_WITHIN_S = 1.0


class Answers:
    """The number of fixes in a row that have no answer, and what follows from it: five stop the sending, until one is
    answered again. An answer names no fix, so any one ends the row."""

    def __init__(self) -> None:
        self.unanswered = 0
        self.is_stopped = False  # as it was last said
        self._sent_s = -math.inf
        self._resumes_s = -math.inf

    def why_not(self, now_s: float) -> str | None:
        """Return the reason why a fix must not be sent at this moment, None where it may be sent."""
        if self.unanswered >= UNANSWERED_MAX and now_s - self._sent_s < TRIED_AGAIN_AFTER_S:
            return "not sent: five fixes in a row had no answer"
        if now_s < self._resumes_s:
            return "not sent: the autopilot has only just begun to answer again"
        return None

    def note_sent(self, now_s: float) -> None:
        """Note that a fix was handed to the port."""
        self.unanswered += 1
        self._sent_s = now_s

    def note_lost(self, fixes: int) -> None:
        """Note that so many fixes were thrown away with the port: nobody could answer them. Once the sending is
        stopped, only an answer changes that."""
        if not self.is_stopped:
            self.unanswered -= fixes

    def note_answer(self, now_s: float) -> None:
        """Note an answer."""
        if self.is_stopped:
            # All those fixes may be answered now, and these answers must not pass for one to a new fix.
            self._resumes_s = now_s + ANSWERED_WITHIN_S
        self.unanswered = 0

    def has_changed(self, now_s: float) -> bool:
        """Tell once that the sending has stopped, or goes on; `is_stopped` says which."""
        is_stopped = self.unanswered >= UNANSWERED_MAX
        if is_stopped == self.is_stopped or (is_stopped and now_s - self._sent_s < ANSWERED_WITHIN_S):
            return False
        self.is_stopped = is_stopped
        return True
