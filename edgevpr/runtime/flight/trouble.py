"""A trouble that comes and goes, and of which everybody is told."""

import logging

from edgevpr.runtime.flight.autopilot import Autopilot, Mood
from edgevpr.runtime.flight.flightlog import FlightLog

_log = logging.getLogger(__name__)


class Trouble:
    """Tells everybody, once, that a trouble has `begun`, and once that it is `over`: with a line of its `kind` in the
    flight log, and a text to the ground."""

    def __init__(self, kind: str, begun: str, over: str, *, flight_log: FlightLog, autopilot: Autopilot) -> None:
        self.is_so = False
        self._kind, self._begun, self._over = kind, begun, over
        self._flight_log, self._autopilot = flight_log, autopilot

    def note(self, is_so: bool) -> None:
        """Note whether it is so."""
        if is_so == self.is_so:
            return
        self.is_so = is_so
        said = self._begun if is_so else self._over
        _log.warning("%s", said)
        self._flight_log.write(self._kind, said=said)
        self._autopilot.announce(Mood.WARNING if is_so else Mood.NOTE, said, self._kind)
