"""Watches the companion computer itself, for `vitals`: reports when it is hot, throttled or under-voltage."""

import math

from edgevpr.core.reasons import Reason, ReasonCode
from edgevpr.mavlink.messages import Severity
from edgevpr.power.thermal import ThermalState
from edgevpr.runtime.flight.notifier import Notifier

# Shortest time between two reports of a problem, and time without it until it counts as over: under-voltage flickers.
_MIN_REPORT_INTERVAL_S = 30.0
# Fields of the state that are problems, each with the notes for its start and its end.
_NOTES = {
    "under_voltage": (ReasonCode.UNDER_VOLTAGE, ReasonCode.SUPPLY_FINE),
    "throttled": (ReasonCode.THROTTLED, ReasonCode.FULL_SPEED),
    "hot": (ReasonCode.HOT, ReasonCode.COOL),
}


class CompanionWatch:
    """Reports each problem of the companion computer once when it begins and once when it ends. `problems`: the texts
    of those that have not ended."""

    def __init__(self, notifier: Notifier) -> None:
        self._notifier = notifier
        self._last_true_s: dict[str, float] = {}  # when each problem was last reported by the board
        self._reported_s: dict[str, float] = {}  # when the start or end of each problem was last reported
        self.problems: dict[str, str] = {}

    def take(self, now_s: float, state: ThermalState) -> None:
        """Process a reading, once a second, and report changes. An unknown value (None) changes nothing."""
        for problem in _NOTES:
            value: bool | None = getattr(state, problem)
            if value:
                self._last_true_s[problem] = now_s
            is_active = now_s - self._last_true_s.get(problem, -math.inf) < _MIN_REPORT_INTERVAL_S
            is_early = now_s - self._reported_s.get(problem, -math.inf) < _MIN_REPORT_INTERVAL_S
            if not is_early and (is_active or value is not None) and is_active != (problem in self.problems):
                self._report(now_s, problem, is_active, state)

    def _report(self, now_s: float, problem: str, is_active: bool, state: ThermalState) -> None:
        code = _NOTES[problem][0 if is_active else 1]
        note = Reason(code, {"temperature_c": state.temperature_c} if code.parameters else {})
        self._reported_s[problem] = now_s
        if is_active:
            self.problems[problem] = str(note)
        else:
            del self.problems[problem]
        severity = Severity.WARNING if is_active else Severity.INFO
        self._notifier.report("companion", severity, note, topic=f"companion {problem}", why=state.why)
