"""What a flight takes of its board while it flies: charge, cores, memory, heat."""

import time
from dataclasses import asdict
from typing import Any

from edgevpr.power.boards import Board
from edgevpr.power.energy import RunningEnergy
from edgevpr.power.equations import Pack, marginal_energy_j, pack_ah
from edgevpr.power.load import OwnLoad
from edgevpr.power.machine import rss_mb
from edgevpr.power.thermal import ThermalWatch
from edgevpr.runtime.flight.governor import Reading
from edgevpr.types import StageCost


class FlightMeter:
    """Counts from when it is made. `thermal` is what was last seen of the board's heat. `close` it when done."""

    def __init__(self, board: Board, pack: Pack, regulator_efficiency: float) -> None:
        self._board, self._pack, self._regulator_efficiency = board, pack, regulator_efficiency
        self._energy = RunningEnergy(board, time.monotonic, time.process_time)
        self._load = OwnLoad(board.cores, time.monotonic, time.process_time)
        self._watch = ThermalWatch(clock=time.monotonic)
        self.thermal = self._watch.look()

    @property
    def age_s(self) -> float:
        """Seconds since the last `reading`."""
        return self._load.age_s

    @property
    def used_mah(self) -> float:
        return self.totals()["used_mah"]

    def count(self, *stages: StageCost) -> None:
        """Count stages of a query: its picture read, encoded, matched, and what was found told to others."""
        self._energy.add(*stages)

    def busy(self, work: StageCost) -> None:
        """Count what the loop did, by its own thread's CPU time."""
        self._load.busy(work)

    def totals(self) -> dict[str, float]:
        """Until now: `used_mah`, what the board has drawn from the pack, idle all the time and busy with this process
        (of other programs nothing is known); `process_mah`, the part that the process added; `marginal_mah`, the part
        of it that the stages of its queries added (see `count`). And the CPU-seconds of both."""
        so_far, board = self._energy.so_far(), self._board
        process = StageCost(so_far.elapsed_s, so_far.process_cpu_s)
        process_j = marginal_energy_j(board.idle_w, board.full_w, process.utilisation(board.cores), so_far.elapsed_s)
        return {
            "elapsed_s": so_far.elapsed_s,
            "used_mah": self._mah(so_far.idle_j + process_j),
            "process_mah": self._mah(process_j),
            "marginal_mah": self._mah(so_far.marginal_j),
            "process_cpu_s": so_far.process_cpu_s,
            "stages_cpu_s": so_far.stages_cpu_s,
        }

    def look_at_heat(self) -> None:
        """Look at the sensors, once a second or so."""
        self.thermal = self._watch.look()

    def heat_fields(self) -> dict[str, Any]:
        """For the log: temperature, frequency, whether the board slows itself down, and why."""
        return asdict(self.thermal)

    def reading(self) -> Reading:
        """For the governor, since the last one."""
        cpu_share, late_share = self._load.look()
        return Reading(
            cpu_share=cpu_share,
            late_share=late_share,
            rss_mb=rss_mb(),
            temperature_c=self.thermal.temperature_c,
            throttled=self.thermal.throttled,
        )

    def close(self) -> None:
        self._watch.close()

    def _mah(self, energy_j: float) -> float:
        return 1000 * pack_ah(energy_j, self._pack, self._regulator_efficiency)
