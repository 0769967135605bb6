"""The channel to the autopilot: what is told to it of every event, and what it tells us."""

import logging
from dataclasses import replace
from enum import Enum, auto

from edgevpr.mavlink import messages
from edgevpr.mavlink.link import Link
from edgevpr.mavlink.outbox import Sending
from edgevpr.power.load import MachineLoad
from edgevpr.runtime.flight.clock import Clock
from edgevpr.runtime.recognise.recognition import Recognition
from edgevpr.types import FixReport, Vehicle

# A fix has left a fraction of a millisecond after it was handed over, if anybody is there to take it: so long the loop
# waits for it, so that what the log says of the fix is so.
_SETTLED_WITHIN_S = 0.02

_log = logging.getLogger(__name__)


class Mood(Enum):
    """How much an announcement matters to people on the ground."""

    NOTE = auto()
    WARNING = auto()


_SEVERITY = {Mood.NOTE: messages.Severity.INFO, Mood.WARNING: messages.Severity.WARNING}


class NoAutopilot:
    """Nobody to tell: what a `ToAutopilot` is where there is no link."""

    summary = None

    def vehicle(self) -> Vehicle | None:
        """Know nothing."""

    def told(self, event: Recognition, used_mah: float) -> Recognition:
        """Say of an accepted match that its fix has nowhere to go."""
        return replace(event, fix=FixReport(_name(event), False, "there is no link")) if event.accepted else event

    def announce(self, mood: Mood, text: str) -> None:
        """Say nothing."""

    def report(self, healthy: bool, load: MachineLoad, temperature_c: float | None) -> None:
        """Report nothing."""


class ToAutopilot:
    """Tells an autopilot over an open link. With `send_fixes` an accepted match with a position is a fix; `cores` are
    those of the board."""

    def __init__(self, link: Link, *, send_fixes: bool, cores: int, clock: Clock) -> None:
        self._link, self._send_fixes, self._cores, self._clock = link, send_fixes, cores, clock
        self._last: tuple[str, Sending] | None = None

    @property
    def summary(self) -> str:
        """Say what became of the fixes so far, in a few words."""
        stats = self._link.stats()
        sent = f"{stats.fixes_sent} fixes sent"
        taken = f"{stats.acks.get('ACCEPTED', 0)} taken"
        late = f"{stats.dropped_stale_fixes} too late to be sent" if stats.dropped_stale_fixes else ""
        return ", ".join(filter(None, (sent, taken, late)))

    def vehicle(self) -> Vehicle | None:
        """Give what the autopilot last said of its vehicle."""
        return self._link.vehicle()

    def told(self, event: Recognition, used_mah: float) -> Recognition:
        """Tell the autopilot of an event; gives the event with what became of its fix, and of the one before it.
        `used_mah` is what the board has drawn so far."""
        last = _reported(*self._last) if self._last else None
        fix = self._fixed(event) if event.accepted else None
        now_s = self._clock.mono_s()
        if event.accepted:
            best = event.best
            self._link.send(*messages.place_match(now_s, best.place.place_id, best.match.score))
        if event.is_query:
            cpu_share = event.cost.whole.utilisation(self._cores)
            self._link.send(*messages.query_figures(now_s, cpu_share, used_mah))
        return replace(event, fix=fix, last_fix=last)

    def announce(self, mood: Mood, text: str) -> None:
        """Say something to people on the ground."""
        self._link.send(messages.status_text(_SEVERITY[mood], f"edgevpr: {text}"))

    def report(self, healthy: bool, load: MachineLoad, temperature_c: float | None) -> None:
        """Report how this companion is, once a second."""
        self._link.set_health(messages.Health.ACTIVE if healthy else messages.Health.CRITICAL)
        self._link.send(
            messages.computer_status(
                self._clock.mono_s(), load.core_shares, load.ram_used_bytes, load.ram_total_bytes, temperature_c
            )
        )

    def _fixed(self, event: Recognition) -> FixReport:
        """Send the fix of an accepted match, where there is one."""
        if event.position is None:
            return FixReport(_name(event), False, "the place has no position")
        if not self._send_fixes:
            return FixReport(_name(event), False, "send_fixes is off")
        here = event.position
        try:
            fix = messages.Fix(here.lat_deg, here.lon_deg, event.accuracy_m, event.frame.t_mono_s)
        except ValueError as error:  # another program wrote nonsense into the map
            _log.warning("place %d: %s; no fix is sent", event.best.place.place_id, error)
            return FixReport(_name(event), False, str(error))
        sending = self._link.send_fix(fix)
        if self._link.listens():
            sending.wait(_SETTLED_WITHIN_S)
        self._last = _name(event), sending
        return _reported(*self._last)


Autopilot = NoAutopilot | ToAutopilot


def _reported(query: str, sending: Sending) -> FixReport:
    return FixReport(query, sending.sent, sending.why, sending.answer)


def _name(event: Recognition) -> str:
    return event.frame.name
