"""This computer as a flight asks it: heat, load, memory, and what its disk takes."""

from collections.abc import Callable
from pathlib import Path

from edgevpr.core.config import Config
from edgevpr.core.errors import MapError
from edgevpr.power.boards import Board
from edgevpr.power.machine import rss_mb
from edgevpr.power.meter import MachineLoad, machine_load
from edgevpr.power.thermal import ThermalState, ThermalWatch, limit_c
from edgevpr.runtime.flight.flightlog import FlightLog
from edgevpr.runtime.preflight.pick import pick_technique
from edgevpr.runtime.recognise.opening import has_map

_NEW_MAP_PLACES = 1000  # places that a technique chosen for an empty map must be fast enough for


class Machine:
    """Answers each question by a measurement, or by a trial. `watch` reads the sensors (None: those of this computer,
    with the limit of the `board`)."""

    def __init__(self, board: Board, watch: ThermalWatch | None = None) -> None:
        self._watch = watch or ThermalWatch(hot_c=board.thermal_limit_c)

    def limit_c(self) -> float:
        """Return the temperature at which this computer slows itself down, degrees Celsius."""
        return limit_c()

    def measure_heat(self) -> ThermalState:
        """Measure temperature, frequency and supply."""
        return self._watch.look()

    def measure_load(self) -> MachineLoad:
        """Measure the load of all cores since the last call, and the RAM."""
        return machine_load()

    def rss_mb(self) -> float:
        """Return the memory that this process takes, MB."""
        return rss_mb()

    def pick_technique(self, config: Config) -> str | None:
        """Return the configured technique (None: that of the map), or for a map yet to be made the best for the
        board."""
        is_new = config.mapping.learn and config.map is not None and not has_map(Path(config.map))
        if is_new and config.technique is None:
            return pick_technique(config.board, _NEW_MAP_PLACES, config.source.camera)
        return config.technique

    def try_map(self, opened: Callable[[], object]) -> str | None:
        """Open a map by `opened`, and return why that fails (None: it does not)."""
        try:
            opened()
        except MapError as error:
            return str(error)
        return None

    def is_written(self, flight_log: FlightLog) -> bool:
        """Return True if the disk took the last line of a flight log."""
        return flight_log.state is None
