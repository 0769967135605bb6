"""The queues of the link: messages, of which the newest matter most, and fixes, which are never sent late."""

from collections import deque
from threading import Event, Lock

from edgevpr.mavlink.messages import Fix
from edgevpr.mavlink.wire import Message
from edgevpr.types import FIX_MAX_AGE_S

MESSAGES_MAX = 64
FIXES_MAX = 8
FIX_MAX_WAIT_S = 1.0


class Sending:
    """A fix to be sent, and its outcome. `sent` is None while the fix waits, then True, or False (`why` gives the
    reason). `answer` is the answer of the autopilot, the name of a MAV_RESULT, None while there is none. Once the fix
    is queued, only the link's thread changes these."""

    def __init__(self, fix: Fix) -> None:
        self.fix = fix
        self.sent: bool | None = None
        self.why: str | None = None
        self.answer: str | None = None
        self._settled = Event()

    def settle(self, sent: bool, why: str | None = None) -> None:
        """Set the outcome: sent, or not sent and why."""
        self.sent, self.why = sent, why
        self._settled.set()

    def wait(self, timeout_s: float) -> None:
        """Wait until the fix is sent or given up, `timeout_s` seconds at most."""
        self._settled.wait(timeout_s)


class Outbox:
    """Two bounded queues from any number of threads to the thread of the link."""

    def __init__(self) -> None:
        self._lock = Lock()
        self._messages: deque[Message] = deque(maxlen=MESSAGES_MAX)
        self._fixes: deque[tuple[float, Sending]] = deque()
        self.dropped_queue_full = 0
        self.dropped_stale_fixes = 0

    def put(self, message: Message) -> None:
        """Queue a message; if the queue is full, the oldest message is dropped."""
        with self._lock:
            self.dropped_queue_full += len(self._messages) == MESSAGES_MAX
            self._messages.append(message)

    def put_fix(self, fix: Fix, now_s: float) -> Sending:
        """Queue a fix, to be sent within one second and before its frame is 5 s old, or not at all."""
        sending = Sending(fix)
        age_s = now_s - fix.t_frame_s
        with self._lock:
            if age_s > FIX_MAX_AGE_S:
                self._drop(sending, f"its frame is {age_s:.1f} s old, and {FIX_MAX_AGE_S:g} s are the limit")
                return sending
            if len(self._fixes) == FIXES_MAX:
                self._drop(self._fixes.popleft()[1], "newer ones came before its turn")
            self._fixes.append((min(now_s + FIX_MAX_WAIT_S, fix.t_frame_s + FIX_MAX_AGE_S), sending))
        return sending

    def next_message(self) -> Message | None:
        with self._lock:
            return self._messages.popleft() if self._messages else None

    def next_fix(self, now_s: float) -> Sending | None:
        """Return the oldest fix that may still be sent (None: no fix), and drop those that have waited too long."""
        self.drop_stale_fixes(now_s)
        with self._lock:
            return self._fixes.popleft()[1] if self._fixes else None

    def drop_stale_fixes(self, now_s: float) -> None:
        """Drop the fixes that have waited too long."""
        with self._lock:
            for due_s, sending in self._fixes:
                if now_s > due_s:
                    self._drop(sending, f"no autopilot was there to take it within {FIX_MAX_WAIT_S:g} s")
            self._fixes = deque(entry for entry in self._fixes if entry[1].sent is None)

    def _drop(self, sending: Sending, why: str) -> None:
        self.dropped_stale_fixes += 1
        sending.settle(False, why)

    def __len__(self) -> int:
        """Return the number of waiting messages, without fixes."""
        return len(self._messages)
