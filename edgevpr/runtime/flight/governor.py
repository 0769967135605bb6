"""The governor keeps CPU share, memory and temperature within the board's profile. It first compares fewer candidates,
which find nearly as much for less, then asks less often, and goes back the same way when there is room again.

Two rules keep it from swinging to and fro. It goes back only if the reading, scaled to the higher setting, leaves a
clear distance to every limit. A step back that soon had to be undone is tried again later, and each time twice as late.
"""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace

from edgevpr.mavlink.messages import Severity
from edgevpr.runtime.flight.clock import Pace
from edgevpr.runtime.flight.metering import LoadReading
from edgevpr.runtime.flight.world import Crew

GOVERN_S = 1.0
_PATIENCE_S = 3.0  # a limit must be passed for so long before anything changes
_HEAT_PATIENCE_S = 20.0  # after a change: a hot board cools slowly, so its effect shows late
_FIRST_WAIT_S, _LONGEST_WAIT_S = 6.0, 600.0  # with room below all limits, before it goes back
_TRIAL_S = 300.0  # going back was right if it lasts so long
_ROOM = 0.85  # of a limit, for the load expected at the higher setting
_LATE = 0.95
_COOLER_C = 5.0
_NEAR_MEMORY, _MEMORY_ROOM = 0.95, 0.9
_SLOWEST = 8  # times less often than asked, at most
_OF_CANDIDATES = 0.6  # of a query that is for its candidates, in a large map (benchmarks/results/arm64.md)


@dataclass(frozen=True, slots=True)
class Setting:
    """Settings of recognition: queries a second, places compared, and the form of the index, which stays as it is
    (None: the technique has no forms)."""

    rate_hz: float
    candidates: int
    form: str | None = None


@dataclass(frozen=True, slots=True)
class Limits:
    """Limits: the process's share of all cores (0..1) and its memory, and the temperature of the board in degrees
    Celsius."""

    cpu_share: float
    memory_max_mb: float
    temperature_c: float


@dataclass(frozen=True, slots=True)
class Change:
    """Change from one setting to another, with the reason. `back` is True towards what was asked; both settings are the
    same where nothing is left to lower."""

    before: Setting
    after: Setting
    why: str
    back: bool = False


def steps(asked: Setting, keeps_rate: bool, fewer: Sequence[int] = ()) -> tuple[Setting, ...]:
    """Return the settings from what is asked down to the least: the candidates are lowered to each of `fewer`, numbers
    that are known to accept no wrong place, largest first; then the rate is halved down to an eighth. `keeps_rate` is
    for sequences, which need queries as often as the map was made."""
    found = [asked]
    found += [replace(asked, candidates=count) for count in fewer if count < asked.candidates]
    while not keeps_rate and found[-1].rate_hz > asked.rate_hz / _SLOWEST:
        found.append(replace(found[-1], rate_hz=found[-1].rate_hz / 2))
    return tuple(found)


def lowered(setting: Setting, asked: Setting) -> str:
    """Name what a setting has other than asked, in a few words; "" where it is all as asked."""
    parts = (
        f"{setting.rate_hz:g} of {asked.rate_hz:g} Hz" if setting.rate_hz != asked.rate_hz else "",
        f"{setting.candidates} of {asked.candidates} candidates" if setting.candidates != asked.candidates else "",
    )
    return ", ".join(filter(None, parts))


