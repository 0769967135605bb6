"""The clocks of a flight in one value: a test, or a replay, hands in its own."""

import time
from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True, slots=True, kw_only=True)
class Clock:
    """Clocks in seconds: `mono_s` since the start of the machine, which stamps every frame and message of a flight;
    `process_cpu_s` CPU time of all threads; `thread_cpu_s` that of the calling thread. `sleep` waits."""

    mono_s: Callable[[], float] = time.monotonic
    process_cpu_s: Callable[[], float] = time.process_time
    thread_cpu_s: Callable[[], float] = time.thread_time
    sleep: Callable[[float], None] = time.sleep
