"""The clocks of a flight as one value, which a test or a replay can replace, and the pace at which frames are taken."""

import time
from collections.abc import Callable
from dataclasses import dataclass

# Images further apart overlap too little for visual odometry on a fixed-wing aircraft: additional ones are taken
# between such queries.
_MAX_QUERY_INTERVAL_S = 1.5


@dataclass(frozen=True, slots=True, kw_only=True)
class Clock:
    """Clocks, in seconds. The monotonic `mono_s` stamps frames and messages; `wall_s` times the steps of a query;
    `utc_s` counts from 1970. CPU times are of this process and of the calling thread."""

    mono_s: Callable[[], float] = time.monotonic
    wall_s: Callable[[], float] = time.perf_counter
    utc_s: Callable[[], float] = time.time
    process_cpu_s: Callable[[], float] = time.process_time
    thread_cpu_s: Callable[[], float] = time.thread_time
    sleep: Callable[[float], None] = time.sleep


class Pace:
    """Decides when to take the next frame: at `rate_hz`, or at the intervals of a recording. After a delay it
    does not catch up."""

    def __init__(self, rate_hz: float, clock: Clock) -> None:
        self._clock = clock
        self._due_s = clock.mono_s()
        self.rate_hz = self._requested_hz = rate_hz
        self._last_s = self._due_s  # time of the last frame

    def wait_s(self) -> float:
        """Return the seconds until the next frame is due; 0 or less if it is due now."""
        return self._due_s - self._clock.mono_s()

    def record_frame(self, step_s: float | None = None) -> None:
        """Record that a frame was taken. The next is due after `step_s` (None: at the rate), or later in proportion to
        how far the rate has been lowered."""
        wait_s = 1 / self.rate_hz if step_s is None else step_s * self._requested_hz / self.rate_hz
        self._due_s = max(self._due_s + wait_s, self._clock.mono_s())
        self._last_s = self._clock.mono_s()

    def is_odometry_due(self, interval_s: float) -> bool:
        """Return True, once, if a frame for odometry alone is due, `interval_s` after the last, between two queries."""
        now_s = self._clock.mono_s()
        is_early = now_s < self._last_s + interval_s or self._due_s - now_s < interval_s / 2
        if is_early or self.rate_hz * _MAX_QUERY_INTERVAL_S > 1:
            return False
        self._last_s = now_s
        return True
