"""The computer of a flight: its temperature, load and memory, and whether the flight log can be written."""

from edgevpr.power.boards import Board
from edgevpr.power.machine import read_rss_mb
from edgevpr.power.meter import MachineLoad, measure_machine_load
from edgevpr.power.thermal import ThermalState, ThermalWatch, read_limit_c
from edgevpr.runtime.flight.flightlog import FlightLog


class Machine:
    """Measures the computer. `watch` reads the sensors (None: a new one with the limit of the `board`)."""

    def __init__(self, board: Board, watch: ThermalWatch | None = None) -> None:
        self._watch = watch or ThermalWatch(hot_c=board.thermal_limit_c)

    def limit_c(self) -> float:
        """Return the temperature at which this computer throttles itself, degrees Celsius."""
        return read_limit_c()

    def measure_heat(self) -> ThermalState:
        """Measure temperature, frequency and supply."""
        return self._watch.read()

    def measure_load(self) -> MachineLoad:
        """Measure the load of all cores since the last call, and the RAM."""
        return measure_machine_load()

    def rss_mb(self) -> float:
        """Return the memory that this process uses, MB."""
        return read_rss_mb()

    def is_written(self, flight_log: FlightLog) -> bool:
        """Return True if the last line of a flight log was written."""
        return flight_log.fault is None
