"""The governor keeps CPU load, memory and temperature within the board's profile. It first compares fewer candidates,
which costs few matches, then makes fewer queries per second, and steps back up when resource use is normal.

It steps up only if the load, scaled to the higher setting, stays clearly below every limit. If a step up soon had to be
undone, it waits twice as long before the next one.
"""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace

from edgevpr.core.reasons import Reason, ReasonCode
from edgevpr.mavlink.messages import Severity
from edgevpr.power.boards import Board
from edgevpr.runtime.flight.clock import Pace
from edgevpr.runtime.flight.flightio import FlightParts
from edgevpr.runtime.flight.metering import LoadReading

GOVERN_INTERVAL_S = 1.0
_MIN_EXCEEDED_S = 3.0  # a limit must be exceeded for this long before anything changes
_MIN_HEAT_WAIT_S = 20.0  # after a change: a hot board cools slowly, so the effect shows late
_MIN_WAIT_S = 6.0  # the load must be below all limits for this long before a step up
_MAX_WAIT_S = 600.0
_STEP_UP_TRIAL_S = 300.0  # a step up that lasts this long was successful
_MAX_EXPECTED_LOAD = 0.85  # expected at the higher setting, as a fraction of a limit
_MAX_LATE_FRACTION = 0.95
_TEMPERATURE_MARGIN_C = 5.0
_MAX_MEMORY_FRACTION = 0.95
_MAX_HEADROOM_MEMORY = 0.9
_MAX_RATE_DIVISOR = 8  # the lowest rate is the configured one divided by this
_COMPARE_FRACTION = 0.6  # of a query's time is spent comparing candidates, in a large map (benchmarks/results/arm64.md)


@dataclass(frozen=True, slots=True)
class Setting:
    """Settings of recognition: `rate_hz`, queries per second; `candidates`, places compared per query; and `form`, the
    form of descriptors in RAM, which never changes (None: the technique has none)."""

    rate_hz: float
    candidates: int
    form: str | None = None


@dataclass(frozen=True, slots=True)
class Change:
    """Change from the setting `before` to `after`, and why. `is_upward`: to a higher setting. The settings are equal if
    a limit is exceeded and no lower setting is left."""

    before: Setting
    after: Setting
    why: Reason
    is_upward: bool = False


def list_settings(configured: Setting, keeps_rate: bool, fewer: Sequence[int] = ()) -> tuple[Setting, ...]:
    """Return the settings from `configured` down to the lowest: first fewer candidates, by the numbers in `fewer` (with
    which no wrong place is accepted), then, unless `keeps_rate`, the rate halved, down to an eighth."""
    settings = [configured]
    settings += [replace(configured, candidates=count) for count in fewer if count < configured.candidates]
    while not keeps_rate and settings[-1].rate_hz > configured.rate_hz / _MAX_RATE_DIVISOR:
        settings.append(replace(settings[-1], rate_hz=settings[-1].rate_hz / 2))
    return tuple(settings)