class Governor:
    """Goes down and up `settings` (of `steps`)."""

    def __init__(self, limits: Limits, settings: Sequence[Setting]) -> None:
        self._limits, self._settings, self._at = limits, list(settings), 0
        self._over, self._full, self._room = _Held(), _Held(), _Held()
        self._changed_s = self._raised_s = -math.inf
        self._wait_s = _FIRST_WAIT_S
        self._told: set[str] = set()

    @property
    def setting(self) -> Setting:
        """Setting in force."""
        return self._settings[self._at]

    @property
    def asked(self) -> Setting:
        """Setting in force while no limit is passed."""
        return self._settings[0]

    def ask_rate(self, rate_hz: float) -> None:
        """Ask for another rate: what is lowered stays lowered as much."""
        factor = rate_hz / self.asked.rate_hz
        self._settings = [replace(each, rate_hz=each.rate_hz * factor) for each in self._settings]

    def look(self, now_s: float, reading: LoadReading) -> Change | None:
        """Judge a reading; None: all stays as it is. Call it about once a second, each time with a reading over a whole
        number of queries."""
        hot, over = self._load(reading)
        most_mb = self._limits.memory_max_mb
        has_room = self._has_room(reading, self._settings[max(0, self._at - 1)])
        over_s, room_s = self._over.since(now_s, over is not None), self._room.since(now_s, has_room)
        full_s = self._full.since(now_s, reading.rss_mb >= _NEAR_MEMORY * most_mb)
        if has_room:
            self._told.discard("load")
        if reading.rss_mb <= _MEMORY_ROOM * most_mb:
            self._told.discard("memory")
        if full_s >= _PATIENCE_S:
            why = f"{reading.rss_mb:.0f} MB of memory taken, and {most_mb:.0f} allowed"
            if change := self._nothing_left("memory", why):
                return change
        if over is not None and over_s >= _PATIENCE_S and not (hot and now_s - self._changed_s < _HEAT_PATIENCE_S):
            if hot:
                self._wait_s = max(self._wait_s, _HEAT_PATIENCE_S)
            below = self._below(hot)
            return self._nothing_left("load", over) if below is None else self._down(now_s, below, over)
        if self._at > 0 and room_s >= self._wait_s:
            self._raised_s = now_s
            return self._changed(now_s, self._at - 1, "there is room again", back=True)
        return None

    def _below(self, hot: bool) -> int | None:
        """Return the next step down; where the board is hot, the next to a lower rate, since a small one cools it too
        slowly to tell. None: there is none."""
        below = range(self._at + 1, len(self._settings))
        slower = [at for at in below if self._settings[at].rate_hz < self.setting.rate_hz]
        return next(iter(slower if hot and slower else below), None)

    def _load(self, reading: LoadReading) -> tuple[bool, str | None]:
        """Tell whether it is too hot, and say which limit is passed (None: none, memory apart)."""
        limits, temperature_c = self._limits, reading.temperature_c
        if temperature_c is not None and temperature_c >= limits.temperature_c:
            return True, f"{temperature_c:.0f} degrees, and {limits.temperature_c:.0f} are the limit"
        if reading.throttled:
            return True, "the board slows itself down"
        if reading.cpu_share > limits.cpu_share:
            return False, f"{reading.cpu_share:.0%} of all cores taken, and {limits.cpu_share:.0%} allowed"
        if reading.late_share > _LATE:
            return False, "queries come late, kept waiting by other programs or the disk"
        return False, None

    def _has_room(self, reading: LoadReading, then: Setting) -> bool:
        """Tell whether all limits would be kept by a clear distance with this setting."""
        now, limits = self.setting, self._limits
        more = 1 + _OF_CANDIDATES * (then.candidates / now.candidates - 1)
        more *= then.rate_hz / now.rate_hz
        return (
            reading.cpu_share * more <= _ROOM * limits.cpu_share
            and reading.late_share * more <= _ROOM
            and not reading.throttled
            and (reading.temperature_c is None or reading.temperature_c <= limits.temperature_c - _COOLER_C)
            and reading.rss_mb <= _MEMORY_ROOM * limits.memory_max_mb
        )

    def _nothing_left(self, what: str, why: str) -> Change | None:
        """Say once that a limit is passed for which nothing can be lowered."""
        if what in self._told:
            return None
        self._told.add(what)
        return Change(self.setting, self.setting, f"{why}, and nothing is left to lower")

    def _down(self, now_s: float, at: int, why: str) -> Change:
        if now_s - self._raised_s < _TRIAL_S:
            self._wait_s = min(2 * self._wait_s, _LONGEST_WAIT_S)
            self._raised_s = -math.inf  # further steps down for the same reason are no new failure
        elif now_s - self._changed_s >= max(_TRIAL_S, 2 * self._wait_s):
            self._wait_s = _FIRST_WAIT_S
        return self._changed(now_s, at, why, back=False)

    def _changed(self, now_s: float, at: int, why: str, back: bool) -> Change:
        before = self.setting
        self._at, self._changed_s = at, now_s
        for held in (self._over, self._full, self._room):
            held.forget()  # readings before a change say nothing of the time after it
        return Change(before, self.setting, why, back)


class _Held:
    """Timer of a condition: for how long it has held."""

    def __init__(self) -> None:
        self._since_s: float | None = None

    def since(self, now_s: float, holds: bool) -> float:
        """Return the seconds since the first reading at which the condition held without a break, 0 where it does
        not."""
        if not holds:
            self._since_s = None
            return 0.0
        if self._since_s is None:
            self._since_s = now_s
        return now_s - self._since_s

    def forget(self) -> None:
        self._since_s = None


class Governing:
    """Keeps a recogniser and its `pace` within the limits of the board. Every change, down or back, is told once. A
    sequence needs queries as often as the map was made, and its rivals compared."""

    def __init__(self, crew: Crew, pace: Pace) -> None:
        self._crew, self._pace = crew, pace
        recogniser = crew.recogniser
        board, in_sequence = recogniser.meter.board, recogniser.sequence > 1
        technique = recogniser.technique
        asked = Setting(pace.rate_hz, recogniser.candidates or technique.candidates, technique.spec.form)
        settings = steps(asked, in_sequence, () if in_sequence else crew.fewer_candidates)
        self._governor = Governor(Limits(board.cpu_share, board.memory_max_mb, crew.meter.limit_c), settings)

    @property
    def held(self) -> str | None:
        """Settings that are lowered to keep to the board's limits, in a few words; None where none is."""
        what = lowered(self._governor.setting, self._governor.asked)
        return f"held to {what}" if what else None

    def ask_rate(self, rate_hz: float) -> None:
        """Fly on with another rate; what is lowered stays lowered as much."""
        self._governor.ask_rate(rate_hz)
        self._pace.rate_hz = self._governor.setting.rate_hz

    def look(self) -> None:
        """Look at the load of the flight, once a second, and change the settings if needed."""
        crew = self._crew
        if crew.meter.age_s < GOVERN_S:
            return
        change = self._governor.look(crew.clock.mono_s(), crew.meter.reading())
        if change is None:
            return
        text = ground = self.held or "back to what was asked"
        if change.before == change.after:
            text, ground = "over a limit of the board", "over a limit of its board, see its log"
        severity = Severity.INFO if change.back else Severity.WARNING
        fields = {"from": asdict(change.before), "to": asdict(change.after), "why": change.why}
        crew.herald.tell("governor", severity, f"{text}: {change.why}", ground=ground, topic="limits", **fields)
        self._pace.rate_hz = change.after.rate_hz
        crew.recogniser.candidates = change.after.candidates
