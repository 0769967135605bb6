"""The herald of a flight reports what happens to the journal (the log of the process), to the flight log and to the
ground station. `autopilot`, `commands`, `governor`, `vitals` and `watching` report through it."""

import logging
from typing import Any

from edgevpr.mavlink.link import Link
from edgevpr.mavlink.messages import Severity
from edgevpr.runtime.flight.flightlog import FlightLog

_log = logging.getLogger(__name__)


class Herald:
    """Reports what happens in a flight. Without a `link` nothing is sent to the ground station."""

    def __init__(self, flight_log: FlightLog, link: Link | None) -> None:
        self._flight_log, self._link = flight_log, link

    def note(self, kind: str, **fields: Any) -> None:
        """Write a line to the flight log only."""
        self._flight_log.write(kind, **fields)

    def say(self, severity: Severity, text: str, *, ground: str | None = None, topic: str | None = None) -> None:
        """Write a text to the journal, and queue it for the ground station (the shorter text `ground` instead, if
        given). A text that still waits is replaced by a newer one of the same `topic`."""
        _log.log(logging.WARNING if severity is Severity.WARNING else logging.INFO, "%s", text)
        if self._link:
            self._link.announce(severity, ground or text, topic)

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
        """Report to flight log, journal and ground station: write a line of `kind` with `fields` to the flight log, and
        `say` the text to the other two. Without a `topic`, the kind is the topic of the text."""
        self.note(kind, **fields)
        self.say(severity, text, ground=ground, topic=topic or kind)


class Trouble:
    """Reports a bad condition once when it begins, with the text `begun`, and once when it ends, with the text `over`.
    `kind` is that of its lines in the flight log. `is_so`: the condition holds."""

    def __init__(self, herald: Herald, kind: str, begun: str, over: str) -> None:
        self.is_so = False
        self._herald, self._kind, self._begun, self._over = herald, kind, begun, over

    def note(self, is_so: bool) -> None:
        """Set whether the condition holds now, and report if that has changed."""
        if is_so == self.is_so:
            return
        self.is_so = is_so
        text = self._begun if is_so else self._over
        self._herald.tell(self._kind, Severity.WARNING if is_so else Severity.INFO, text, said=text)
