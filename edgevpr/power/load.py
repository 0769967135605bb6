"""How busy, full and hot the whole machine is, for its flight controller and ground station."""

from dataclasses import dataclass

import psutil


@dataclass(frozen=True, slots=True)
class MachineLoad:
    """`core_shares` (0..1, one a core) since the last look; `temperature_c` of the hottest sensor, None without one."""

    core_shares: tuple[float, ...]
    ram_used_bytes: int
    ram_total_bytes: int
    temperature_c: float | None


def machine_load() -> MachineLoad:
    """Look at the machine; the first look has nothing to compare with and sees idle cores."""
    memory = psutil.virtual_memory()
    sensors = psutil.sensors_temperatures() if hasattr(psutil, "sensors_temperatures") else {}
    return MachineLoad(
        tuple(percent / 100 for percent in psutil.cpu_percent(percpu=True)),
        memory.total - memory.available,
        memory.total,
        max((sensor.current for group in sensors.values() for sensor in group), default=None),
    )
