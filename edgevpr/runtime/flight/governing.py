"""Applying the governor's changes: another rate, fewer candidates, another form of the index."""

from dataclasses import asdict

from edgevpr.core.config import Config
from edgevpr.mavlink.messages import Severity
from edgevpr.runtime.flight.clock import Pace
from edgevpr.runtime.flight.governor import Change, Governor, Limits, Setting, lowered, steps
from edgevpr.runtime.flight.world import Crew
from edgevpr.runtime.recognise.opening import take_form

GOVERN_S = 1.0
_RELOAD_S = 10.0  # between two tries to load a lost index


class Governing:
    """Keeps a recogniser and its `pace` within the limits of the board. Every change, down or back, is logged and
    announced once."""

    def __init__(self, config: Config, crew: Crew, pace: Pace) -> None:
        self._config, self._crew, self._pace, self._recogniser = config, crew, pace, crew.recogniser
        self._index_mb = {crew.recogniser.technique.spec.form: crew.recogniser.index.nbytes / 1e6}
        self._governor = _governor(crew, pace.rate_hz, self._index_mb)
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
        self._pace.rate_hz = self._governor.setting.rate_hz
        self._recogniser.accept_with(config.match.accept_precision)

    def look(self) -> None:
        """Look at the load of the flight, once a second, and change the settings if needed."""
        if self._wanted_form:  # without an index nothing is recognised, and the load tells nothing
            if self._crew.clock.mono_s() >= self._reload_due_s:
                self._load(self._wanted_form)
            return
        if self._crew.meter.age_s < GOVERN_S:
            return
        change = self._governor.look(self._crew.clock.mono_s(), self._crew.meter.reading())
        if change is None:
            return
        self._say(change)
        self._pace.rate_hz = change.after.rate_hz
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
            self._wanted_form, self._reload_due_s = form, self._crew.clock.mono_s() + _RELOAD_S
            self._recogniser.lose_index(error)
            if first:
                self._crew.herald.tell(
                    "index lost",
                    Severity.WARNING,
                    f"the index cannot be loaded as {form}: {error}",
                    ground="its map cannot be read, see its log",
                    topic="map",
                    form=form,
                    problem=str(error),
                )
            return
        self._wanted_form = None
        self._index_mb[form] = self._recogniser.index.nbytes / 1e6
        self._crew.meter.reading()  # drop this reading: the load of loading says nothing of flying

    def _say(self, change: Change) -> None:
        text = ground = self.held or "back to what was asked"
        if change.before == change.after:
            text, ground = "over a limit of the board", "over a limit of its board, see its log"
        severity = Severity.INFO if change.back else Severity.WARNING
        fields = {"from": asdict(change.before), "to": asdict(change.after), "why": change.why}
        self._crew.herald.tell("governor", severity, f"{text}: {change.why}", ground=ground, topic="limits", **fields)


def _governor(crew: Crew, rate_hz: float, index_mb: dict[str | None, float]) -> Governor:
    """Make the governor that keeps a recogniser within its board's profile. A sequence needs queries as often as the
    map was made, and its rivals compared."""
    recogniser = crew.recogniser
    board, spec = recogniser.meter.board, recogniser.technique.spec
    in_sequence = recogniser.sequence > 1
    asked = Setting(rate_hz, recogniser.candidates, spec.form)
    settings = steps(asked, in_sequence, () if in_sequence else crew.fewer_candidates, crew.smaller_forms)
    return Governor(Limits(board.cpu_share, board.memory_max_mb, crew.meter.limit_c), settings, index_mb)
