"""Observers of the events of a flight (each the `Recognition` of a frame): they count them, and report when something
goes wrong and when it is right again. The loop of `flight` calls `update` of each class with every event; an exception
in it ends no flight."""

import logging
from collections.abc import Callable

from edgevpr.core.config import SourceConfig
from edgevpr.core.reasons import Reason, ReasonCode
from edgevpr.core.text import format_offset
from edgevpr.frames.level import Mount
from edgevpr.mavlink.messages import Severity
from edgevpr.runtime.flight.gpswatch import GpsWatch
from edgevpr.runtime.flight.notifier import Notifier, Trouble
from edgevpr.runtime.flight.survey import Measure, Sightings, Surveyed
from edgevpr.runtime.recognise.levelling import read_mount
from edgevpr.runtime.recognise.recognition import Recognition

FAILURES_IN_A_ROW = 10  # one may be a bad frame; so many mean a fault of camera, map or technique
NOTHING_IN_A_ROW = 10  # the like for pictures that hold too little to be recognised

_KNOWN_WITH = 3  # accepted matches before the map can be left: with fewer, the aircraft may never have been over it
_LEFT_AFTER = 30  # queries in a row that are not accepted; over poor ground ten are nothing unusual
_LOST, _LOST_AFTER = 0.9, 10  # probability of being lost, in so many queries in a row that are not accepted
_FOUND_WITH, _FORGOTTEN_AFTER = 2, 10  # accepted matches that find the map again, with fewer misses between two of them
_TILT_LASTS_S = 5.0  # longer than a gust, and than the change from one turn to the next
_SURVEYED_EVERY = 6  # sightings from one look at the survey to the next
_MOUNT = "ahead_deg", "right_deg"
_ANEW = 3.0  # times the least that counts: a result is reported anew when it has changed by more

_log = logging.getLogger(__name__)


class Tally:
    """Counts `queries`, of them `accepted` and `failed` ones; `unusable` frames, which failed before they became
    queries; events that failed in a row; and pictures in a row that hold too little."""

    def __init__(self) -> None:
        self._trouble: Reason | None = None
        self.queries = self.accepted = self.unusable = self.failed = 0
        self.failed_in_a_row = self.nothing_in_a_row = 0

    def update(self, event: Recognition) -> None:
        """Count an event. A failure is logged, but only once for failures in a row with the same reason."""
        trouble = event.reason if event.failed else None
        if trouble and trouble != self._trouble:
            _log.warning("%s", trouble)
        self._trouble = trouble
        self.queries += event.is_query
        self.accepted += event.accepted
        self.unusable += event.failed and not event.is_query
        self.failed += event.is_query and event.failed
        self.failed_in_a_row = self.failed_in_a_row + 1 if event.failed else 0
        self.nothing_in_a_row = self.nothing_in_a_row + 1 if event.says_nothing else 0


class MapWatch:
    """Reports damage of the map: each place that cannot be read in the log, only the first in words; and when the whole
    file cannot be read, or can again. `left_out` is the number of places left out."""

    def __init__(self, notifier: Notifier) -> None:
        self.left_out = 0
        self._notifier, self._is_lost = notifier, False

    @property
    def summary(self) -> str | None:
        """Number of places left out, in a few words; None if there are none."""
        return f"{self.left_out} places of the map left out" if self.left_out else None

    def update(self, event: Recognition) -> None:
        """Check an event for unreadable places."""
        for place_id, problem in event.left_out:
            self._notifier.log("left out", place=place_id, problem=problem)
        if event.left_out and not self.left_out:
            count = len(event.left_out)
            ground = f"map damaged, {count} place{'' if count == 1 else 's'} left out"
            text = f"the map is damaged, place {event.left_out[0][0]} is the first to be left out"
            self._notifier.announce(Severity.WARNING, text, ground=ground, topic="left out")
        self.left_out += len(event.left_out)
        if event.is_query and event.map_lost != self._is_lost:
            self._is_lost = event.map_lost
            severity = Severity.WARNING if self._is_lost else Severity.INFO
            note = Reason(ReasonCode.MAP_LOST if self._is_lost else ReasonCode.MAP_BACK)
            self._notifier.report("map", severity, note, reason=event.reason)


