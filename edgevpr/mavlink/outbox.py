"""What waits to be sent: messages, of which the newest matter, and fixes, which are never sent late."""

from collections import deque
from threading import Lock

from edgevpr.mavlink.messages import Fix
from edgevpr.mavlink.wire import Message

MESSAGES_MAX = 64
FIXES_MAX = 8
FIX_MAX_WAIT_S = 1.0
FIX_MAX_AGE_S = 5.0  # ArduPilot takes an older frame for one of 5 s ago, and would set the vehicle back too little


class Outbox:
    """Two bounded queues between any number of threads that send and the one that owns the link."""

    def __init__(self) -> None:
        self._lock = Lock()
        self._messages: deque[Message] = deque(maxlen=MESSAGES_MAX)
        self._fixes: deque[tuple[float, Fix]] = deque(maxlen=FIXES_MAX)
        self.dropped_queue_full = 0
        self.dropped_stale_fixes = 0

    def put(self, message: Message) -> None:
        """Queue a message; where the queue is full, the oldest goes."""
        with self._lock:
            self.dropped_queue_full += len(self._messages) == MESSAGES_MAX
            self._messages.append(message)

    def put_fix(self, fix: Fix, now_s: float) -> None:
        """Queue a fix, to be sent soon or not at all."""
        with self._lock:
            self.dropped_stale_fixes += len(self._fixes) == FIXES_MAX
            self._fixes.append((min(now_s + FIX_MAX_WAIT_S, fix.t_frame_s + FIX_MAX_AGE_S), fix))

    def next_message(self) -> Message | None:
        with self._lock:
            return self._messages.popleft() if self._messages else None

    def next_fix(self, now_s: float) -> Fix | None:
        """Give the oldest fix that is still true, and drop those before it."""
        self.drop_stale_fixes(now_s)
        with self._lock:
            return self._fixes.popleft()[1] if self._fixes else None

    def drop_stale_fixes(self, now_s: float) -> None:
        with self._lock:
            fresh = [entry for entry in self._fixes if now_s <= entry[0]]
            self.dropped_stale_fixes += len(self._fixes) - len(fresh)
            self._fixes = deque(fresh, maxlen=FIXES_MAX)

    def __len__(self) -> int:
        """Count the messages that wait."""
        return len(self._messages)
