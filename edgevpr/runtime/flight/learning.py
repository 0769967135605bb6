"""The learner as a listener of the flight: it gets every event, and what it has learnt is logged."""

import logging
from dataclasses import asdict

from edgevpr.runtime.flight.autopilot import Autopilot, Mood
from edgevpr.runtime.flight.flightlog import FlightLog
from edgevpr.runtime.recognise.learn import Learner
from edgevpr.runtime.recognise.recognition import Recognition

_log = logging.getLogger(__name__)


class Learning:
    """Lets a learner make places of the frames of a flight; the log has a line for each, of kind "learnt"."""

    def __init__(self, learner: Learner, flight_log: FlightLog, autopilot: Autopilot) -> None:
        self._learner, self._flight_log, self._autopilot = learner, flight_log, autopilot

    def tell(self, event: Recognition) -> None:
        """Make a place of the frame, where it is worth one; later frames may be recognised as that place."""
        well = self._learner.trouble is None
        place = self._learner.learn(event)
        if place:
            self._flight_log.write(
                "learnt",
                place=place.place_id,
                query=event.frame.name,
                position=asdict(place.position),
                quality=place.quality,
            )
        if well and self._learner.trouble:
            say_learning_stopped(self._learner.trouble, self._flight_log, self._autopilot)


def say_learning_stopped(problem: str, flight_log: FlightLog, autopilot: Autopilot) -> None:
    """Announce that nothing more is learnt, and write the reason to the log."""
    _log.warning("nothing more is learnt: %s", problem)
    flight_log.write("learning stopped", problem=problem)
    autopilot.announce(Mood.WARNING, "nothing more is learnt, see its log", "learning")
