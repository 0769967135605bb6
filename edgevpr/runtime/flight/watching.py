"""Observers of a flight's events (each the `Recognition` of a frame): they count events, and report when problems begin
and end. The loop of `flight` calls `update` of each class with every event; an exception in it does not end the
flight."""

import logging
from collections.abc import Callable

from edgevpr.core.config import SourceConfig
from edgevpr.core.reasons import Reason, ReasonCode
from edgevpr.core.text import format_offset
from edgevpr.frames.level import Mount
from edgevpr.mavlink.messages import Severity
from edgevpr.runtime.flight.gpswatch import GpsWatch
from edgevpr.runtime.flight.notifier import Alert, Notifier
from edgevpr.runtime.flight.survey import MapSurvey, SurveyMeasure, SurveyResult
from edgevpr.runtime.recognise.levelling import read_mount
from edgevpr.runtime.recognise.recognition import Recognition

MAX_FAILURES_IN_A_ROW = 10  # a single failure may be a bad frame
MAX_BLANK_IN_A_ROW = 10  # pictures with too little texture

_MIN_ON_MAP = 3  # accepted matches before the aircraft counts as over the map, and leaving it is reported
_MAX_MISSES = 30  # consecutive queries that are not accepted; ten are common over featureless ground
_LOST_PROBABILITY = 0.9
_MAX_LOST_MISSES = 10  # the same, if the place filter considers the aircraft lost in each of them
_MIN_TO_RETURN = 2  # accepted matches after which the aircraft counts as over the map again
_MAX_MISSES_BETWEEN = 10  # between two such matches
_MIN_TILT_S = 5.0  # longer than a gust or a reversal of the turn
_SURVEY_INTERVAL = 6  # samples between two evaluations of the survey
_MOUNT_NAMES = "ahead_deg", "right_deg"
_REPEAT_FACTOR = 3.0  # a reported result that has changed by this many `min_difference` is reported again

_log = logging.getLogger(__name__)


class Tally:
    """Counts `queries`, including `accepted` and `failed` ones; `unusable` frames, which failed before they became
    queries; consecutive failures; and consecutive pictures with too little texture."""

    def __init__(self) -> None:
        self._last_failure: Reason | None = None
        self.queries = self.accepted = self.unusable = self.failed = 0
        self.failed_in_a_row = self.blank_in_a_row = 0

    def update(self, event: Recognition) -> None:
        """Count an event. A failure is logged, but only once for consecutive failures with the same reason."""
        failure = event.reason if event.failed else None
        if failure and failure != self._last_failure:
            _log.warning("%s", failure)
        self._last_failure = failure
        self.queries += event.is_query
        self.accepted += event.accepted
        self.unusable += event.failed and not event.is_query
        self.failed += event.is_query and event.failed
        self.failed_in_a_row = self.failed_in_a_row + 1 if event.failed else 0
        self.blank_in_a_row = self.blank_in_a_row + 1 if event.lacks_texture else 0


class MapWatch:
    """Reports damage to the map: each unreadable place to the flight log, only the first to operators; and when the
    file becomes unreadable, or readable again. `left_out` is the number of places left out."""

    def __init__(self, notifier: Notifier) -> None:
        self.left_out = 0
        self._notifier, self._lost = notifier, Alert(notifier, "map", Reason(ReasonCode.MAP_LOST), ReasonCode.MAP_BACK)

    @property
    def summary(self) -> str | None:
        """Text with the number of places left out; None if there are none."""
        return f"{self.left_out} places of the map left out" if self.left_out else None

    def update(self, event: Recognition) -> None:
        """Check an event for unreadable places."""
        for place_id, problem in event.left_out:
            self._notifier.log("left out", place=place_id, problem=problem)
        if event.left_out and not self.left_out:
            count = len(event.left_out)
            gcs_text = f"map damaged, {count} place{'' if count == 1 else 's'} left out"
            text = f"map damaged: place {event.left_out[0][0]} cannot be read and is left out"
            self._notifier.announce(Severity.WARNING, text, gcs_text=gcs_text, topic="left out")
        self.left_out += len(event.left_out)
        if event.is_query:
            self._lost.update(event.map_lost, reason=event.reason)


