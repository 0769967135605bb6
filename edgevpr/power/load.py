"""Load and memory of the machine, for its flight controller and ground station; and the share of this process."""

import time
from collections.abc import Callable
from dataclasses import dataclass

import psutil

from edgevpr.core.types import StageCost

_KEPT_WAITING = 0.15  # of busy time: a thread that did not run for longer was kept waiting (its own waits are shorter)


@dataclass(frozen=True, slots=True)
class MachineLoad:
    """`core_shares` (0..1, one a core) since the last look, and RAM in bytes."""

    core_shares: tuple[float, ...]
    ram_used_bytes: int
    ram_total_bytes: int


def machine_load() -> MachineLoad:
    """Look at the machine; the first look has nothing to compare with and reports idle cores."""
    memory = psutil.virtual_memory()
    return MachineLoad(
        tuple(percent / 100 for percent in psutil.cpu_percent(percpu=True)),
        memory.total - memory.available,
        memory.total,
    )


class OwnLoad:
    """Share of all cores that this process takes, and whether other programs keep it waiting, from look to look.

    `clock` and `cpu_clock` (all threads) give wall and CPU-seconds.
    """

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
        """Seconds since the last look."""
        return self._clock() - self._looked_s

    def busy(self, work: StageCost) -> None:
        """Count work; `work.cpu_s` is the CPU time of the thread that did it or waited for it (`time.thread_time`)."""
        self._busy_s += work.wall_s
        self._ran_s += work.cpu_s

    def look(self) -> tuple[float, float]:
        """Return, since the last look, this process's share of all cores, 0..1, and the share of the time that its work
        took, 0 where the thread could run when it wanted to."""
        now_s, cpu_s = self._clock(), self._cpu_clock()
        span = StageCost(now_s - self._looked_s, cpu_s - self._cpu_s)
        waited = self._ran_s < (1 - _KEPT_WAITING) * self._busy_s
        late_share = min(1.0, self._busy_s / span.wall_s) if waited and span.wall_s > 0 else 0.0
        self._looked_s, self._cpu_s = now_s, cpu_s
        self._busy_s = self._ran_s = 0.0
        return span.utilisation(self._cores), late_share
