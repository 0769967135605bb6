"""Watch over the companion computer itself: reports when it is hot, throttled or short of voltage, for `vitals`."""

import math

from edgevpr.core.reasons import Reason, ReasonCode
from edgevpr.mavlink.messages import Severity
from edgevpr.power.thermal import ThermalState
from edgevpr.runtime.flight.notifier import Notifier

# Seconds between two reports of a problem at least, and without it until it counts as over: an under-voltage blinks.
_MIN_REPORT_INTERVAL_S = 30.0
# Fields of the state that are problems, each with the notes that it has begun and that it is over.
_NOTES = {
    "under_voltage": (ReasonCode.UNDER_VOLTAGE, ReasonCode.SUPPLY_FINE),
    "throttled": (ReasonCode.THROTTLED, ReasonCode.FULL_SPEED),
    "hot": (ReasonCode.HOT, ReasonCode.COOL),
}


class CompanionWatch:
    """Reports each problem of the companion computer once when it begins and once when it is over."""

    def __init__(self, notifier: Notifier) -> None:
        self._notifier = notifier
        self._seen_s: dict[str, float] = {}  # when each problem was last seen
        self._reported_s: dict[str, float] = {}  # when each problem was last reported, as begun or as over
        self._holding: dict[str, str] = {}  # problems that were reported and are not over, with their texts

    @property
    def problems(self) -> tuple[str, ...]:
        """Texts of the problems that hold."""
        return tuple(self._holding.values())

    def take(self, now_s: float, state: ThermalState) -> None:
        """Take a reading once a second, and report what has changed. An unknown value (None) changes nothing."""
        for problem in _NOTES:
            value: bool | None = getattr(state, problem)
            if value:
                self._seen_s[problem] = now_s
            holds = now_s - self._seen_s.get(problem, -math.inf) < _MIN_REPORT_INTERVAL_S
            is_early = now_s - self._reported_s.get(problem, -math.inf) < _MIN_REPORT_INTERVAL_S
            if not is_early and (holds or value is not None) and holds != (problem in self._holding):
                self._report(now_s, problem, holds, state)

    def _report(self, now_s: float, problem: str, holds: bool, state: ThermalState) -> None:
        code = _NOTES[problem][0 if holds else 1]
        note = Reason(code, {"temperature_c": state.temperature_c} if code.parameters else {})
        self._reported_s[problem] = now_s
        if holds:
            self._holding[problem] = str(note)
        else:
            del self._holding[problem]
        severity = Severity.WARNING if holds else Severity.INFO
        self._notifier.report("companion", severity, note, topic=f"companion {problem}", why=state.why)
