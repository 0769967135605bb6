"""The queues of the link: messages, of which the newest matter most, and fixes, which are never sent late."""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from threading import Event, Lock

from edgevpr.core.types import FIX_MAX_AGE_S
from edgevpr.mavlink.messages import Fix
from edgevpr.mavlink.wire import Message

MESSAGES_MAX = 64
FIXES_MAX = 8
# The longest that a fix may wait, from `put_fix` on and in all buffers together, unless the configuration says another.
# This limits what the link adds to the age of a frame; types.FIX_MAX_AGE_S limits the age itself, which is mostly the
# time that matching took and which the autopilot is told. A fix must keep both limits.
MAX_FIX_WAIT_S = 1.0


@dataclass(frozen=True, slots=True)
class Answer:
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
        self.fix = fix
        self.due_s = due_s
        self.sent: bool | None = None
        self.why: str | None = None
        self.t_sent_s: float | None = None
        self.outcome: Answer | None = None
        self._settled = Event()

    @property
    def answer(self) -> str | None:
        """The answer of the autopilot, the name of a MAV_RESULT; None: no answer (yet)."""
        return self.outcome and self.outcome.result

    def conclude(self, outcome: Answer) -> None:
        """Set the answer, or that there is none."""
        self.outcome = outcome

    def settle(self, sent: bool, why: str | None = None) -> None:
        """Set the outcome: sent, or not sent and why."""
        self.sent, self.why = sent, why
        self._settled.set()

    def wait(self, timeout_s: float) -> None:
        """Wait until the fix is sent or given up, `timeout_s` seconds at most."""
        self._settled.wait(timeout_s)


class Outbox:
    """Two bounded queues from any number of threads to the thread of the link."""

    def __init__(self, max_fix_wait_s: float = MAX_FIX_WAIT_S) -> None:
        self._lock = Lock()
        self._messages: deque[Message] = deque(maxlen=MESSAGES_MAX)
        self._fixes: deque[Sending] = deque()
        self._max_fix_wait_s = max_fix_wait_s
        self.dropped_queue_full = 0
        self.dropped_stale_fixes = 0
        self.withheld_fixes = 0
        self.copy_to: Callable[[Message], None] = lambda message: None  # gets every message that is queued, and no fix

    def put(self, message: Message) -> None:
        """Queue a message; if the queue is full, the oldest message is dropped."""
        with self._lock:
            self.dropped_queue_full += len(self._messages) == MESSAGES_MAX
            self._messages.append(message)
        self.copy_to(message)

    def put_fix(self, fix: Fix, now_s: float) -> Sending:
        """Queue a fix, to be sent within the longest wait and before its frame is 5 s old, or not at all."""
        sending = Sending(fix, min(now_s + self._max_fix_wait_s, fix.t_frame_s + FIX_MAX_AGE_S))
        age_s = now_s - fix.t_frame_s
        with self._lock:
            if age_s > FIX_MAX_AGE_S:
                self._drop(sending, f"its frame is {age_s:.1f} s old, and {FIX_MAX_AGE_S:g} s are the limit")
                return sending
            if len(self._fixes) == FIXES_MAX:
                self._drop(self._fixes.popleft(), "newer ones came before its turn")
            self._fixes.append(sending)
        return sending

    def next_message(self) -> Message | None:
        with self._lock:
            return self._messages.popleft() if self._messages else None

    def next_fix(self, now_s: float) -> Sending | None:
        """Return the oldest fix that may still be sent (None: no fix), and drop those that have waited too long."""
        self.drop_stale_fixes(now_s)
        with self._lock:
            return self._fixes.popleft() if self._fixes else None

    def drop_stale_fixes(self, now_s: float) -> None:
        """Drop the fixes that have waited too long."""
        with self._lock:
            for sending in self._fixes:
                if now_s > sending.due_s:
                    self._drop(sending, f"no autopilot was there to take it within {self._max_fix_wait_s:g} s")
            self._fixes = deque(sending for sending in self._fixes if sending.sent is None)

    def withhold_fixes(self, why: str) -> None:
        """Drop all fixes, for a reason that is the autopilot's."""
        with self._lock:
            self.withheld_fixes += len(self._fixes)
            for sending in self._fixes:
                sending.settle(False, why)
            self._fixes.clear()

    def _drop(self, sending: Sending, why: str) -> None:
        self.dropped_stale_fixes += 1
        sending.settle(False, why)

    def __len__(self) -> int:
        """Return the number of waiting messages, without fixes."""
        return len(self._messages)
