"""The time of a sender's clock in that of the autopilot. ArduPilot 4.7-dev keeps one such correction a link
(JitterCorrection)."""

_LONGEST_S = 0.5
_SAMPLES = 100


class Lag:
    """Takes the message that had the least delay for one without any, and none for more than half a second old."""

    def __init__(self) -> None:
        self._offset_s: float | None = None
        self._least_s = 0.0
        self._count = 0

    def corrected(self, sent_s: float, now_s: float) -> float:
        """Return the time of sending, by the autopilot's clock."""
        ahead_s = now_s - sent_s
        if self._offset_s is None or ahead_s < self._offset_s:
            self._offset_s = ahead_s
        if sent_s + self._offset_s < now_s - _LONGEST_S:
            self._offset_s = ahead_s - _LONGEST_S
        at_s = sent_s + self._offset_s
        self._least_s = ahead_s if self._count == 0 else min(self._least_s, ahead_s)
        self._count += 1
        if self._count == _SAMPLES:  # the clocks may drift apart
            self._offset_s, self._count = self._least_s, 0
        return at_s
