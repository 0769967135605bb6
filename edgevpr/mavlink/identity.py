"""The one autopilot that a link talks to, and the rule by which another speaker becomes it."""

import logging
import math
from dataclasses import dataclass

from edgevpr.mavlink.address import Sender

# A flight controller that restarts is back within 20 s; what speaks meanwhile is not it.
RETAKEN_AFTER_S = 30.0
STEADY_S = 5.0  # one stray packet takes nothing over: another speaker must have beaten for so long,
GAP_S = 2.5  # and without a longer gap: heartbeats come once a second, and one may be lost
_OTHERS_MAX = 32  # speakers remembered; a flood of invented ones must not fill the memory

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Speaker:
    """An autopilot as it is heard: its system id, and its address where there can be several (else None)."""

    system_id: int
    address: Sender | None

    def __str__(self) -> str:
        return f"system {self.system_id}{self.where}"

    @property
    def where(self) -> str:
        """The address in words, where there is one."""
        return f" at {self.address[0]}:{self.address[1]}" if self.address else ""


class Identity:
    """The speaker that is our autopilot: the first heard, or the first heard with the configured `system_id`.

    It is kept for as long as it speaks. When it has been silent for 30 s, another that beats steadily takes its place:
    the same system at another address, or else another system if it is the only one. A system that was heard between
    two heartbeats of ours is another vehicle, and is never taken; nor is any other than a configured one.
    `foreign_messages` counts what was refused, since it came from another autopilot or another address.
    """

    def __init__(self, system_id: int | None = None) -> None:
        self.kept: Speaker | None = None
        self.foreign_messages = 0
        self._configured = system_id
        self._spoke_s = -math.inf
        self._others: dict[Speaker, tuple[float, float]] = {}  # unbroken heartbeats: times of the first and of the last
        self._neighbours: set[int] = set()  # system ids of other vehicles
        self._warnings: set[str] = set()
        self._news: str | None = None

    def take_news(self) -> str | None:
        """Return once, in a few words, that another speaker has become our autopilot; None: there is no news."""
        news, self._news = self._news, None
        return news

    def admits(self, speaker: Speaker, beats: bool, now_s: float) -> bool:
        """Tell whether a message comes from our autopilot. `beats`: the message is an autopilot's heartbeat."""
        if beats and speaker != self.kept and self._is_next(speaker, now_s):
            self._take(speaker, now_s)
        if speaker != self.kept:
            self.refuse()
            return False
        self._spoke_s = now_s
        if beats:  # whoever has beaten since the last beat of ours cannot be ours under another number
            self._neighbours |= {other.system_id for other in self._others} - {speaker.system_id}
        return True

    def is_elsewhere(self, address: Sender | None) -> bool:
        """Tell whether bytes from this address cannot be from our autopilot."""
        return self.kept is not None and address != self.kept.address

    def refuse(self) -> None:
        """Count a message of somebody else, where it is known who our autopilot is."""
        self.foreign_messages += self.kept is not None or self._configured is not None

    def _is_next(self, speaker: Speaker, now_s: float) -> bool:
        """Take note of the heartbeat of another speaker; tell whether it is our autopilot from now on. Two vehicles on
        one link are dangerous, and warned of."""
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
        # No other who speaks now may be ours as well: the same system comes before any other.
        systems = {other.system_id for other in self._others} - self._neighbours
        is_only_choice = speaker.system_id == kept.system_id or systems == {speaker.system_id}
        return now_s - self._spoke_s >= RETAKEN_AFTER_S and steady_s >= STEADY_S and is_only_choice

    def _steady_s(self, speaker: Speaker, now_s: float) -> float:
        """Note a heartbeat, and forget the rows of heartbeats that have ended; return how long that of the speaker has
        gone on."""
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
