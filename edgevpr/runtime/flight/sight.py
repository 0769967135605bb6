"""The state of what is seen: whether the aircraft is still over ground of the map, and not tilted too far for it."""

from edgevpr.runtime.flight.autopilot import Autopilot
from edgevpr.runtime.flight.flightlog import FlightLog
from edgevpr.runtime.flight.trouble import Trouble
from edgevpr.runtime.recognise.recognition import Recognition

_KNOWN_WITH = 3  # accepted matches: with fewer it is not known that the map was ever there to be left
_LEFT_AFTER = 30  # queries in a row that are not accepted; over poor ground ten are nothing unusual
_LOST, _LOST_AFTER = 0.9, 10  # queries in a row that are not accepted, and the flight so far says that it is lost
_FOUND_WITH, _FORGOTTEN_AFTER = 2, 10  # accepted matches, without so many others between two of them
_TILT_LASTS_S = 5.0  # longer than a gust, and than the way from one turn into the next


class Sight:
    """Tells everybody, once, when the map is left and found again, and when pictures are tilted too far and no more.

    A picture that shows nothing, is not worth a search, could not be used or is tilted too far says nothing of the map.
    """

    def __init__(self, flight_log: FlightLog, autopilot: Autopilot) -> None:
        told = {"flight_log": flight_log, "autopilot": autopilot}
        self._map = Trouble("sight", "map left", "map found again", **told)
        self._tilt = Trouble("tilt", "tilt too large", "tilt is fine again", **told)
        self._accepted = self._misses = self._misses_lost = 0
        self._is_tilted, self._tilt_since_s = False, 0.0

    def tell(self, event: Recognition) -> None:
        """Take note of an event."""
        if event.is_query:
            self._look_at_tilt(event.view.reason is not None, event.frame.t_mono_s)
            self._look_for_map(event)

    def _look_at_tilt(self, is_tilted: bool, now_s: float) -> None:
        if is_tilted != self._is_tilted:
            self._is_tilted, self._tilt_since_s = is_tilted, now_s
        if now_s - self._tilt_since_s >= _TILT_LASTS_S:
            self._tilt.note(is_tilted)

    def _look_for_map(self, event: Recognition) -> None:
        if event.accepted:
            self._accepted += 1
            self._misses = self._misses_lost = 0
            if self._accepted >= _FOUND_WITH:
                self._map.note(False)
            return
        if event.failed or event.says_nothing or event.view.reason or (event.worth and event.worth.reason):
            return
        self._misses += 1
        is_lost = event.followed is not None and event.followed.lost >= _LOST
        self._misses_lost = self._misses_lost + 1 if is_lost else 0
        if self._map.is_so:
            if self._misses >= _FORGOTTEN_AFTER:
                self._accepted = 0
        elif self._accepted >= _KNOWN_WITH and (self._misses >= _LEFT_AFTER or self._misses_lost >= _LOST_AFTER):
            self._accepted = 0
            self._map.note(True)
