"""The governor keeps CPU share, memory and temperature within the board's profile. It first compares fewer candidates,
which find nearly as much for less, then asks less often, then takes a form of the index that costs less. It goes back
the same way when there is room again.

Pure: readings and their times go in, changes come out. Two rules keep it from swinging to and fro. It goes back only if
the reading, scaled to the higher setting, leaves a clear distance to every limit. A step back that soon had to be
undone is tried again after a wait that doubles each time.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

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
_OTHER_FORM = 2.0  # the larger form takes about this many times the work


@dataclass(frozen=True, slots=True)
class Setting:
    """Settings of recognition: queries a second, places compared, and the form of the index (None: the
    technique has no forms)."""

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


@dataclass(frozen=True, slots=True, kw_only=True)
class Reading:
    """One measurement. `cpu_share`, of all cores (0..1), and `late_share` are since the last reading. `late_share` is
    the share of the time that queries took, 0 where nothing kept them waiting. The rest is the present state, None
    where unknown."""

    cpu_share: float
    late_share: float
    rss_mb: float
    temperature_c: float | None
    throttled: bool | None


@dataclass(frozen=True, slots=True)
class Change:
    """Change from one setting to another, with the reason. `back` is True towards what was asked; both settings are the
    same where nothing is left to lower."""

    before: Setting
    after: Setting
    why: str
    back: bool = False


def steps(
    asked: Setting, keeps_rate: bool, fewer: Sequence[int] = (), forms: Sequence[str] = ()
) -> tuple[Setting, ...]:
    """Return the settings from what is asked down to the least.

    The candidates are lowered to each of `fewer`, numbers that are known to accept no wrong place, largest first. Then
    the rate is halved down to an eighth, then the forms are taken. `keeps_rate` is for sequences, which need queries as
    often as the map was made. `forms` are those that the map can serve and that cost less than the one asked for, in
    the order to take them.
    """
    found = [asked]
    found += [replace(asked, candidates=count) for count in fewer if count < asked.candidates]
    if not keeps_rate:
        while found[-1].rate_hz > asked.rate_hz / _SLOWEST:
            found.append(replace(found[-1], rate_hz=found[-1].rate_hz / 2))
    found += [replace(found[-1], form=form) for form in forms]
    return tuple(found)


def lowered(setting: Setting, asked: Setting) -> str:
    """Name what a setting has other than asked, in a few words; "" where it is all as asked."""
    parts = (
        f"{setting.rate_hz:g} of {asked.rate_hz:g} Hz" if setting.rate_hz != asked.rate_hz else "",
        f"{setting.candidates} of {asked.candidates} candidates" if setting.candidates != asked.candidates else "",
        f"form {setting.form}" if setting.form != asked.form else "",
    )
    return ", ".join(filter(None, parts))


class Governor:
    """Goes down and up `settings` (of `steps`). `index_mb` is the size of the index in each form that has been in force
    so far; the caller that loads a form adds its size. Only the form saves memory, so memory lowers the form whatever
    the load allows."""

    def __init__(self, limits: Limits, settings: Sequence[Setting], index_mb: Mapping[str | None, float]) -> None:
        self._limits, self._settings, self._index_mb = limits, settings, index_mb
        self._forms = list(dict.fromkeys(setting.form for setting in settings))
        self._at = self._form_at = 0
        self._over, self._full, self._room, self._memory_room = (_Held() for _ in range(4))
        self._changed_s = self._raised_s = -math.inf
        self._wait_s = _FIRST_WAIT_S
        self._said: set[str] = set()

    @property
    def setting(self) -> Setting:
        """Setting in force."""
        return self._setting(self._at, self._form_at)

    @property
    def asked(self) -> Setting:
        """Setting in force while no limit is passed."""
        return self._settings[0]

    def ask_rate(self, rate_hz: float) -> None:
        """Ask for another rate: what is lowered stays lowered as much."""
        factor = rate_hz / self.asked.rate_hz
        self._settings = [replace(each, rate_hz=each.rate_hz * factor) for each in self._settings]

    def look(self, now_s: float, reading: Reading) -> Change | None:
        """Judge a reading; None: all stays as it is. Call it about once a second, each time with a reading over a whole
        number of queries."""
        hot, over = self._load(reading)
        full = reading.rss_mb >= _NEAR_MEMORY * self._limits.memory_max_mb
        less, more = self._less(hot), self._next(-1, 0) or self._next(-1, -1)  # load and memory may hold the same form
        smaller, larger = self._next(0, 1), self._next(0, -1)
        room = self._has_room(reading, self._setting(*more or (self._at, self._form_at)))
        memory_room = self._has_memory(reading, self._setting(*larger or (self._at, self._form_at)))
        over_s, full_s = self._over.since(now_s, over is not None), self._full.since(now_s, full)
        room_s, memory_room_s = self._room.since(now_s, room), self._memory_room.since(now_s, memory_room)
        self._said -= {what for what, ended in (("load", room), ("memory", memory_room)) if ended}
        if full_s >= _PATIENCE_S:
            why = f"{reading.rss_mb:.0f} MB of memory taken, and {self._limits.memory_max_mb:.0f} allowed"
            if change := self._down(now_s, smaller, "memory", why):
                return change
        if over is not None and over_s >= _PATIENCE_S and not (hot and now_s - self._changed_s < _HEAT_PATIENCE_S):
            change = self._down(now_s, less, "load", over)
            if hot:
                self._wait_s = max(self._wait_s, _HEAT_PATIENCE_S)
            return change
        if more and room_s >= self._wait_s:
            return self._back(now_s, more)
        if larger and memory_room_s >= self._wait_s:
            return self._back(now_s, larger)
        return None

    def _setting(self, at: int, form_at: int) -> Setting:
        chosen = self._settings[at]
        return replace(chosen, form=self._forms[max(form_at, self._forms.index(chosen.form))])

    def _next(self, by: int, form_by: int) -> tuple[int, int] | None:
        """Return the nearest step in this direction that changes the setting, None where there is none.

        A step may change nothing, where the memory or the load has put the form in force already.
        """
        at, form_at = self._at + by, self._form_at + form_by
        while 0 <= at < len(self._settings) and 0 <= form_at < len(self._forms):
            if self._setting(at, form_at) != self.setting:
                return at, form_at
            at, form_at = at + by, form_at + form_by
        return None

    def _less(self, hot: bool) -> tuple[int, int] | None:
        """Return the next step down; where the board is hot, the next to a lower rate, since a small one cools it too
        slowly to tell."""
        rate_hz, settings = self.setting.rate_hz, enumerate(self._settings)
        slower = next((at for at, each in settings if at > self._at and each.rate_hz < rate_hz), None)
        return self._next(1, 0) if slower is None or not hot else (slower, self._form_at)

    def _load(self, reading: Reading) -> tuple[bool, str | None]:
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

    def _has_room(self, reading: Reading, then: Setting) -> bool:
        """Tell whether all limits would be kept by a clear distance with this setting."""
        now, limits = self.setting, self._limits
        more = 1 + _OF_CANDIDATES * (then.candidates / now.candidates - 1)
        more *= then.rate_hz / now.rate_hz
        more *= 1.0 if then.form == now.form else _OTHER_FORM
        return (
            reading.cpu_share * more <= _ROOM * limits.cpu_share
            and reading.late_share * more <= _ROOM
            and not reading.throttled
            and (reading.temperature_c is None or reading.temperature_c <= limits.temperature_c - _COOLER_C)
            and self._has_memory(reading, then)
        )

    def _has_memory(self, reading: Reading, then: Setting) -> bool:
        grows_mb = self._index_mb[then.form] - self._index_mb[self.setting.form]
        return reading.rss_mb + grows_mb <= _MEMORY_ROOM * self._limits.memory_max_mb

    def _down(self, now_s: float, step: tuple[int, int] | None, what: str, why: str) -> Change | None:
        before = self.setting
        if step is None:
            if what in self._said:
                return None
            self._said.add(what)
            return Change(before, before, f"{why}, and nothing is left to lower")
        if now_s - self._raised_s < _TRIAL_S:
            self._wait_s = min(2 * self._wait_s, _LONGEST_WAIT_S)
            self._raised_s = -math.inf  # further steps down for the same reason are no new failure
        elif now_s - self._changed_s >= max(_TRIAL_S, 2 * self._wait_s):
            self._wait_s = _FIRST_WAIT_S
        return self._changed(now_s, step, why, back=False)

    def _back(self, now_s: float, step: tuple[int, int]) -> Change:
        self._raised_s = now_s
        return self._changed(now_s, step, "there is room again", back=True)

    def _changed(self, now_s: float, step: tuple[int, int], why: str, back: bool) -> Change:
        before = self.setting
        self._at, self._form_at = step
        self._changed_s = now_s
        for held in (self._over, self._full, self._room, self._memory_room):
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
