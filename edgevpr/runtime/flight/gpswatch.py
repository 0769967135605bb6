"""The watch over GPS: tells everybody when the map contradicts it."""

import logging

from edgevpr.runtime.flight.autopilot import Autopilot, Mood
from edgevpr.runtime.flight.flightlog import FlightLog
from edgevpr.runtime.flight.integrity import Integrity
from edgevpr.runtime.recognise.recognition import Recognition

_log = logging.getLogger(__name__)


class GpsWatch:
    """Listens to the matches, and tells everybody, once, when GPS is contradicted and when it agrees again. The
    autopilot is told of every comparison, and navigates no longer by a receiver that is wrong."""

    def __init__(self, map_sd_m: float, flight_log: FlightLog, autopilot: Autopilot) -> None:
        self._integrity = Integrity(map_sd_m)
        self._flight_log, self._autopilot = flight_log, autopilot

    def tell(self, event: Recognition) -> None:
        """Take note of an event."""
        if event.position is None or event.view.reason:
            return
        integrity = self._integrity
        news = integrity.look(event)
        if integrity.off_m is not None:
            self._autopilot.compare_gps(integrity.off_m, integrity.is_wrong)
        if news:
            _log.warning("%s", news)
            self._flight_log.write("gps", said=news, off_m=round(integrity.off_m, 1), is_wrong=integrity.is_wrong)
            self._autopilot.announce(Mood.WARNING if integrity.is_wrong else Mood.NOTE, news, "gps")
