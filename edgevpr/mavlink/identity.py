"""The identity of the one autopilot that a link talks to, and the rule by which another sender may take its place."""

import logging
import math
from dataclasses import dataclass

from edgevpr.mavlink.address import Sender

# A flight controller that restarts is back within 20 s; other senders in the meantime are not it.
RETAKEN_AFTER_S = 30.0
STEADY_S = 5.0  # another sender takes over after heartbeats for this time (not after one stray packet),
GAP_S = 2.5  # without a longer gap: they come once a second, and one may be lost
_OTHERS_MAX = 32  # speakers remembered; a flood of invented ones must not fill the memory

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Speaker:
    """The sender of an autopilot's messages: its system id, and its address (None if the link has one sender only)."""

    system_id: int
    address: Sender | None

    def __str__(self) -> str:
        return f"system {self.system_id}{self.where}"

    @property
    def where(self) -> str:
        """The address as text with a space before it (" at HOST:PORT"); empty without an address."""
        return f" at {self.address[0]}:{self.address[1]}" if self.address else ""


class Identity:
    """Decides which sender is our autopilot: the first one heard or, with `system_id` set, the first with that system
    id.

    It stays our autopilot for as long as it sends. After 30 s of silence, another sender with steady heartbeats takes
    its place: the same system id at another address, or else another system id if only one is there. A system id from
    which a heartbeat came between two heartbeats of ours is another vehicle and is never taken; with `system_id` set,
    no other is. `kept` is our autopilot (None: not heard yet). `foreign_messages` counts the messages refused since
    they came from another autopilot or another address.
    """

    def __init__(self, system_id: int | None = None) -> None:
        self.kept: Speaker | None = None
        self.foreign_messages = 0
        self._configured = system_id
        self._spoke_s = -math.inf
        self._others: dict[Speaker, tuple[float, float]] = {}  # unbroken heartbeats: times of first and last
        self._neighbours: set[int] = set()  # system ids of other vehicles
        self._warnings: set[str] = set()
        self._news: str | None = None

    def take_news(self) -> str | None:
        """Return a short text if another sender has become our autopilot since the last call, else None."""
        news, self._news = self._news, None
        return news

    def admits(self, speaker: Speaker, beats: bool, now_s: float) -> bool:
        """Return True if a message of this speaker comes from our autopilot. `beats`: the message is the heartbeat of
        an autopilot, by which the speaker may become ours. Messages of others are counted."""
        if beats and speaker != self.kept and self._is_next(speaker, now_s):
            self._take(speaker, now_s)
        if speaker != self.kept:
            self.refuse()
            return False
        self._spoke_s = now_s
        if beats:  # a sender of heartbeats while ours still sends cannot be ours under another number
            self._neighbours |= {other.system_id for other in self._others} - {speaker.system_id}
        return True

    def is_elsewhere(self, address: Sender | None) -> bool:
        """Return True if bytes from this address cannot come from our autopilot, whose address is another one."""
        return self.kept is not None and address != self.kept.address

    def refuse(self) -> None:
        """Count a message of another sender in `foreign_messages`, unless any sender may still become our autopilot."""
        self.foreign_messages += self.kept is not None or self._configured is not None

    def _is_next(self, speaker: Speaker, now_s: float) -> bool:
        """Note the heartbeat of a speaker that is not our autopilot; return True if it becomes ours now. Log a warning
        about a second vehicle, since two on one link are dangerous."""
        kept = self.kept
        if self._configured not in (None, speaker.system_id):
            self._warn("configured", f"{speaker} is not system {self._configured}, which is configured: it gets no fix")
            return False
        if kept is None:
            return True
        if speaker.system_id == kept.system_id:
            self._warn("address", f"{speaker} is a second autopilot of that number; fixes go to {kept} only")
        else:
            self._warn(
                "system",
                f"a second autopilot, {speaker}, is on this link; fixes go to {kept} only: give each vehicle a link "
                "of its own, or set mavlink.system_id",
            )
        steady_s = self._steady_s(speaker, now_s)
        # Another system id is taken only if it is the only candidate; our own system id may always be taken.
        systems = {other.system_id for other in self._others} - self._neighbours
        is_only_choice = speaker.system_id == kept.system_id or systems == {speaker.system_id}
        return now_s - self._spoke_s >= RETAKEN_AFTER_S and steady_s >= STEADY_S and is_only_choice

    def _steady_s(self, speaker: Speaker, now_s: float) -> float:
        """Note a heartbeat of `speaker`, and forget the speakers whose heartbeats have stopped. Returns for how many
        seconds those of `speaker` have come without a gap."""
        since_s, last_s = self._others.pop(speaker, (now_s, now_s))
        self._others = {other: row for other, row in self._others.items() if now_s - row[1] <= GAP_S}
        if len(self._others) == _OTHERS_MAX:
            self._others.pop(next(iter(self._others)))
        since_s = since_s if now_s - last_s <= GAP_S else now_s
        self._others[speaker] = since_s, now_s
        return now_s - since_s

    def _take(self, speaker: Speaker, now_s: float) -> None:
        before, self.kept = self.kept, speaker
        if before is None:
            log.info("autopilot heard: %s", speaker)
        else:
            silent_s = now_s - self._spoke_s
            log.warning("the autopilot is %s now: %s has been silent for %.0f s", speaker, before, silent_s)
            is_renamed = speaker.system_id != before.system_id
            self._news = (
                f"autopilot is now system {speaker.system_id}" if is_renamed else f"autopilot now{speaker.where}"
            )
        self._others.clear()
        self._warnings.clear()

    def _warn(self, kind: str, text: str) -> None:
        if kind not in self._warnings:
            self._warnings.add(kind)
            log.warning("%s", text)