class Governor:
    """Decides which of the `settings` (highest first) is in force: it steps down when a limit of the `board`, or the
    temperature `limit_c` (degrees Celsius), is exceeded, and up when resource use is back to normal."""

    def __init__(self, board: Board, limit_c: float, settings: Sequence[Setting]) -> None:
        self._board, self._limit_c, self._settings, self._index = board, limit_c, list(settings), 0
        self._since_s: dict[str, float] = {}  # start of each condition that holds
        self._changed_s = self._stepped_up_s = -math.inf
        self._step_up_wait_s = _MIN_WAIT_S
        self._reported: set[str] = set()

    @property
    def setting(self) -> Setting:
        """The setting in force."""
        return self._settings[self._index]

    @property
    def restriction(self) -> str | None:
        """Short text with the lowered settings; None if none is lowered."""
        now, full = self.setting, self._settings[0]
        parts = (
            f"{now.rate_hz:g} of {full.rate_hz:g} Hz" if now.rate_hz != full.rate_hz else "",
            f"{now.candidates} of {full.candidates} candidates" if now.candidates != full.candidates else "",
        )
        return f"held to {', '.join(filter(None, parts))}" if now != full else None

    def update(self, now_s: float, reading: LoadReading) -> Change | None:
        """Process a measurement over one second and a whole number of queries; return the change to make."""
        is_hot, exceeded = self._check_load(reading)
        max_mb = self._board.memory_max_mb
        has_headroom = self._has_headroom(reading, self._settings[max(0, self._index - 1)])
        exceeded_s = self._measure_held_s("exceeded", now_s, exceeded is not None)
        headroom_s = self._measure_held_s("headroom", now_s, has_headroom)
        full_s = self._measure_held_s("full", now_s, reading.rss_mb >= _MAX_MEMORY_FRACTION * max_mb)
        if has_headroom:
            self._reported.discard("load")
        if reading.rss_mb <= _MAX_HEADROOM_MEMORY * max_mb:
            self._reported.discard("memory")
        if full_s >= _MIN_EXCEEDED_S and "memory" not in self._reported:
            why = Reason(ReasonCode.MEMORY_OVER_LIMIT, {"used_mb": reading.rss_mb, "max_mb": max_mb})
            return self._report_limit("memory", why)
        is_cooling = is_hot and now_s - self._changed_s < _MIN_HEAT_WAIT_S
        if exceeded is not None and exceeded_s >= _MIN_EXCEEDED_S and not is_cooling:
            if is_hot:
                self._step_up_wait_s = max(self._step_up_wait_s, _MIN_HEAT_WAIT_S)
            if (lower_index := self._find_lower(is_hot)) is not None:
                return self._step_down(now_s, lower_index, exceeded)
            return None if "load" in self._reported else self._report_limit("load", exceeded)
        if self._index > 0 and headroom_s >= self._step_up_wait_s:
            self._stepped_up_s = now_s
            return self._change(now_s, self._index - 1, Reason(ReasonCode.RESOURCES_FREE), is_upward=True)
        return None

    def _measure_held_s(self, name: str, now_s: float, holds: bool) -> float:
        """Record whether the condition `name` holds now; return the seconds for which it has held continuously."""
        if not holds:
            self._since_s.pop(name, None)
            return 0.0
        return now_s - self._since_s.setdefault(name, now_s)

    def _find_lower(self, is_hot: bool) -> int | None:
        """Return the index of the next lower setting; if `is_hot`, of the next with a lower rate to cool faster."""
        lower = range(self._index + 1, len(self._settings))
        slower = [index for index in lower if self._settings[index].rate_hz < self.setting.rate_hz]
        return next(iter(slower if is_hot and slower else lower), None)

    def _check_load(self, reading: LoadReading) -> tuple[bool, Reason | None]:
        """Return whether the board is too hot, and the exceeded limit (None: none is exceeded)."""
        max_share, temperature_c = self._board.cpu_share, reading.temperature_c
        if temperature_c is not None and temperature_c >= self._limit_c:
            return True, Reason(ReasonCode.BOARD_HOT, {"temperature_c": temperature_c, "limit_c": self._limit_c})
        if reading.throttled:
            return True, Reason(ReasonCode.BOARD_THROTTLED)
        if reading.cpu_share > max_share:
            return False, Reason(ReasonCode.CPU_OVER_LIMIT, {"cpu_share": reading.cpu_share, "max_share": max_share})
        if reading.late_share > _MAX_LATE_FRACTION:
            return False, Reason(ReasonCode.QUERIES_LATE)
        return False, None

    def _has_headroom(self, reading: LoadReading, higher: Setting) -> bool:
        """Return True if the load would stay clearly below all limits with the setting `higher`."""
        current, board = self.setting, self._board
        factor = 1 + _COMPARE_FRACTION * (higher.candidates / current.candidates - 1)
        factor *= higher.rate_hz / current.rate_hz
        return (
            reading.cpu_share * factor <= _MAX_EXPECTED_LOAD * board.cpu_share
            and reading.late_share * factor <= _MAX_EXPECTED_LOAD
            and not reading.throttled
            and (reading.temperature_c is None or reading.temperature_c <= self._limit_c - _TEMPERATURE_MARGIN_C)
            and reading.rss_mb <= _MAX_HEADROOM_MEMORY * board.memory_max_mb
        )

    def _report_limit(self, limit: str, why: Reason) -> Change:
        """Return a change between equal settings: a limit ("memory" or "load") is exceeded, but nothing is lowered."""
        self._reported.add(limit)
        return Change(self.setting, self.setting, why)

    def _step_down(self, now_s: float, index: int, why: Reason) -> Change:
        if now_s - self._stepped_up_s < _STEP_UP_TRIAL_S:
            self._step_up_wait_s = min(2 * self._step_up_wait_s, _MAX_WAIT_S)
            self._stepped_up_s = -math.inf  # further steps down for the same reason are not a new failure
        elif now_s - self._changed_s >= max(_STEP_UP_TRIAL_S, 2 * self._step_up_wait_s):
            self._step_up_wait_s = _MIN_WAIT_S
        return self._change(now_s, index, why, is_upward=False)

    def _change(self, now_s: float, index: int, why: Reason, is_upward: bool) -> Change:
        before = self.setting
        self._index, self._changed_s = index, now_s
        self._since_s.clear()  # readings before a change do not describe the time after it
        return Change(before, self.setting, why, is_upward)


class GovernorActuator:
    """Applies a `Governor` to a recogniser and its `pace`, and reports each change. With sequence matching neither
    rate nor candidates are lowered: it needs queries at the map's rate, and compares all candidates."""

    def __init__(self, parts: FlightParts, pace: Pace, fewer_candidates: tuple[int, ...]) -> None:
        self._parts, self._pace = parts, pace
        recogniser, technique = parts.recogniser, parts.recogniser.technique
        matches_sequences = recogniser.sequence > 1
        configured = Setting(pace.rate_hz, recogniser.candidates or technique.candidates, technique.spec.form)
        settings = list_settings(configured, matches_sequences, () if matches_sequences else fewer_candidates)
        self.governor = Governor(recogniser.meter.board, parts.meter.limit_c, settings)

    def update(self) -> None:
        """Measure the load, at most once a second, and change the settings if needed."""
        parts = self._parts
        if parts.meter.load.age_s < GOVERN_INTERVAL_S:
            return
        change = self.governor.update(parts.io.clock.mono_s(), parts.meter.read_load())
        if change is None:
            return
        text = gcs_text = self.governor.restriction or "back to the configured settings"
        severity = Severity.INFO if change.is_upward else Severity.NOTICE
        if change.before == change.after:
            text = "over a limit of the board, and no lower setting is left"
            gcs_text, severity = "over a limit of its board, see its log", Severity.WARNING
        fields = {"from": asdict(change.before), "to": asdict(change.after), "why": change.why}
        parts.notifier.log("governor", **fields)
        parts.notifier.announce(severity, f"{text}: {change.why}", gcs_text=gcs_text, topic="limits")
        self._pace.rate_hz = change.after.rate_hz
        parts.recogniser.change(candidates=change.after.candidates)
