"""Applying the governor's changes: another rate, fewer candidates, another form of the index."""

import logging
from dataclasses import asdict

from edgevpr.core.config import Config
from edgevpr.runtime.flight.autopilot import Autopilot, Mood
from edgevpr.runtime.flight.clock import Clock
from edgevpr.runtime.flight.flightlog import FlightLog
from edgevpr.runtime.flight.governor import Change, Governor, Limits, Setting, lowered, steps
from edgevpr.runtime.flight.metering import FlightMeter
from edgevpr.runtime.flight.pace import Pace
from edgevpr.runtime.recognise.opening import take_form
from edgevpr.runtime.recognise.recogniser import Recogniser

GOVERN_S = 1.0
_RELOAD_S = 10.0  # between two tries to load a lost index

_log = logging.getLogger(__name__)


class Governing:
    """Keeps a recogniser and its pace within the limits of the board. Every change, down or back, is logged and
    announced once. `fewer_candidates` and `smaller_forms` are those that may be taken, in this order (see
    `governor.steps`)."""

    def __init__(
        self,
        recogniser: Recogniser,
        pace: Pace,
        config: Config,
        *,
        meter: FlightMeter,
        flight_log: FlightLog,
        autopilot: Autopilot,
        clock: Clock,
        fewer_candidates: tuple[int, ...] = (),
        smaller_forms: tuple[str, ...] = (),
    ) -> None:
        self._recogniser, self._pace, self._config = recogniser, pace, config
        self._meter, self._flight_log, self._autopilot, self._clock = meter, flight_log, autopilot, clock
        self._index_mb = {recogniser.technique.spec.form: recogniser.index.nbytes / 1e6}
        self._governor = _governor(recogniser, pace, fewer_candidates, smaller_forms, self._index_mb, meter.limit_c)
        self._wanted_form: str | None = None  # a form that could not be loaded
        self._reload_due_s = 0.0

    @property
    def held(self) -> str | None:
        """Settings that are lowered to keep to the board's limits, in a few words; None where none is."""
        what = lowered(self._governor.setting, self._governor.asked)
        return f"held to {what}" if what else None

    def take(self, config: Config, rate_hz: float) -> None:
        """Fly on with another rate, and accept matches with the precision of another configuration."""
        self._config = config
        self._governor.ask_rate(rate_hz)
        self._pace.set_rate(self._governor.setting.rate_hz)
        self._recogniser.accept_with(config.match.accept_precision)

    def look(self) -> None:
        """Look at the load of the flight, once a second, and change the settings if needed."""
        if self._wanted_form:  # without an index nothing is recognised, and the load tells nothing
            if self._clock.mono_s() >= self._reload_due_s:
                self._load(self._wanted_form)
            return
        if self._meter.age_s < GOVERN_S:
            return
        change = self._governor.look(self._clock.mono_s(), self._meter.reading())
        if change is None:
            return
        self._say(change)
        self._pace.set_rate(change.after.rate_hz)
        self._recogniser.candidates = change.after.candidates
        if change.after.form != change.before.form:
            self._load(change.after.form)

    def _load(self, form: str) -> None:
        """Load the index in another form. Where the map cannot be read any more, nothing is recognised; this is
        announced, and loading is tried again and again, since the map may come back."""
        first = self._wanted_form is None
        try:
            take_form(self._recogniser, self._config, form)
        except Exception as error:
            self._wanted_form, self._reload_due_s = form, self._clock.mono_s() + _RELOAD_S
            self._recogniser.lose_index(error)
            if first:
                _log.warning("the index cannot be loaded as %s: %s", form, error)
                self._flight_log.write("index lost", form=form, problem=str(error))
                self._autopilot.announce(Mood.WARNING, "its map cannot be read, see its log", "map")
            return
        self._wanted_form = None
        self._index_mb[form] = self._recogniser.index.nbytes / 1e6
        self._meter.reading()  # drop this reading: the load of loading says nothing of flying

    def _say(self, change: Change) -> None:
        said = self.held or "back to what was asked"
        text = said
        if change.before == change.after:
            said, text = "over a limit of the board", "over a limit of its board, see its log"
        _log.log(logging.INFO if change.back else logging.WARNING, "%s: %s", said, change.why)
        fields = {"from": asdict(change.before), "to": asdict(change.after), "why": change.why}
        self._flight_log.write("governor", **fields)
        self._autopilot.announce(Mood.NOTE if change.back else Mood.WARNING, text, "limits")


def _governor(
    recogniser: Recogniser,
    pace: Pace,
    fewer_candidates: tuple[int, ...],
    smaller_forms: tuple[str, ...],
    index_mb: dict[str | None, float],
    hottest_c: float,
) -> Governor:
    """Make the governor that keeps a recogniser within its board's profile. A sequence needs queries as often as the
    map was made, and its rivals compared."""
    board, spec = recogniser.meter.board, recogniser.technique.spec
    in_sequence = recogniser.search.length > 1
    asked = Setting(pace.rate_hz, recogniser.candidates, spec.form)
    settings = steps(asked, in_sequence, () if in_sequence else fewer_candidates, smaller_forms)
    return Governor(Limits(board.cpu_share, board.memory_max_mb, hottest_c), settings, index_mb)
