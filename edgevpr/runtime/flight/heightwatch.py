"""Compares the reported height above ground with the scale of the pictures. A wrong height makes each
picture's footprint, the motion between two pictures and the correction of tilt wrong."""

import statistics
from collections import deque

from edgevpr.core.reasons import Reason, ReasonCode
from edgevpr.mavlink.messages import Severity
from edgevpr.runtime.flight.autopilot import AutopilotOutput
from edgevpr.runtime.flight.measurements import MIN_HEIGHT_M
from edgevpr.runtime.flight.notifier import Notifier
from edgevpr.runtime.recognise.recognition import Recognition

MIN_CONTRADICTION_RATIO = 1.25
MIN_CORRECTION_RATIO = 1.1  # a larger error is corrected; five matches scatter by less
MATCHES_IN_A_ROW = 5
_NEWEST_MATCHES = 3  # over rising or falling ground the median of all five would be two matches old


class HeightWatch:
    """Reports once when the heights of five matches in a row contradict the reported one, and once when five agree
    again. A match has a height only if the lens is known. The `autopilot` (None: there is no link) receives the ratio.

    `image_height_m`, `autopilot_height_m`: medians over the last five matches (None: the heights agree)."""

    def __init__(self, notifier: Notifier, autopilot: AutopilotOutput | None = None) -> None:
        self.image_height_m: float | None = None
        self.autopilot_height_m: float | None = None
        self._notifier, self._autopilot = notifier, autopilot
        self._heights_m: deque[tuple[float, float]] = deque(maxlen=MATCHES_IN_A_ROW)  # of images, of the autopilot
        self._last_s: float | None = None

    @property
    def ratio(self) -> float:
        """Visual height divided by the autopilot's, median of the last three matches; 1.0 unless five in a row deviate
        in the same direction."""
        ratios = self._ratios
        is_wrong = len(ratios) == MATCHES_IN_A_ROW and _are_beyond(MIN_CORRECTION_RATIO, ratios)
        return statistics.median(ratios[-_NEWEST_MATCHES:]) if is_wrong else 1.0

    @property
    def _ratios(self) -> list[float]:
        return [image_height_m / autopilot_height_m for image_height_m, autopilot_height_m in self._heights_m]

    def update(self, event: Recognition) -> None:
        """Compare the height of an event's match, if it has one, with the reported height."""
        frame, vehicle, located = event.frame, event.vehicle, event.located
        if frame is None or vehicle is None or located is None or not event.accepted or event.view.reason:
            return
        is_known = located.height_m and located.height_ratio and vehicle.height_m is not None
        if not is_known or frame.t_mono_s == self._last_s or not vehicle.is_fresh(frame.t_mono_s):
            return
        self._last_s = frame.t_mono_s
        self._heights_m.append((max(MIN_HEIGHT_M, located.height_m or 0.0), max(MIN_HEIGHT_M, vehicle.height_m or 0.0)))
        if self._autopilot:
            self._autopilot.correct_height(self.ratio)
        self._judge()

    def _judge(self) -> None:
        ratios = self._ratios
        if len(ratios) < MATCHES_IN_A_ROW:
            return
        was_contradicted = self.image_height_m is not None
        if all(1 / MIN_CONTRADICTION_RATIO <= ratio <= MIN_CONTRADICTION_RATIO for ratio in ratios):
            self.image_height_m = self.autopilot_height_m = None
        elif was_contradicted or _are_beyond(MIN_CONTRADICTION_RATIO, ratios):
            self.image_height_m, self.autopilot_height_m = map(statistics.median, zip(*self._heights_m, strict=True))
        if was_contradicted != (self.image_height_m is not None):
            self._report()

    def _report(self) -> None:
        if self.image_height_m is None or self.autopilot_height_m is None:
            self._notifier.report("height", Severity.INFO, Reason(ReasonCode.HEIGHT_AGREES))
            return
        heights_m = {"autopilot_height_m": self.autopilot_height_m, "image_height_m": self.image_height_m}
        note = Reason(ReasonCode.HEIGHT_DIFFERS, heights_m)
        self._notifier.report("height", Severity.WARNING, note, ratio=round(self.ratio, 2))


def _are_beyond(limit: float, ratios: list[float]) -> bool:
    """Return True if all ratios are greater than `limit`, or all less than its inverse."""
    return min(ratios) > limit or max(ratios) < 1 / limit
