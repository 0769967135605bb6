"""The state of the map in a flight: places that were left out, and the loss of the whole file."""

import logging

from edgevpr.runtime.flight.autopilot import Autopilot, Mood
from edgevpr.runtime.flight.flightlog import FlightLog
from edgevpr.runtime.recognise.recognition import Recognition

_log = logging.getLogger(__name__)


class MapState:
    """Tells the log of every place that is left out, in a line of kind "left out", and the ground station once that the
    map is damaged. Tells both when the file cannot be read, in a line of kind "map", and when it can be read again.

    `left_out` counts the places.
    """

    def __init__(self, flight_log: FlightLog, autopilot: Autopilot) -> None:
        self.left_out = 0
        self._flight_log, self._autopilot = flight_log, autopilot
        self._is_lost = False

    @property
    def summary(self) -> str | None:
        """Number of places left out, in a few words; None where there are none."""
        return f"{self.left_out} places of the map left out" if self.left_out else None

    def tell(self, event: Recognition) -> None:
        """Take note of an event."""
        for place_id, problem in event.left_out:
            self._flight_log.write("left out", place=place_id, problem=problem)
        if event.left_out:
            if not self.left_out:
                _log.warning("the map is damaged, place %d is the first to be left out", event.left_out[0][0])
                count = len(event.left_out)
                text = f"map damaged, {count} place{'' if count == 1 else 's'} left out"
                self._autopilot.announce(Mood.WARNING, text, "left out")
            self.left_out += len(event.left_out)
        if event.is_query and event.map_lost != self._is_lost:
            self._is_lost = event.map_lost
            self._flight_log.write("map", state="cannot be read" if self._is_lost else "read again", why=event.reason)
            text = "its map cannot be read, see its log" if self._is_lost else "its map is read again"
            self._autopilot.announce(Mood.WARNING if self._is_lost else Mood.NOTE, text, "map")
