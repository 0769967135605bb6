"""The clocks of a flight in one value, so that a test or a replay hands in its own; and the pace of its frames."""

import time
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from functools import partial

from edgevpr.core.types import Tape


@dataclass(frozen=True, slots=True, kw_only=True)
class Clock:
    """Clocks in seconds: `mono_s` since the start of the machine, which stamps every frame and message of a flight;
    `wall_s` the one by which the steps of a query are timed; `utc_s` since 1970; `process_cpu_s` CPU time of all
    threads; `thread_cpu_s` that of the calling thread. `sleep` waits."""

    mono_s: Callable[[], float] = time.monotonic
    wall_s: Callable[[], float] = time.perf_counter
    utc_s: Callable[[], float] = time.time
    process_cpu_s: Callable[[], float] = time.process_time
    thread_cpu_s: Callable[[], float] = time.thread_time
    sleep: Callable[[float], None] = time.sleep


def taped(clock: Clock, tape: Tape) -> Clock:
    """Return the same clocks, each look at which is on the tape."""
    names = [each.name for each in fields(clock) if each.name != "sleep"]
    return replace(clock, **{name: partial(tape.read, name, getattr(clock, name)) for name in names})


class Pace:
    """Frames at `rate_hz`, evenly spaced; a frame that comes late does not make the frames after it come sooner."""

    def __init__(self, rate_hz: float, clock: Clock) -> None:
        self._clock = clock
        self._due_s = clock.mono_s()
        self.rate_hz = rate_hz

    def wait_s(self) -> float:
        """Return the seconds until the next frame is due, 0 or below where it is due already."""
        return self._due_s - self._clock.mono_s()

    def taken(self) -> None:
        """Note that a frame has been taken."""
        self._due_s = max(self._due_s + 1 / self.rate_hz, self._clock.mono_s())
