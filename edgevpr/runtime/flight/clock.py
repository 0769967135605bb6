"""The clocks of a flight as one value, which a test or a replay can replace, and the pace at which frames are taken."""

import time
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from functools import partial

from edgevpr.core.types import Tape


@dataclass(frozen=True, slots=True, kw_only=True)
class Clock:
    """Clocks, in seconds. `mono_s` is the monotonic clock, which stamps every frame and message of a flight; `wall_s`
    times the steps of a query; `utc_s` counts from 1970. The CPU times are of all threads of this process, and of the
    calling one. `sleep` waits for some seconds."""

    mono_s: Callable[[], float] = time.monotonic
    wall_s: Callable[[], float] = time.perf_counter
    utc_s: Callable[[], float] = time.time
    process_cpu_s: Callable[[], float] = time.process_time
    thread_cpu_s: Callable[[], float] = time.thread_time
    sleep: Callable[[float], None] = time.sleep


def taped(clock: Clock, tape: Tape) -> Clock:
    """Return the same clocks with each reading recorded on the `tape`, or played back from it."""
    names = [each.name for each in fields(clock) if each.name != "sleep"]
    return replace(clock, **{name: partial(tape.read, name, getattr(clock, name)) for name in names})


class Pace:
    """Decides when to take the next frame: `rate_hz` frames per second, evenly spaced or by the steps of a recording.
    After a delay, missed frames are not made up for."""

    def __init__(self, rate_hz: float, clock: Clock) -> None:
        self._clock = clock
        self._due_s = clock.mono_s()
        self.rate_hz = self._asked_hz = rate_hz

    def wait_s(self) -> float:
        """Return the seconds until the next frame is due; 0 or less: it is due."""
        return self._due_s - self._clock.mono_s()

    def taken(self, step_s: float | None = None) -> None:
        """Note that a frame has been taken, and set the time at which the next one is due: after `step_s` (None: by the
        rate), or later by as much as the rate has been lowered since the start."""
        wait_s = 1 / self.rate_hz if step_s is None else step_s * self._asked_hz / self.rate_hz
        self._due_s = max(self._due_s + wait_s, self._clock.mono_s())
