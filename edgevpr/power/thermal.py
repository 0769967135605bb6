"""Temperature, CPU frequency and supply voltage of the machine, and signs of throttling, for the flight.

Each reading opens some files in /sys."""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from edgevpr.power import machine

_DEFAULT_LIMIT_C = 80.0  # the Raspberry Pi firmware throttles from here on; conservative for other boards
_CPU_ZONE = re.compile(r"cpu|soc|pkg|tj|acpitz|bigcore|littlecore", re.IGNORECASE)
# Bits of the firmware's reply for the current state. Shifted left by 16, they are for any time since boot.
_FIRMWARE_BITS = ((1, "under-voltage"), (2, "frequency capped"), (4, "throttled"), (8, "soft temperature limit"))
_UNDER_VOLTAGE_BIT = 1
_SLOWDOWN_BITS = 2 | 4 | 8
_SOFT_LIMIT_BIT = 8


@dataclass(frozen=True, slots=True, kw_only=True)
class ThermalState:
    """State at one reading. `temperature_c`: of the hottest CPU sensor. `frequency_mhz`: of the fastest core cluster.
    `throttled`: the machine throttles now. `why`: signs that it does or did ("": none). `under_voltage`: the supply
    voltage is too low, or was since the last reading. `hot`: throttling temperature reached. None: unknown."""

    temperature_c: float | None
    frequency_mhz: float | None
    throttled: bool | None
    why: str
    under_voltage: bool | None = None
    hot: bool | None = None


class ThermalWatch:
    """Reads the temperature, frequency and voltage sensors, which are located once, at creation. `hot_c`: temperature
    in degrees Celsius that counts as hot (None: `read_limit_c` of the machine)."""

    def __init__(self, root: Path = Path("/"), hot_c: float | None = None) -> None:
        self._temperatures = [zone / "temp" for zone in _find_cpu_zones(root)]
        self._limit_c = read_limit_c(root)
        self._hot_c = self._limit_c if hot_c is None else hot_c
        policies = sorted((root / "sys/devices/system/cpu/cpufreq").glob("policy*"))
        self._policy = max(policies, key=lambda policy: _read_number(policy / "cpuinfo_max_freq") or 0, default=None)
        self._top_khz = (self._policy and _read_number(self._policy / "cpuinfo_max_freq")) or 0
        self._allowed_khz = 0
        self._firmware = next((root / "sys/devices/platform").glob("soc*/*firmware/get_throttled"), None)
        # Raspberry Pi driver. Its alarm lasts 2 s, so that a dip between two readings is not missed.
        names = (root / "sys/class/hwmon").glob("*/name")
        alarms = (name.with_name("in0_lcrit_alarm") for name in names if machine.read_text(name) == "rpi_volt")
        self._alarm = next(alarms, None)
        self._previous_bits: int | None = None

    def read(self) -> ThermalState:
        """Read the sensors. Never raises: a value that cannot be read, or is impossible, becomes None."""
        degrees = [value / 1000 for value in map(_read_number, self._temperatures) if value is not None]
        temperature_c = max((value for value in degrees if -40 <= value <= 150), default=None)
        khz = _read_number(self._policy / "scaling_cur_freq") if self._policy else None
        frequency_mhz = khz / 1000 if khz is not None and khz > 0 else None
        bits = _read_number(self._firmware, 16) if self._firmware else None
        signs = list(self._find_slowdown_signs(bits or 0, temperature_c, khz))
        is_known = bits is not None or self._top_khz > 0
        is_hot = temperature_c is not None and temperature_c >= self._hot_c
        return ThermalState(
            temperature_c=temperature_c,
            frequency_mhz=frequency_mhz,
            throttled=any(slows for slows, _ in signs) if is_known else None,
            why="; ".join(why for _, why in signs),
            under_voltage=self._is_under_voltage(bits),
            hot=None if temperature_c is None and bits is None else is_hot or bool((bits or 0) & _SOFT_LIMIT_BIT),
        )

    def _is_under_voltage(self, bits: int | None) -> bool | None:
        """Return True if the firmware `bits` or the driver's alarm report a low supply voltage now, or if the firmware
        has recorded one since the last call (None: unknown)."""
        alarm = _read_number(self._alarm) if self._alarm else None
        if bits is None:
            return None if alarm is None else alarm > 0
        previous_bits = bits if self._previous_bits is None else self._previous_bits
        self._previous_bits = bits
        return bool((alarm or 0) > 0 or bits & _UNDER_VOLTAGE_BIT or (bits & ~previous_bits) >> 16 & _UNDER_VOLTAGE_BIT)

    def _find_slowdown_signs(
        self, bits: int, temperature_c: float | None, khz: int | None
    ) -> Iterator[tuple[bool, str]]:
        """Yield a pair for each sign of throttling: True if it is throttling now (False: only a warning, or past), and
        a text. `bits`: flags of the firmware (0: none). `khz`: current CPU frequency."""
        if current := [word for bit, word in _FIRMWARE_BITS if bits & bit]:
            yield bool(bits & _SLOWDOWN_BITS), f"{', '.join(current)} now"
        if past := [word for bit, word in _FIRMWARE_BITS if bits >> 16 & bit and not bits & bit]:
            yield False, f"{', '.join(past)} since start"
        if self._policy:
            # The kernel lowers this limit to cool the CPU. A power mode may keep it low, so the normal limit is the
            # highest so far.
            allowed_khz = _read_number(self._policy / "scaling_max_freq") or 0
            self._allowed_khz = max(self._allowed_khz, allowed_khz)
            normal_khz = self._allowed_khz or self._top_khz
            is_hot = temperature_c is not None and temperature_c >= self._limit_c
            if 0 < allowed_khz < 0.98 * normal_khz:
                yield True, f"frequency limited to {allowed_khz / 1000:g} of {normal_khz / 1000:g} MHz"
            # A low frequency alone is no evidence, because idle cores slow down; a hot machine is not idle.
            elif is_hot and khz and khz < 0.9 * normal_khz:
                yield True, f"{khz / 1000:g} of {normal_khz / 1000:g} MHz at {temperature_c:g} degrees"


def read_limit_c(root: Path = Path("/")) -> float:
    """Return the degrees Celsius at which this machine begins to throttle: the lowest passive trip point of its CPU. If
    the kernel has none (Raspberry Pi), it is 80 degrees, or 10 below the shutdown temperature if that is lower."""
    trips: dict[str, list[float]] = {}
    for zone in _find_cpu_zones(root):
        for path in zone.glob("trip_point_*_type"):
            value = _read_number(path.with_name(path.name.replace("_type", "_temp")))
            if value is not None and 40_000 <= value <= 125_000:
                trips.setdefault(machine.read_text(path) or "", []).append(value / 1000)
    if "passive" in trips:
        return min(trips["passive"])
    return min([_DEFAULT_LIMIT_C, *(value - 10 for value in trips.get("critical", []))])


def _find_cpu_zones(root: Path) -> list[Path]:
    zones = sorted((root / "sys/class/thermal").glob("thermal_zone*"))
    return [zone for zone in zones if _CPU_ZONE.search(machine.read_text(zone / "type") or "")] or zones


def _read_number(path: Path, base: int = 10) -> int | None:
    try:
        return int(machine.read_text(path) or "", base)
    except ValueError:
        return None
