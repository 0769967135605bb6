"""Counts and state of a link."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkStats:
    """Counts and state of a link. `trouble` is the reason why it is or last was not open, None once data arrives.

    `foreign_messages` came from another autopilot or another address than ours and were refused. `withheld_fixes` were
    not sent because those before had no answer, or the ground has paused the flight. `unanswered_fixes` were sent and
    had no answer within a second, and `refused_why` is why the last one was refused (None: none was), in a few words.
    `commands` counts those that were for us, by result, and `ignored_requests` what else was for us and had no effect.
    With a signing key, `refused_signatures` counts the messages without a right signature or time stamp, by reason.
    """

    connected: bool
    trouble: str | None
    autopilot_heard: bool
    autopilot_system_id: int | None
    sent: dict[str, int]
    received: dict[str, int]
    acks: dict[str, int]
    dropped_stale_fixes: int
    withheld_fixes: int
    commands: dict[str, int]
    ignored_requests: int
    unanswered_fixes: int
    refused_why: str | None
    foreign_messages: int
    refused_signatures: dict[str, int]
    dropped_queue_full: int
    bad_bytes: int
    reopened: int

    @property
    def fixes_sent(self) -> int:
        """Number of position fixes sent."""
        return self.sent.get("COMMAND_INT", 0)
