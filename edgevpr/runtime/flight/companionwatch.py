"""Watch over the companion computer itself: reports when it is hot, throttled or short of voltage, for `vitals`."""

import math

from edgevpr.mavlink.messages import Severity
from edgevpr.power.thermal import ThermalState
from edgevpr.runtime.flight.notifier import Notifier

# Seconds between two reports of a problem at least, and without it until it counts as over: an under-voltage blinks.
_REPORT_EVERY_S = 30.0
# Fields of the state that are problems, each with the texts that it has begun and that it is over.
_TEXTS = {
    "under_voltage": ("companion under-voltage: check 5 V supply", "companion supply is fine again"),
    "throttled": ("companion throttled{at}: runs slower", "companion runs at full speed again"),
    "hot": ("companion hot{at}: give it cool air", "companion is cool again{at}"),
}


class CompanionWatch:
    """Reports each problem of the companion computer once when it begins and once when it is over."""

    def __init__(self, notifier: Notifier) -> None:
        self._notifier = notifier
        self._seen_s: dict[str, float] = {}  # when each problem was last seen
        self._reported_s: dict[str, float] = {}  # when each problem was last reported, as begun or as over
        self._holding: dict[str, str] = {}  # problems that were reported and are not over, with their texts

    @property
    def remarks(self) -> tuple[str, ...]:
        """Texts of the problems that hold."""
        return tuple(self._holding.values())

    def take(self, now_s: float, state: ThermalState) -> None:
        """Take a reading once a second, and report what has changed. An unknown value (None) changes nothing."""
        for problem in _TEXTS:
            value: bool | None = getattr(state, problem)
            if value:
                self._seen_s[problem] = now_s
            holds = now_s - self._seen_s.get(problem, -math.inf) < _REPORT_EVERY_S
            is_early = now_s - self._reported_s.get(problem, -math.inf) < _REPORT_EVERY_S
            if not is_early and (holds or value is not None) and holds != (problem in self._holding):
                self._report(now_s, problem, holds, state)

    def _report(self, now_s: float, problem: str, holds: bool, state: ThermalState) -> None:
        at = "" if state.temperature_c is None else f" at {state.temperature_c:.0f} degrees C"
        begun, over = (text.format(at=at) for text in _TEXTS[problem])
        self._reported_s[problem] = now_s
        if holds:
            self._holding[problem] = begun
        else:
            del self._holding[problem]
        text = begun if holds else over
        self._notifier.report(
            "companion",
            Severity.WARNING if holds else Severity.INFO,
            text,
            ground=text.replace(" degrees", ""),  # so that it fits a STATUSTEXT
            topic=f"companion {problem}",
            problem=problem,
            holds=holds,
            temperature_c=state.temperature_c,
            why=state.why,
            said=text,
        )
