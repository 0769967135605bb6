"""The links of a flight that is replayed: they hear what was heard, and what they say is held against what was said."""

import logging
from base64 import b64decode
from collections import Counter, deque
from typing import Any

from edgevpr.mavlink.fixes import Sending
from edgevpr.mavlink.groundlink import GroundLink
from edgevpr.mavlink.line import LOST
from edgevpr.mavlink.link import Link
from edgevpr.mavlink.signing import KEY_BYTES
from edgevpr.mavlink.wire import Message, mavlink

_log = logging.getLogger(__name__)


class ReplayedLink(Link):
    """A link without a port and a thread: its turns are those on the tape, a `Playback` with `packets`."""

    def start(self) -> None:
        """Take the turns of the tape from now on."""
        self._leaving: deque[Sending] = deque()
        self._tape.links[self.name] = self._perform

    def close(self) -> None:
        """Let no text wait any more; the rest is on the tape."""
        with self.turn("close"):
            self._conversation.texts.hurry()

    def _perform(self, t_s: float, steps: list[list[Any]]) -> None:
        with self._turns.again(t_s):
            for step, *values in steps:
                try:
                    getattr(self, f"_{step}")(*values)
                except Exception:  # as in the flight, whose link went on with the next turn
                    _log.debug("a turn of the link failed", exc_info=True)

    def _waits(self) -> None:
        self._conversation.fixes.drop_stale(self._turns.now_s())

    def _answers(self) -> None:
        self._conversation.tell_of_answers()

    def _heard(self, data: str, sender: list[Any] | None, verdicts: list[str | None]) -> None:
        if verdicts:
            self._settings.signing.verdicts = deque(verdicts)
        self._conversation.hear(b64decode(data), self._turns.now_s(), sender and tuple(sender))

    def _said(self, then: str | None) -> None:
        packet, sending = self._conversation.next_packet() or (None, None)
        if sending:
            self._leaving.append(sending)
        self._tape.packets.compare(self._turns.now_s(), self.name, then and b64decode(then), packet)

    def _departed(self, count: int) -> None:
        departed = [self._leaving.popleft() for _ in range(min(count, len(self._leaving)))]
        for sending in departed:
            sending.settle(True)
        self._conversation.note_departed(departed)

    def _lost(self, count: int) -> None:
        self._throw_away()
        self._conversation.break_off(count)

    def _closed(self, count: int) -> None:
        self._throw_away()
        self._conversation.end()

    def _throw_away(self) -> None:
        for sending in self._leaving:
            sending.settle(False, LOST)
        self._leaving.clear()


class ReplayedGround(GroundLink, ReplayedLink):
    """The link to the ground, likewise."""


class ReplayedSigning:
    """Signs with no key that anybody has, and admits what was admitted: `verdicts` are those on the next messages, why
    each was refused (None: it was not)."""

    def __init__(self) -> None:
        self.refused: Counter[str] = Counter()
        self.verdicts: deque[str | None] = deque()

    def of_ground(self) -> "ReplayedSigning":
        """Return that of the link to the ground."""
        return ReplayedSigning()

    def take_verdicts(self) -> list[str | None]:
        """Return none: they are on the tape."""
        return []

    def stamp(self, packer: mavlink.MAVLink) -> None:
        """Let a packer sign its next message."""
        signing = packer.signing
        signing.sign_outgoing, signing.secret_key, signing.link_id, signing.timestamp = True, bytes(KEY_BYTES), 1, 1

    def admits(self, message: Message) -> bool:
        """Tell whether a message was believed."""
        reason = self.verdicts.popleft() if self.verdicts else None
        if reason:
            self.refused[reason] += 1
        return reason is None
