"""The time at which the next frame is due."""

from edgevpr.runtime.flight.clock import Clock


class Pace:
    """Frames at `rate_hz`, evenly spaced; a frame that comes late does not make the frames after it come sooner."""

    def __init__(self, rate_hz: float, clock: Clock) -> None:
        self._clock = clock
        self._due_s = clock.mono_s()
        self.set_rate(rate_hz)

    def set_rate(self, rate_hz: float) -> None:
        """Set the frames a second that are asked for."""
        self.rate_hz, self._step_s = rate_hz, 1 / rate_hz

    def wait_s(self) -> float:
        """Return the seconds until the next frame is due, 0 or below where it is due already."""
        return self._due_s - self._clock.mono_s()

    def taken(self) -> None:
        """Note that a frame has been taken."""
        self._due_s = max(self._due_s + self._step_s, self._clock.mono_s())
