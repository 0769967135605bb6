"""Meters what a flight uses of its board: charge, CPU time, memory, heat.

The idle energy a T of a flight of T seconds, plus s U t of every stage, is exactly the integral of 5.1 over the flight,
whatever the order of the stages (see `power.equations`, which explains a, s and U)."""

from contextlib import AbstractContextManager
from dataclasses import dataclass

from edgevpr.core.config import BatteryConfig
from edgevpr.core.types import StageCost
from edgevpr.power.boards import Board
from edgevpr.power.equations import marginal_energy_j, pack_ah, parse_pack
from edgevpr.power.meter import ProcessLoad, Stage, meter_stage
from edgevpr.runtime.flight.clock import Clock
from edgevpr.runtime.flight.machine import Machine
from edgevpr.runtime.recognise.recognition import Recognition


@dataclass(frozen=True, slots=True, kw_only=True)
class LoadReading:
    """One measurement for the governor. `cpu_share` (0..1): fraction of all cores used by this process since the last
    measurement. `late_share` (0..1): fraction of that time spent on queries if other programs or the disk delayed them,
    else 0. `rss_mb`: memory of this process. The rest describes the board (None: unknown)."""

    cpu_share: float
    late_share: float
    rss_mb: float
    temperature_c: float | None
    throttled: bool | None


class FlightMeter:
    """Meter of a flight, starting when it is created. `load` sums the busy time of the loop. `thermal` is the newest
    measurement of temperature and supply, `limit_c` the temperature at which the board throttles itself."""

    def __init__(self, battery: BatteryConfig, board: Board, clock: Clock, machine: Machine) -> None:
        self._board, self._clock, self._machine = board, clock, machine
        self._pack, self._regulator_efficiency = parse_pack(battery.pack), battery.regulator_efficiency
        self._start_s, self._cpu_start_s = clock.mono_s(), clock.process_cpu_s()
        self._marginal_j = 0.0  # energy that the stages so far have added, at the board's input
        self.load = ProcessLoad(board.cores, clock.mono_s, clock.process_cpu_s)
        self.measure_heat()
        self.limit_c = self._machine.limit_c() if board.thermal_limit_c is None else board.thermal_limit_c

    def measure_cost(self, thread_only: bool = False) -> AbstractContextManager[Stage]:
        """Return a context manager that measures wall and CPU time, with `thread_only` that of this thread alone."""
        return meter_stage(self._clock.mono_s, self._clock.thread_cpu_s if thread_only else self._clock.process_cpu_s)

    def add(self, *stages: StageCost) -> None:
        """Add the energy of stages that have ended."""
        for stage in stages:
            self._marginal_j += self._compute_marginal_j(stage)

    def count(self, event: Recognition) -> None:
        """Add the cost of a frame: reading, encoding and matching."""
        self.add(event.steps.read, event.cost.whole)

    def totals(self) -> dict[str, float]:
        """Return the totals since the start: the charge drawn by the idle board and this process (`used_mah`), and the
        part of it for queries, which is reading, recognition and reporting (`marginal_mah`)."""
        process = StageCost(self._clock.mono_s() - self._start_s, self._clock.process_cpu_s() - self._cpu_start_s)
        used_j = self._board.idle_w * process.wall_s + self._compute_marginal_j(process)
        return {
            "elapsed_s": process.wall_s,
            "used_mah": self._to_mah(used_j),
            "marginal_mah": self._to_mah(self._marginal_j),
        }

    def measure_heat(self) -> None:
        """Measure the temperature and supply of the board. Call it about once a second."""
        self.thermal = self._machine.measure_heat()

    def read_load(self) -> LoadReading:
        """Return a measurement for the governor: load since the last one, and current memory and temperature."""
        cpu_share, late_share = self.load.measure()
        return LoadReading(
            cpu_share=cpu_share,
            late_share=late_share,
            rss_mb=self._machine.rss_mb(),
            temperature_c=self.thermal.temperature_c,
            throttled=self.thermal.throttled,
        )

    def _compute_marginal_j(self, cost: StageCost) -> float:
        board = self._board
        return marginal_energy_j(board.idle_w, board.full_w, cost.utilisation(board.cores), cost.wall_s)

    def _to_mah(self, energy_j: float) -> float:
        return 1000 * pack_ah(energy_j, self._pack, self._regulator_efficiency)
