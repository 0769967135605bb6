"""The herald of a flight: what happens is told to the journal, to the flight log and to the people on the ground."""

import logging
from typing import Any

from edgevpr.mavlink.link import Link
from edgevpr.mavlink.messages import Severity
from edgevpr.runtime.flight.flightlog import FlightLog

_log = logging.getLogger(__name__)


class Herald:
    """Tells what happens in a flight. Without a `link` nobody on the ground is told."""

    def __init__(self, flight_log: FlightLog, link: Link | None) -> None:
        self._flight_log, self._link = flight_log, link

    def note(self, kind: str, **fields: Any) -> None:
        """Write a line of a kind to the flight log, and tell nobody."""
        self._flight_log.write(kind, **fields)

    def say(self, severity: Severity, text: str, *, ground: str | None = None, topic: str | None = None) -> None:
        """Tell the journal, and the ground when its turn comes (with the shorter text `ground`, where there is one).
        The newest text of a `topic` takes the place of one that still waits."""
        _log.log(logging.WARNING if severity is Severity.WARNING else logging.INFO, "%s", text)
        self.announce(severity, ground or text, topic)

    def announce(self, severity: Severity, text: str, topic: str | None = None) -> None:
        """Tell the ground alone."""
        if self._link:
            self._link.announce(severity, text, topic)

    def tell(
        self,
        kind: str,
        severity: Severity,
        text: str,
        *,
        ground: str | None = None,
        topic: str | None = None,
        **fields: Any,
    ) -> None:
        """Tell everybody at once: write a line of a kind, with its fields, to the flight log, and say the text. Its
        topic is the kind, unless given."""
        self.note(kind, **fields)
        self.say(severity, text, ground=ground, topic=topic or kind)


class Trouble:
    """A trouble that comes and goes: everybody is told once that it has `begun`, and once that it is `over`."""

    def __init__(self, herald: Herald, kind: str, begun: str, over: str) -> None:
        self.is_so = False
        self._herald, self._kind, self._begun, self._over = herald, kind, begun, over

    def note(self, is_so: bool) -> None:
        """Note whether it is so."""
        if is_so == self.is_so:
            return
        self.is_so = is_so
        text = self._begun if is_so else self._over
        self._herald.tell(self._kind, Severity.WARNING if is_so else Severity.INFO, text, said=text)
