"""Meters what a flight uses of its board: charge, CPU time, memory, heat."""

from contextlib import AbstractContextManager
from dataclasses import dataclass

from edgevpr.core.config import BatteryConfig
from edgevpr.power.boards import Board
from edgevpr.power.equations import marginal_energy_j, pack_ah, parse_pack
from edgevpr.power.meter import FlightEnergy, ProcessLoad, Stage, meter_stage
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
    """Meter of a flight, starting when it is created. `energy` sums the costs of queries, `load` the busy time of the
    loop. `thermal` is the newest measurement of temperature and supply, `limit_c` the temperature at which the board
    throttles itself. `machine` is the computer to measure (None: this one)."""

    def __init__(self, battery: BatteryConfig, board: Board, clock: Clock, *, machine: Machine | None = None) -> None:
        self._board, self._clock, self._machine = board, clock, machine or Machine(board)
        self._pack, self._regulator_efficiency = parse_pack(battery.pack), battery.regulator_efficiency
        self.energy = FlightEnergy(board, clock.mono_s, clock.process_cpu_s)
        self.load = ProcessLoad(board.cores, clock.mono_s, clock.process_cpu_s)
        self.measure_heat()
        self.limit_c = self._machine.limit_c() if board.thermal_limit_c is None else board.thermal_limit_c

    def measure_cost(self, thread_only: bool = False) -> AbstractContextManager[Stage]:
        """Return a context manager that measures wall time and CPU time: of all threads or, with `thread_only`, of this
        one."""
        return meter_stage(self._clock.mono_s, self._clock.thread_cpu_s if thread_only else self._clock.process_cpu_s)

    def count(self, event: Recognition) -> None:
        """Add the cost of a frame: reading, encoding and matching."""
        self.energy.add(event.steps.read, event.cost.whole)

    def totals(self) -> dict[str, float]:
        """Return the totals since the start: the charge drawn by the idle board and this process (`used_mah`), and the
        part of it for queries, which is reading, recognition and reporting (`marginal_mah`)."""
        process, board = self.energy.measure_process(), self._board
        process_j = marginal_energy_j(board.idle_w, board.full_w, process.utilisation(board.cores), process.wall_s)
        return {
            "elapsed_s": process.wall_s,
            "used_mah": self._to_mah(board.idle_w * process.wall_s + process_j),
            "marginal_mah": self._to_mah(self.energy.marginal_j),
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

    def _to_mah(self, energy_j: float) -> float:
        return 1000 * pack_ah(energy_j, self._pack, self._regulator_efficiency)
