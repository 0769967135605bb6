"""The measurements of a flight's computer as one value, which a test or a replay can replace."""

from collections.abc import Callable
from dataclasses import dataclass

from edgevpr.power.machine import read_rss_mb
from edgevpr.power.meter import MachineLoad, measure_machine_load
from edgevpr.power.thermal import ThermalState, read_limit_c
from edgevpr.runtime.flight.flightlog import FlightLog


@dataclass(frozen=True, slots=True, kw_only=True)
class Machine:
    """Measurements of the computer. `measure_heat`: temperature, frequency and supply. `limit_c`: the temperature at
    which it throttles itself, degrees Celsius. `measure_load`: load of all cores since the last call, and RAM.
    `rss_mb`: memory that this process uses, MB. `is_written`: True if the last line of a flight log was written."""

    measure_heat: Callable[[], ThermalState]
    limit_c: Callable[[], float] = read_limit_c
    measure_load: Callable[[], MachineLoad] = measure_machine_load
    rss_mb: Callable[[], float] = read_rss_mb
    is_written: Callable[[FlightLog], bool] = lambda flight_log: flight_log.fault is None
