"""CPU load and memory of the machine, for flight controller and ground station; and the CPU share of this process."""

import time
from collections.abc import Callable
from dataclasses import dataclass

import psutil

from edgevpr.core.types import StageCost

_KEPT_WAITING = 0.15  # of busy time; a thread off the CPU for more was kept waiting by other programs


@dataclass(frozen=True, slots=True)
class MachineLoad:
    """Load of the machine: the busy share of each core, 0..1, since the last call of `machine_load`, and RAM in
    bytes."""

    core_shares: tuple[float, ...]
    ram_used_bytes: int
    ram_total_bytes: int


def machine_load() -> MachineLoad:
    """Measure the load of the machine. The first call has no earlier one to compare with and reports idle cores."""
    memory = psutil.virtual_memory()
    return MachineLoad(
        tuple(percent / 100 for percent in psutil.cpu_percent(percpu=True)),
        memory.total - memory.available,
        memory.total,
    )


class OwnLoad:
    """Share of all `cores` that this process uses, and of its time in which other programs keep it waiting, between two
    calls of `look`. `clock` gives wall seconds, `cpu_clock` CPU-seconds of all threads of this process."""

    def __init__(
        self,
        cores: int,
        clock: Callable[[], float] = time.monotonic,
        cpu_clock: Callable[[], float] = time.process_time,
    ) -> None:
        self._cores, self._clock, self._cpu_clock = cores, clock, cpu_clock
        self._busy_s = self._ran_s = 0.0
        self._looked_s, self._cpu_s = clock(), cpu_clock()

    @property
    def age_s(self) -> float:
        """Seconds since the last call of `look`."""
        return self._clock() - self._looked_s

    def busy(self, work: StageCost) -> None:
        """Record a piece of work. Its `cpu_s` is that of the thread that did it or waited for it
        (`time.thread_time`)."""
        self._busy_s += work.wall_s
        self._ran_s += work.cpu_s

    def look(self) -> tuple[float, float]:
        """Return two shares since the last call, 0..1:
        - the share of all cores that this process used;
        - the share of the time that its recorded work took; 0 if other programs did not keep it waiting."""
        now_s, cpu_s = self._clock(), self._cpu_clock()
        span = StageCost(now_s - self._looked_s, cpu_s - self._cpu_s)
        waited = self._ran_s < (1 - _KEPT_WAITING) * self._busy_s
        late_share = min(1.0, self._busy_s / span.wall_s) if waited and span.wall_s > 0 else 0.0
        self._looked_s, self._cpu_s = now_s, cpu_s
        self._busy_s = self._ran_s = 0.0
        return span.utilisation(self._cores), late_share
