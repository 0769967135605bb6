"""The times that a flight lives by, in one value: a test, or a replay, hands in its own."""

import time
from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True, slots=True, kw_only=True)
class Clock:
    """Give seconds: `mono_s` since the start of the machine (which every frame and message of a flight is stamped by),
    `utc_s` since 1970, `process_cpu_s` of all threads and `thread_cpu_s` of the one that asks. `sleep` waits."""

    mono_s: Callable[[], float] = time.monotonic
    utc_s: Callable[[], float] = time.time
    process_cpu_s: Callable[[], float] = time.process_time
    thread_cpu_s: Callable[[], float] = time.thread_time
    sleep: Callable[[float], None] = time.sleep
