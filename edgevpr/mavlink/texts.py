"""The queue of texts for the people on the ground: it spaces them out, and drops repeated and outdated ones."""

import logging
import math

from edgevpr.mavlink.messages import Severity, status_text
from edgevpr.mavlink.wire import Message

SPACING_S = 5.0
WAITING_MAX = 16

News = tuple[Severity, str, str]  # a change to be announced to the ground station: severity, text and topic

log = logging.getLogger(__name__)


class Texts:
    """The texts that wait to be sent, one in five seconds, warnings before notes (texts of severity INFO). Use it
    inside turns only (see `turns`).

    Texts of one `topic` are about the same subject, and the newest counts: a new text replaces a waiting one of its
    topic, and is dropped if it equals the last text sent of its topic. A note does not replace a waiting warning, but
    is sent after it.
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
        """Queue a text. A text without a `topic` is a topic of its own, and may be sent again."""
        topic = topic or text
        warning, note = (topic, Severity.WARNING), (topic, Severity.INFO)
        if severity is Severity.WARNING:
            self._waiting.pop(note, None)
        self._waiting[topic, severity] = text
        others_wait = warning in self._waiting and note in self._waiting
        if not others_wait and self._last.get(topic) == text:
            del self._waiting[topic, severity]
        if len(self._waiting) > WAITING_MAX:
            lost_text = self._waiting.pop(self._oldest(Severity.INFO))
            log.warning("the ground is not told, since too many texts wait: %s", lost_text)

    def next(self, now_s: float) -> Message | None:
        """Return the STATUSTEXT that is to be sent now; None if no text waits, or the last one was too recent."""
        if not self._waiting or now_s - self._sent_s < self._spacing_s:
            return None
        topic, severity = chosen = self._oldest(Severity.WARNING)
        text = self._waiting.pop(chosen)
        if topic != text:
            self._last[topic] = text
        self._sent_s = now_s
        return status_text(severity, f"edgevpr: {text}")

    def hurry(self) -> None:
        """Send the remaining texts without pauses: the link is about to be closed."""
        self._spacing_s = 0.0

    def _oldest(self, severity: Severity) -> tuple[str, Severity]:
        """Return the key of the oldest waiting text of this severity, or of the oldest of all if there is none."""
        return next((key for key in self._waiting if key[1] is severity), next(iter(self._waiting)))
