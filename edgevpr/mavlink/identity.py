"""The identity of the one autopilot that a link talks to, and the rule by which another address may take its place."""

import logging
import math
from dataclasses import dataclass

from edgevpr.mavlink.address import Sender

# A flight controller that restarts is back within 20 s; other senders in the meantime are not it.
RETAKEN_AFTER_S = 30.0
STEADY_S = 5.0  # another address takes over after heartbeats for this time (not after one stray packet),
GAP_S = 2.5  # without a longer gap: they come once a second, and one may be lost

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
    id. Another system id never takes its place. The same one at another address does so after 30 s of silence, with
    steady heartbeats.

    `kept` is our autopilot (None: not heard yet). `foreign_messages` counts the messages refused since they came from
    another autopilot or another address.
    """

    def __init__(self, system_id: int | None = None) -> None:
        self.kept: Speaker | None = None
        self.foreign_messages = 0
        self._configured = system_id
        self._spoke_s = -math.inf
        self._other: tuple[Speaker, float, float] | None = None  # times of its first and last unbroken heartbeat
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
        if speaker.system_id != kept.system_id:
            self._warn(
                "system",
                f"a second autopilot, {speaker}, is on this link; fixes go to {kept} only: give each vehicle a link "
                "of its own, or set mavlink.system_id and restart edgevpr",
            )
            return False
        self._warn("address", f"{speaker} is a second autopilot of that number; fixes go to {kept} only")
        other, first_s, last_s = self._other or (speaker, now_s, now_s)
        if other != speaker or now_s - last_s > GAP_S:
            first_s = now_s
        self._other = speaker, first_s, now_s
        return now_s - self._spoke_s >= RETAKEN_AFTER_S and now_s - first_s >= STEADY_S

    def _take(self, speaker: Speaker, now_s: float) -> None:
        before, self.kept, self._other = self.kept, speaker, None
        self._warnings.clear()
        if before is None:
            log.info("autopilot heard: %s", speaker)
            return
        log.warning("the autopilot is %s now: %s has been silent for %.0f s", speaker, before, now_s - self._spoke_s)
        self._news = f"autopilot now{speaker.where}"

    def _warn(self, kind: str, text: str) -> None:
        if kind not in self._warnings:
            self._warnings.add(kind)
            log.warning("%s", text)
