"""The texts that wait for their turn to be told to the people on the ground: they hate a flood of them."""

import logging
import math
from collections.abc import Callable
from threading import Lock

from edgevpr.mavlink.messages import Severity, status_text
from edgevpr.mavlink.wire import Message

SPACING_S = 5.0
WAITING_MAX = 16

log = logging.getLogger(__name__)


class Texts:
    """The waiting texts: one in five seconds is sent, a warning before a note.

    Texts of one `topic` are about the same thing, and the newest of them counts: it takes the place of one that waits,
    and says nothing where the ground has heard the same last. A warning is not lost in this way: the note that it is
    over comes after it. `put` and `hurry` may be called from any thread.
    """

    def __init__(self) -> None:
        self._lock = Lock()
        self._waiting: dict[tuple[str, Severity], str] = {}  # the oldest first
        self._said: dict[str, str] = {}  # the last text of each topic
        self._spacing_s = SPACING_S
        self._sent_s = -math.inf
        self.copy_to: Callable[[Severity, str, str | None], None] = lambda severity, text, topic: None  # every text

    def put(self, severity: Severity, text: str, topic: str | None = None) -> None:
        """Let a text wait. One without a topic is about nothing else (it is its own topic, and may be said again)."""
        topic_or_text = topic or text
        warning, note = (topic_or_text, Severity.WARNING), (topic_or_text, Severity.INFO)
        with self._lock:
            replaced = self._waiting.get(warning)
            if severity is Severity.WARNING:
                self._waiting.pop(note, None)
                if replaced not in (None, text):
                    log.info("the ground is not told %r, but what came after it: %r", replaced, text)
            self._waiting[topic_or_text, severity] = text
            others_wait = warning in self._waiting and note in self._waiting
            if not others_wait and self._said.get(topic_or_text) == text:
                del self._waiting[topic_or_text, severity]
            if len(self._waiting) > WAITING_MAX:
                self._drop_one()
        self.copy_to(severity, text, topic)

    def next(self, now_s: float) -> Message | None:
        """Return the text that is to be sent at this moment, None where there is none or it is too early."""
        with self._lock:
            if not self._waiting or now_s - self._sent_s < self._spacing_s:
                return None
            topic, severity = chosen = self._first(Severity.WARNING) or self._first(Severity.INFO)
            text = self._waiting.pop(chosen)
            if topic != text:
                self._said[topic] = text
            self._sent_s = now_s
        return status_text(severity, f"edgevpr: {text}")

    def hurry(self) -> None:
        """Let no text wait any more: the link is about to be closed."""
        self._spacing_s = 0.0

    def __len__(self) -> int:
        """Return the number of waiting texts."""
        return len(self._waiting)

    def _first(self, severity: Severity) -> tuple[str, Severity] | None:
        return next((key for key in self._waiting if key[1] is severity), None)

    def _drop_one(self) -> None:
        """Drop the oldest note, or where there is none the oldest warning, which the log then tells."""
        dropped = self._first(Severity.INFO) or self._first(Severity.WARNING)
        text = self._waiting.pop(dropped)
        if dropped[1] is Severity.WARNING:
            log.warning("the ground is not told, since too many texts wait: %s", text)
