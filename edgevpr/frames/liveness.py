"""Decides when a live source counts as lost, frozen or damaged, and when to reopen it. What matters is the time since
its last new picture, even if anything else arrives (audio, damaged pictures, repeats)."""

from collections import deque
from dataclasses import dataclass
from statistics import median_low

from edgevpr.frames.shot import Condition, Refusal

LOST_AFTER_S = 3.0  # without a new picture, if the source usually delivers more than one in this time
# While the rate is unknown: key frames, and pictures of a slow camera, arrive at least every ten seconds.
_UNKNOWN_RATE_TIMEOUT_S = 12.0
_RATE_INTERVALS = 5  # number of recent intervals between pictures whose median is used
_MISSED_INTERVALS = 2.5  # a slow source counts as lost if two pictures are missing
_MAX_TIMEOUT_S = 30.0  # any source without a picture for this long counts as lost
_FROZEN_AFTER_S = 1.0
_MIN_REPEATS = 3  # in addition to the time: a slow camera may deliver fewer than three pictures a second
_DAMAGED_REOPEN_S = 5.0  # longer than a stream needs to recover from a lost packet
_FROZEN_REOPEN_S = 5.0  # doubled each time if reopening does not help
_MAX_FROZEN_REOPEN_S = 30.0
_LATE_TEXT = "late: the age of its pictures is unknown, because timestamps are unsteady or decoding lags behind"
_LATE_REOPEN_S = 30.0  # longer than it takes to estimate a clock's rate


@dataclass(frozen=True, slots=True)
class Fault:
    """What is wrong with a source. `text` is for people. `must_reopen`: it lasts too long, so reopen the source."""

    condition: Condition
    text: str
    must_reopen: bool


class Liveness:
    """Detects faults of a source from its pictures. Times are in seconds of the monotonic clock."""

    def __init__(self) -> None:
        self._intervals_s: deque[float] = deque(maxlen=_RATE_INTERVALS)
        self._last_new_s: float | None = None
        self._waiting_since_s = self._refusal_s = 0.0
        self._is_rate_known = False
        self._refusal: Refusal | None = None
        self._repeats = 0
        self._frozen_reopen_s = _FROZEN_REOPEN_S
        self._may_be_stale = False

    def record_opening(self, now_s: float) -> None:
        """Record that the source is open (again)."""
        self._waiting_since_s, self._is_rate_known = now_s, False
        self._refusal, self._repeats = None, 0

    def record_picture(self, now_s: float) -> Refusal | None:
        """Record a picture that differs from those before it. Returns FROZEN for the first picture after a frozen
        source was reopened, because it may be the frozen picture re-encoded; otherwise None."""
        if self._may_be_stale:
            self._may_be_stale = False
            return Refusal.FROZEN
        if self._last_new_s is not None:
            self._intervals_s.append(now_s - self._last_new_s)
        self._waiting_since_s = self._last_new_s = now_s
        self._is_rate_known = bool(self._intervals_s)
        self._refusal, self._repeats = None, 0
        self._frozen_reopen_s = _FROZEN_REOPEN_S
        return None

    def record_refusal(self, refusal: Refusal, now_s: float) -> None:
        """Record a rejected picture."""
        self._refusal, self._refusal_s = refusal, now_s
        self._repeats = self._repeats + 1 if refusal is Refusal.FROZEN else 0

    def find_fault(self, now_s: float) -> Fault | None:
        """Return the fault of the source at this time, or None if there is none."""
        silent_s, timeout_s = now_s - self._waiting_since_s, LOST_AFTER_S
        if self._is_rate_known:
            timeout_s = min(max(LOST_AFTER_S, _MISSED_INTERVALS * median_low(self._intervals_s)), _MAX_TIMEOUT_S)
        limit_s = timeout_s if self._is_rate_known else _UNKNOWN_RATE_TIMEOUT_S
        if self._repeats >= _MIN_REPEATS and silent_s > _FROZEN_AFTER_S:
            must_reopen = silent_s > max(self._frozen_reopen_s, timeout_s)
            return Fault(Condition.FROZEN, "frozen: the same picture keeps arriving", must_reopen)
        if self._refusal in (Refusal.DAMAGED, Refusal.PATCHED) and silent_s > timeout_s:
            must_reopen = silent_s > max(_DAMAGED_REOPEN_S, limit_s)
            return Fault(Condition.DAMAGED, "damaged: no picture is complete", must_reopen)
        is_late = self._refusal is Refusal.LATE and now_s - self._refusal_s <= LOST_AFTER_S
        if silent_s > limit_s and is_late:
            # Before the first picture, it may still wait for a key frame, or for enough pictures to estimate their age.
            return Fault(Condition.LATE, _LATE_TEXT, silent_s > _LATE_REOPEN_S)
        return Fault(Condition.LOST, "lost: no new picture", True) if silent_s > limit_s else None

    def record_reopening(self, fault: Fault) -> None:
        """Record that the source is being reopened because of this fault."""
        if fault.condition is Condition.FROZEN:
            self._may_be_stale = True
            self._frozen_reopen_s = min(2 * self._frozen_reopen_s, _MAX_FROZEN_REOPEN_S)