class MapCoverageWatch:
    """Reports once when the aircraft leaves the map or the camera is tilted too far, and once when that ends. The
    map counts as left after many consecutive queries that are not accepted, not counting unusable pictures."""

    def __init__(self, notifier: Notifier) -> None:
        self._map = Alert(notifier, "sight", Reason(ReasonCode.MAP_LEFT), ReasonCode.MAP_FOUND)
        self._tilt = Alert(notifier, "tilt", Reason(ReasonCode.TILT_TOO_LARGE), ReasonCode.TILT_FINE)
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
        if now_s - self._tilt_since_s >= _MIN_TILT_S:
            self._tilt.update(is_tilted)

    def _check_map(self, event: Recognition) -> None:
        if event.accepted:
            self._accepted += 1
            self._misses = self._misses_lost = 0
            if self._accepted >= _MIN_TO_RETURN:
                self._map.update(False)
            return
        if event.failed or event.lacks_texture or event.view.reason or (event.salience and event.salience.reason):
            return
        self._misses += 1
        is_lost = event.track is not None and event.track.lost >= _LOST_PROBABILITY
        self._misses_lost = self._misses_lost + 1 if is_lost else 0
        if self._map.is_active:
            if self._misses >= _MAX_MISSES_BETWEEN:
                self._accepted = 0
        elif self._accepted >= _MIN_ON_MAP and (self._misses >= _MAX_MISSES or self._misses_lost >= _MAX_LOST_MISSES):
            self._accepted = 0
            self._map.update(True)


class SurveyReporter:
    """Reports the results of `survey`: each when it is known and deviates from the expected value, again when it has
    clearly changed, and all at the end. Results for the map are withdrawn if GPS turns out to be wrong. `set_mount` is
    called with the mount to be used to level the next pictures."""

    def __init__(
        self, notifier: Notifier, gps: GpsWatch, source: SourceConfig, set_mount: Callable[[Mount], None]
    ) -> None:
        mount = read_mount(source)
        self._notifier, self._gps, self._samples, self._set_mount = notifier, gps, 0, set_mount
        self._survey = MapSurvey(mount, source.gimbal)
        self._expected = {"off_m": (0.0, 0.0), "scale": (0.0,)}
        self._expected |= {"ahead_deg": (mount.ahead_deg,), "right_deg": (mount.right_deg,)}
        self._reported: dict[str, tuple[float, ...]] = {}

    def update(self, event: Recognition) -> None:
        """Add the match of an event, and report new results."""
        if self._survey.add_match(event, self._gps.is_wrong):
            self._samples += 1
            if self._samples % _SURVEY_INTERVAL == 0:
                self._check(is_end=False)

    def end(self) -> None:
        """Report all results."""
        self._check(is_end=True)

    def _check(self, is_end: bool) -> None:
        survey, names = self._survey.compute_result(), set[str]()
        if survey is None:
            mount = {name: self._reported[name] for name in _MOUNT_NAMES if name in self._reported}
            if len(mount) < len(self._reported):
                self._reported = mount
                self._notifier.report("survey", Severity.WARNING, Reason(ReasonCode.SURVEY_WITHDRAWN))
            return
        for name, measure in survey.measures.items():
            is_new = name not in self._reported
            before, factor = (self._expected[name], 1.0) if is_new else (self._reported[name], _REPEAT_FACTOR)
            if measure.differs_from(before, factor) or (is_end and measure.is_known):
                names.add(name)
        if names or (is_end and self._reported):
            self._report(survey, names)
        if names.intersection(_MOUNT_NAMES) and not is_end:
            self._apply_mount()

    def _report(self, survey: SurveyResult, names: set[str]) -> None:
        """Log all results, and announce those of `names` that deviate from the expected values."""
        sentences = {
            name: _format_result(name, measure)
            for name, measure in survey.measures.items()
            if measure.differs_from(self._expected[name])
        }
        summary = "; ".join(sentence for sentence, _ in sentences.values()) or "map and camera agree with GPS"
        self._notifier.log("survey", said=summary, **survey.fields())
        self._reported |= {name: survey.measures[name].value for name in names}
        for name, (sentence, gcs_text) in sentences.items():
            if name in names:
                self._notifier.announce(Severity.INFO, sentence, gcs_text=gcs_text, topic=f"survey {name}")

    def _apply_mount(self) -> None:
        """From now on, level pictures with the estimated mount; discard the comparisons with GPS so far."""
        mount = Mount(*(self._reported.get(name, self._expected[name])[0] for name in _MOUNT_NAMES))
        self._survey.set_mount(mount)
        self._gps.reset()
        self._set_mount(mount)


def _format_result(name: str, measure: SurveyMeasure) -> tuple[str, str]:
    """Return a survey result as a sentence, and a shorter one for the ground station."""
    value = measure.value[0]
    if name == "off_m":
        offset = f"{format_offset(*measure.value)} of GPS"
        return f"the map is {offset}, +-{measure.sd:.1f} m", f"map {offset}"
    if name == "scale":
        size = f"{abs(value):.1%} too {'large' if value > 0 else 'small'}"
        return f"the map is {size}, +-{measure.sd:.1%}", f"map is {size}"
    sides = ("behind", "ahead") if name == "ahead_deg" else ("left", "right")
    side, key = sides[value > 0], f"source.mount_{name}"
    tilt_text = f"looks {abs(value):.1f} degrees {side}"
    return f"the camera {tilt_text} of straight down, +-{measure.sd:.1f}: set {key}: {value:.1f}", f"camera {tilt_text}"
