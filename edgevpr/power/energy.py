"""Running totals of what a flight has cost: idle power all the time, marginal power while a stage runs.

Energies add up, powers do not (see `equations`). The sum of a T and of s U t over all stages is exactly the integral of
5.1 over the flight, in whatever order the stages come.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass

from edgevpr.core.types import StageCost
from edgevpr.power.boards import Board
from edgevpr.power.equations import marginal_energy_j


@dataclass(frozen=True, slots=True, kw_only=True)
class EnergySoFar:
    """Totals since the start: seconds, joules at the board's input, CPU-seconds of the stages and of the whole
    process."""

    elapsed_s: float
    idle_j: float
    marginal_j: float
    stages_cpu_s: float
    process_cpu_s: float


class RunningEnergy:
    """Adds up stages as they end. `clock` and `cpu_clock` give wall and CPU-seconds (all threads) in flight."""

    def __init__(
        self,
        board: Board,
        clock: Callable[[], float] = time.monotonic,
        cpu_clock: Callable[[], float] = time.process_time,
    ) -> None:
        self._board, self._clock, self._cpu_clock = board, clock, cpu_clock
        self._start_s, self._cpu_start_s = clock(), cpu_clock()
        self._marginal_j = self._stages_cpu_s = 0.0

    def add(self, *stages: StageCost) -> None:
        """Count stages that have ended; the time between them costs idle power, which needs no counting."""
        for stage in stages:
            u = stage.utilisation(self._board.cores)
            self._marginal_j += marginal_energy_j(self._board.idle_w, self._board.full_w, u, stage.wall_s)
            self._stages_cpu_s += stage.cpu_s

    def so_far(self) -> EnergySoFar:
        """Return the totals until now."""
        elapsed_s = self._clock() - self._start_s
        return EnergySoFar(
            elapsed_s=elapsed_s,
            idle_j=self._board.idle_w * elapsed_s,
            marginal_j=self._marginal_j,
            stages_cpu_s=self._stages_cpu_s,
            process_cpu_s=self._cpu_clock() - self._cpu_start_s,
        )