class Sight:
    """Reports once when the aircraft leaves the map or the camera is tilted too far, and once when that is over. The
    map counts as left after many queries in a row that are not accepted; pictures that cannot be recognised do not
    count."""

    def __init__(self, notifier: Notifier) -> None:
        self._map = Trouble(notifier, "sight", Reason(ReasonCode.MAP_LEFT), ReasonCode.MAP_FOUND)
        self._tilt = Trouble(notifier, "tilt", Reason(ReasonCode.TILT_TOO_LARGE), ReasonCode.TILT_FINE)
        self._accepted = self._misses = self._misses_lost = 0
        self._is_tilted, self._tilt_since_s = False, 0.0

    def update(self, event: Recognition) -> None:
        """Check the tilt of a query, and whether it was found in the map."""
        if event.is_query and event.frame:
            self._check_tilt(event.view.reason is not None, event.frame.t_mono_s)
            self._check_map(event)

    def _check_tilt(self, is_tilted: bool, now_s: float) -> None:
        if is_tilted != self._is_tilted:
            self._is_tilted, self._tilt_since_s = is_tilted, now_s
        if now_s - self._tilt_since_s >= _TILT_LASTS_S:
            self._tilt.update(is_tilted)

    def _check_map(self, event: Recognition) -> None:
        if event.accepted:
            self._accepted += 1
            self._misses = self._misses_lost = 0
            if self._accepted >= _FOUND_WITH:
                self._map.update(False)
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
            self._map.update(True)


class Surveyor:
    """Reports what `survey` finds of map and camera: each once it is known and not as it should be, again when it has
    clearly changed, and all of it at the end. What was reported of the map is taken back where `gps` contradicts it.
    `set_mount` is called with a mount of the camera by which the pictures to come are to be levelled."""

    def __init__(
        self, notifier: Notifier, gps: GpsWatch, source: SourceConfig, set_mount: Callable[[Mount], None]
    ) -> None:
        mount = read_mount(source)
        self._notifier, self._gps, self._taken, self._set_mount = notifier, gps, 0, set_mount
        self._sightings = Sightings(mount, source.gimbal)
        self._expected = {"off_m": (0.0, 0.0), "scale": (0.0,)}
        self._expected |= {"ahead_deg": (mount.ahead_deg,), "right_deg": (mount.right_deg,)}
        self._reported: dict[str, tuple[float, ...]] = {}

    def update(self, event: Recognition) -> None:
        """Take the match of an event, and report what has become known by it."""
        if self._sightings.take(event, self._gps.is_wrong):
            self._taken += 1
            if self._taken % _SURVEYED_EVERY == 0:
                self._check(is_end=False)

    def end(self) -> None:
        """Report everything that is known now."""
        self._check(is_end=True)

    def _check(self, is_end: bool) -> None:
        found, names = self._sightings.result(), set[str]()
        if found is None:
            if of_map := self._reported.keys() - set(_MOUNT):
                self._reported = {name: value for name, value in self._reported.items() if name not in of_map}
                self._notifier.report("survey", Severity.WARNING, Reason(ReasonCode.SURVEY_WITHDRAWN))
            return
        for name, each in found.measures.items():
            before = self._reported.get(name)
            is_news = each.differs_from(self._expected[name]) if before is None else each.differs_from(before, _ANEW)
            if is_news or (is_end and each.is_known):
                names.add(name)
        if names or (is_end and self._reported):
            self._report(found, names)
        if names.intersection(_MOUNT) and not is_end:
            self._apply_mount()

    def _report(self, found: Surveyed, names: set[str]) -> None:
        """Write a line of all that is known, and say what of `names` is not as it should be."""
        clear = {name: each for name, each in found.measures.items() if each.differs_from(self._expected[name])}
        sentences = {name: _format_result(name, each) for name, each in clear.items()}
        said = "; ".join(sentence for sentence, _ in sentences.values()) or "map and camera are as GPS says"
        self._notifier.log("survey", said=said, **found.fields())
        self._reported |= {name: found.measures[name].value for name in names}
        for name, (sentence, ground) in sentences.items():
            if name in names:
                self._notifier.announce(Severity.INFO, sentence, ground=ground, topic=f"survey {name}")

    def _apply_mount(self) -> None:
        """Level the pictures to come by what was found of the camera; what has been compared with GPS is void."""
        mount = Mount(*(self._reported.get(name, self._expected[name])[0] for name in _MOUNT))
        self._sightings.set_mount(mount)
        self._gps.begin_anew()
        self._set_mount(mount)


def _format_result(name: str, found: Measure) -> tuple[str, str]:
    """Return a result of the survey as a sentence, and in a few words."""
    first = found.value[0]
    if name == "off_m":
        there = f"{format_offset(*found.value)} of GPS"
        return f"the map lies {there}, +-{found.sd:.1f} m", f"map {there}"
    if name == "scale":
        size = f"{abs(first):.1%} too {'large' if first > 0 else 'small'}"
        return f"the map is {size}, +-{found.sd:.1%}", f"map is {size}"
    sides = ("behind", "ahead") if name == "ahead_deg" else ("left", "right")
    side, key = sides[first > 0], f"source.mount_{name}"
    looks = f"looks {abs(first):.1f} degrees {side}"
    return f"the camera {looks} of straight down, +-{found.sd:.1f}: set {key}: {first:.1f}", f"camera {looks}"
