"""Observers of the events of a flight (each the `Recognition` of a frame): they count them, and report when something
goes wrong and when it is right again. The loop of `flight` calls `tell` of each class with every event; an exception in
it ends no flight."""

import logging

from edgevpr.mavlink.messages import Severity
from edgevpr.runtime.flight.autopilot import ToAutopilot
from edgevpr.runtime.flight.herald import Herald, Trouble
from edgevpr.runtime.flight.integrity import Integrity
from edgevpr.runtime.recognise.recognition import Recognition

FAILURES_IN_A_ROW = 10  # one may be a bad frame; so many mean a fault of camera, map or technique
NOTHING_IN_A_ROW = 10  # the like for pictures that hold too little to be recognised

_KNOWN_WITH = 3  # accepted matches before the map can be left: with fewer, the aircraft may never have been over it
_LEFT_AFTER = 30  # queries in a row that are not accepted; over poor ground ten are nothing unusual
_LOST, _LOST_AFTER = 0.9, 10  # probability of being lost, in so many queries in a row that are not accepted
_FOUND_WITH, _FORGOTTEN_AFTER = 2, 10  # accepted matches that find the map again, with fewer misses between two of them
_TILT_LASTS_S = 5.0  # longer than a gust, and than the change from one turn to the next

_log = logging.getLogger(__name__)


class Tally:
    """Counts the events of a flight: `queries`; `accepted` queries; `unusable` frames, which could not become a query;
    `failed` queries; `failed_in_a_row`, the failed events since the last good one; and `nothing_in_a_row`, the last
    pictures in a row that hold too little to be recognised."""

    def __init__(self) -> None:
        self._trouble: str | None = None
        self.queries = self.accepted = self.unusable = self.failed = 0
        self.failed_in_a_row = self.nothing_in_a_row = 0

    def tell(self, event: Recognition) -> None:
        """Count an event. A failure is logged, but only once for failures in a row with the same reason."""
        trouble = event.reason if event.failed else None
        if trouble and trouble != self._trouble:
            _log.warning("%s", trouble)
        self._trouble = trouble
        self.queries += event.is_query
        self.accepted += event.accepted
        self.unusable += not event.is_query
        self.failed += event.is_query and event.failed
        self.failed_in_a_row = self.failed_in_a_row + 1 if event.failed else 0
        self.nothing_in_a_row = self.nothing_in_a_row + 1 if event.says_nothing else 0


class MapWatch:
    """Watches the map for damage. Each place that is left out because it cannot be read gets a log line of kind "left
    out"; only the first is reported to the ground station. When the whole file cannot be read, and when it can be read
    again, that is reported with the kind "map". `left_out` is the number of places left out.
    """

    def __init__(self, herald: Herald) -> None:
        self.left_out = 0
        self._herald, self._is_lost = herald, False

    @property
    def summary(self) -> str | None:
        """Number of places left out, in a few words; None if there are none."""
        return f"{self.left_out} places of the map left out" if self.left_out else None

    def tell(self, event: Recognition) -> None:
        """Check an event for places left out and for a map that cannot be read."""
        for place_id, problem in event.left_out:
            self._herald.note("left out", place=place_id, problem=problem)
        if event.left_out and not self.left_out:
            count = len(event.left_out)
            ground = f"map damaged, {count} place{'' if count == 1 else 's'} left out"
            text = f"the map is damaged, place {event.left_out[0][0]} is the first to be left out"
            self._herald.say(Severity.WARNING, text, ground=ground, topic="left out")
        self.left_out += len(event.left_out)
        if event.is_query and event.map_lost != self._is_lost:
            self._is_lost = event.map_lost
            if self._is_lost:
                text, severity, state = "its map cannot be read, see its log", Severity.WARNING, "cannot be read"
            else:
                text, severity, state = "its map is read again", Severity.INFO, "read again"
            self._herald.tell("map", severity, text, state=state, why=event.reason)


class Sight:
    """Reports once when the aircraft leaves the map, once when the map is found again, once when the camera is tilted
    too far, and once when it no longer is.

    The map counts as left after many queries in a row that are not accepted. A picture that shows nothing, is not worth
    a search, could not be used or is tilted too far is not counted among them.
    """

    def __init__(self, herald: Herald) -> None:
        self._map = Trouble(herald, "sight", "map left", "map found again")
        self._tilt = Trouble(herald, "tilt", "tilt too large", "tilt is fine again")
        self._accepted = self._misses = self._misses_lost = 0
        self._is_tilted, self._tilt_since_s = False, 0.0

    def tell(self, event: Recognition) -> None:
        """Check the tilt of a query, and whether it was found in the map."""
        if event.is_query and event.frame:
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


class GpsWatch:
    """Compares GPS with the matches, and reports once when they contradict each other and when they agree again. Every
    comparison is sent to the autopilot, and the navigation does not use a GPS that is wrong."""

    def __init__(self, map_sd_m: float, herald: Herald, autopilot: ToAutopilot | None) -> None:
        self._integrity, self._herald, self._autopilot = Integrity(map_sd_m), herald, autopilot

    def tell(self, event: Recognition) -> None:
        """Compare GPS with the match of an event, if that has a position."""
        if event.position is None or event.view.reason:
            return
        news = self._integrity.look(event)
        off_m, is_wrong = self._integrity.off_m, self._integrity.is_wrong
        if off_m is None:
            return
        if self._autopilot:
            self._autopilot.compare_gps(off_m, is_wrong)
        if news:
            severity = Severity.WARNING if is_wrong else Severity.INFO
            self._herald.tell("gps", severity, news, said=news, off_m=round(off_m, 1), is_wrong=is_wrong)
