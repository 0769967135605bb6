"""Requests received over the link, and texts for the ground station. A command is a request that only the flight itself
can carry out, such as a pause. Used by `conversation` and the flight."""

import math
from collections.abc import Callable
from enum import IntEnum

from edgevpr.mavlink.messages import Severity, make_status_text
from edgevpr.mavlink.wire import Message, mavlink

MAX_ANSWERS_PER_S = 50  # answers to a flood of requests must not displace our own messages
TEXT_INTERVAL_S = 5.0

Announce = Callable[[Severity, str, str], None]  # sends a text to the ground station: severity, text and topic


class UserCommand(IntEnum):
    """A request to the flight; the value is the first parameter of MAV_CMD_USER_1 (31010)."""

    PAUSE = 1
    RESUME = 2


class Requests:
    """Answers requests received over the link, and stores the newest command until the flight's main loop takes it.
    Commands are rejected until `is_flying` is set. Other messages to us, of an unknown kind or above the rate limit,
    are ignored. While `is_paused`, no fix may be sent."""

    def __init__(self) -> None:
        self.is_flying = False
        self.is_paused = False
        self._waiting: tuple[UserCommand, str] | None = None
        self._second_s, self._answered = 0.0, 0

    def take(self) -> tuple[UserCommand, str] | None:
        """Return the newest command since the last call (None: none) and its sender, as "SYSTEM_ID/COMPONENT_ID"."""
        waiting, self._waiting = self._waiting, None
        return waiting

    def handle(self, message: Message, own_id: tuple[int, int], now_s: float) -> tuple[Message, ...]:
        """Process a message received at `now_s`, and return the replies. `own_id`: our (system id, component id)."""
        sender = message.get_srcSystem(), message.get_srcComponent()
        if sender[0] == 0 or sender == own_id or not _needs_answer(message, own_id):
            return ()
        kind = message.get_type()
        if kind not in ("TIMESYNC", "COMMAND_LONG", "COMMAND_INT") or not self._may_answer(now_s):
            return ()
        if kind == "TIMESYNC":
            return (mavlink.MAVLink_timesync_message(tc1=round(now_s * 1e9), ts1=message.ts1),)
        is_command = message.command == mavlink.MAV_CMD_USER_1
        result = self._store_command(message.param1, sender) if is_command else int(mavlink.MAV_RESULT_UNSUPPORTED)
        target = {"target_system": sender[0], "target_component": sender[1]}
        return (mavlink.MAVLink_command_ack_message(message.command, result, **target),)

    def _store_command(self, code: float, sender: tuple[int, int]) -> int:
        """Store a command; it replaces one that is still waiting. Returns a MAV_RESULT."""
        if code not in tuple(UserCommand):  # an integral float equals its integer; NaN equals nothing
            return int(mavlink.MAV_RESULT_DENIED)
        if not self.is_flying:
            return int(mavlink.MAV_RESULT_TEMPORARILY_REJECTED)
        command = UserCommand(int(code))
        self.is_paused = command is UserCommand.PAUSE
        self._waiting = command, f"{sender[0]}/{sender[1]}"
        return int(mavlink.MAV_RESULT_ACCEPTED)

    def _may_answer(self, now_s: float) -> bool:
        if now_s - self._second_s >= 1.0:
            self._second_s, self._answered = now_s, 0
        self._answered += 1
        return self._answered <= MAX_ANSWERS_PER_S


class Texts:
    """The queue of status texts. One is sent every five seconds, warnings before notes (texts of severity INFO). A new
    text replaces a waiting one of the same `topic`, and is dropped if it equals the last one sent. However, a note does
    not replace a waiting warning: it is sent after the warning."""

    def __init__(self) -> None:
        self._waiting: dict[tuple[str, Severity], str] = {}  # oldest first
        self._last: dict[str, str] = {}  # last text sent, by topic
        self._spacing_s = TEXT_INTERVAL_S
        self._sent_s = -math.inf

    def __len__(self) -> int:
        return len(self._waiting)

    def put(self, severity: Severity, text: str, topic: str | None = None) -> None:
        """Queue a text. Without a `topic`, the text itself is its topic."""
        topic = topic or text
        if severity is Severity.WARNING:
            self._waiting.pop((topic, Severity.INFO), None)
        self._waiting[topic, severity] = text
        follows_warning = severity is Severity.INFO and (topic, Severity.WARNING) in self._waiting
        if not follows_warning and self._last.get(topic) == text:
            del self._waiting[topic, severity]

    def next(self, now_s: float) -> Message | None:
        """Return the STATUSTEXT to send now; None if no text waits, or the last one was sent too recently."""
        if not self._waiting or now_s - self._sent_s < self._spacing_s:
            return None
        topic, severity = key = min(self._waiting, key=lambda item: item[1])  # the oldest warning or, if none, note
        self._sent_s, self._last[topic] = now_s, self._waiting.pop(key)
        return make_status_text(severity, f"edgevpr: {self._last[topic]}")

    def remove_pauses(self) -> None:
        """Send the remaining texts without pauses, because the link will be closed."""
        self._spacing_s = 0.0


def _needs_answer(message: Message, own_id: tuple[int, int]) -> bool:
    """Return True if a message requests an answer from us: a TIMESYNC without `tc1`, or a message addressed to us
    alone. A broadcast command is not answered, because every component would acknowledge it."""
    if message.get_type() == "TIMESYNC":
        return bool(message.tc1 == 0)
    target = getattr(message, "target_system", None), getattr(message, "target_component", None)
    return target == own_id and message.get_type() != "COMMAND_ACK"
