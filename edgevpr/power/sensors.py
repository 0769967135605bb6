"""Power meters that boards carry: INA219/226/3221 chips (hwmon), RAPL (x86), the power chip of the Pi 5.

`root` is the root of the file system: another tree can stand in its place.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from edgevpr.power import machine, vcgencmd
from edgevpr.power.powermeter import Meter, MeterError, number, parsed

_ROOT = Path("/")

# Channels that carry everything the module draws, by NVIDIA's rail names: Orin and Xavier NX; Nano.
_INPUT_RAILS = ("VDD_IN", "POM_5V_IN")
_ONE_CHANNEL = ("ina219", "ina220", "ina226", "ina230", "ina231", "ina260")
_NO_METER = (
    "This machine has no power meter that edgevpr knows (an INA219, INA226 or INA3221 in /sys/class/hwmon, RAPL, the "
    "power chip of a Raspberry Pi 5): write its watts into a profile by hand, from a meter in its supply."
)


@dataclass(frozen=True, slots=True)
class Found:
    """The meters of this machine, those of the board's input first; `notes` are sentences on meters that could not be
    used."""

    meters: tuple[Meter, ...]
    notes: tuple[str, ...]


def find_meters(root: Path = _ROOT) -> Found:
    """Look for power meters. Never raises: a meter that is there but cannot be read becomes a note, and so does no
    meter at all."""
    notes: list[str] = []
    meters = [*_ina_meters(root), *_pmic_meters(root), *_rapl_meters(root, notes)]
    if not meters and not notes:
        notes.append(_NO_METER)
    order = ("board", "cpu", "rail")
    return Found(tuple(sorted(meters, key=lambda meter: order.index(meter.covers))), tuple(notes))


def _ina_meters(root: Path) -> Iterator[Meter]:
    for folder in sorted((root / "sys/class/hwmon").glob("hwmon*")):
        name = machine.text(folder / "name")
        if name in _ONE_CHANNEL:
            label = machine.text(folder / "in1_label")
            where = f", channel {label}" if label else ", taken to be wired to the board's input"
            covers = "board" if label is None or label in _INPUT_RAILS else "rail"
            yield _ina_channel(folder, 1, f"{name.upper()} ({folder.name}){where}", covers, label is not None)
        elif name == "ina3221":
            for channel in (1, 2, 3):  # in4 to in7 are shunt voltages
                if (
                    machine.text(folder / f"in{channel}_enable") == "0"
                    or not (folder / f"curr{channel}_input").exists()
                ):
                    continue
                label = machine.text(folder / f"in{channel}_label") or str(channel)
                covers = "board" if label in _INPUT_RAILS else "rail"
                yield _ina_channel(folder, channel, f"INA3221 ({folder.name}), channel {label}", covers)


def _ina_channel(
    folder: Path, channel: int, title: str, covers: Literal["board", "rail"], certain: bool = True
) -> Meter:
    power = folder / f"power{channel}_input"

    def look() -> tuple[float, ...]:
        if power.exists():
            return (number(power) / 1e6,)
        # An INA3221 gives no power. A small negative current (-1 mA at no load) is its offset and counts as none.
        current_ma = number(folder / f"curr{channel}_input")
        return (number(folder / f"in{channel}_input") * (0.0 if -5 < current_ma < 0 else current_ma) / 1e6,)

    return Meter(kind="ina", title=title, covers=covers, period_s=0.05, look=look, certain=certain)


def _rapl_meters(root: Path, notes: list[str]) -> Iterator[Meter]:
    """Make one meter for all packages. Cores, memory and graphics (intel-rapl:0:0 ...) are parts of a package, and psys
    is the platform that contains the packages: adding those would count energy twice."""
    counters, wraps_j = [], []
    for folder in sorted((root / "sys/class/powercap").glob("intel-rapl:*")):
        if not (machine.text(folder / "name") or "").startswith("package"):
            continue
        try:
            number(folder / "energy_uj")
            wrap_j = number(folder / "max_energy_range_uj") / 1e6
        except MeterError as error:
            notes.append(str(error))
            continue
        if wrap_j <= 0:
            notes.append(f"{folder} does not say when its counter wraps (max_energy_range_uj): it is not used.")
            continue
        counters.append(folder / "energy_uj")
        wraps_j.append(wrap_j)
    if counters:
        packages = "1 CPU package" if len(counters) == 1 else f"{len(counters)} CPU packages"
        yield Meter(
            kind="rapl",
            title=f"RAPL ({packages}, without memory, disks and converters)",
            covers="cpu",
            period_s=1.0,  # a counter advances every millisecond, and wraps after many minutes at the earliest
            look=lambda: tuple(number(path) / 1e6 for path in counters),
            wraps_j=tuple(wraps_j),
        )


def _pmic_meters(root: Path) -> Iterator[Meter]:
    program = vcgencmd.find(root)
    if program and re.search(r"Raspberry Pi (5|Compute Module 5)", machine.model(root) or ""):
        yield Meter(
            kind="pmic",
            title="power chip of the Raspberry Pi 5 (sum of its rails, corrected; without USB devices)",
            covers="board",
            period_s=0.5,  # a reading starts a process: more often would be a load of its own
            look=lambda: (_pmic_w(program),),
            certain=False,
        )


def _pmic_w(program: Path) -> float:
    """Return the watts at the board's input from volts and amperes of all rails that have both.

    The rails leave out the losses of converters; 1.1451 x + 0.5879 W is the public fit to a meter in the supply
    (project jfikar/RPi5-power).
    """
    try:
        answer = vcgencmd.ask(program, "pmic_read_adc")
    except OSError as error:
        raise MeterError(
            f"The power chip cannot be read with vcgencmd ({error}): see that your user is in the group video."
        ) from None
    rails: dict[str, dict[str, float]] = {"A": {}, "V": {}}
    for name, unit, value in re.findall(r"(\w+)_([AV])\b[^=\n]*=\s*(-?[0-9.]+)[AV]\s*$", answer, re.MULTILINE):
        rails[unit][name] = parsed(value, f"{program} pmic_read_adc, {name}")
    both = rails["A"].keys() & rails["V"].keys()
    if not both:
        raise MeterError(f"{program} pmic_read_adc lists no rail with volts and amperes: this firmware cannot be used.")
    return 1.1451 * sum(rails["A"][name] * rails["V"][name] for name in both) + 0.5879
