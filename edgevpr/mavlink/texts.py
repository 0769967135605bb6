"""The texts that wait for their turn to be told to the people on the ground: they hate a flood of them."""

import logging
import math
from typing import NamedTuple

from edgevpr.mavlink.messages import Severity, status_text
from edgevpr.mavlink.wire import Message

SPACING_S = 5.0
WAITING_MAX = 16

log = logging.getLogger(__name__)


class News(NamedTuple):
    """A change that the ground is told of: whether it is alarming, and its text and topic."""

    is_alarming: bool
    text: str
    topic: str


class Texts:
    """The waiting texts: one in five seconds is sent, a warning before a note. They are used in turns only.

    Texts of one `topic` are about the same thing, and the newest of them counts: it takes the place of one that waits,
    and says nothing where the ground has heard the same last. A warning is not lost in this way: the note that it is
    over comes after it.
    """

    def __init__(self) -> None:
        self._waiting: dict[tuple[str, Severity], str] = {}  # the oldest first
        self._last: dict[str, str] = {}  # the last text sent of each topic
        self._spacing_s = SPACING_S
        self._sent_s = -math.inf

    def __len__(self) -> int:
        """Return the number of waiting texts."""
        return len(self._waiting)

    def put(self, severity: Severity, text: str, topic: str | None = None) -> None:
        """Let a text wait. One without a topic is about nothing else (it is its own topic, and may be said again)."""
        topic = topic or text
        warning, note = (topic, Severity.WARNING), (topic, Severity.INFO)
        if severity is Severity.WARNING:
            self._waiting.pop(note, None)
            if (replaced := self._waiting.get(warning)) not in (None, text):
                log.info("the ground is not told %r, but what came after it: %r", replaced, text)
        self._waiting[topic, severity] = text
        others_wait = warning in self._waiting and note in self._waiting
        if not others_wait and self._last.get(topic) == text:
            del self._waiting[topic, severity]
        if len(self._waiting) > WAITING_MAX:
            dropped = self._oldest(Severity.INFO)
            lost_text = self._waiting.pop(dropped)
            if dropped[1] is Severity.WARNING:
                log.warning("the ground is not told, since too many texts wait: %s", lost_text)

    def next(self, now_s: float) -> Message | None:
        """Return the text that is to be sent at this moment, None where there is none or it is too early."""
        if not self._waiting or now_s - self._sent_s < self._spacing_s:
            return None
        topic, severity = chosen = self._oldest(Severity.WARNING)
        text = self._waiting.pop(chosen)
        if topic != text:
            self._last[topic] = text
        self._sent_s = now_s
        return status_text(severity, f"edgevpr: {text}")

    def hurry(self) -> None:
        """Let no text wait any more: the link is about to be closed."""
        self._spacing_s = 0.0

    def _oldest(self, severity: Severity) -> tuple[str, Severity]:
        """Return the key of the oldest text of a severity, of the oldest text of all where there is none."""
        return next((key for key in self._waiting if key[1] is severity), next(iter(self._waiting)))
