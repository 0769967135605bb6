"""Power meters at a board's input: INA chips (hwmon) of Jetsons and add-on boards. `calibrate` reads them.

A meter returns a number, or raises MeterError with a sentence: a missing file, text, a negative or an absurd value is
never passed on as a figure. Sensors of a part of the board (RAPL: the processor alone; the other rails of a Jetson) are
not used, since a profile's watts are those at the board's input.
"""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from edgevpr.core.errors import EdgevprError
from edgevpr.power import machine

NO_METER = (
    "This machine has no power meter at its input that edgevpr knows (an INA219, INA226 or INA3221 in "
    "/sys/class/hwmon): write its watts into a profile by hand, from a meter in its supply."
)
_ABSURD_W = 1000.0  # no companion computer draws this: the reading is wrong (also the bound of `full_w` in a profile)
_PERIOD_S = 0.05  # between two readings
# Channels that carry everything the module draws, by NVIDIA's rail names: Orin and Xavier NX; Nano.
_INPUT_RAILS = ("VDD_IN", "POM_5V_IN")
_ONE_CHANNEL = ("ina219", "ina220", "ina226", "ina230", "ina231", "ina260")


class MeterError(EdgevprError):
    """A power meter cannot be read, or gives an impossible value."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Meter:
    """A power meter. `look` returns watts. `certain` is False if `title` contains an assumption, such as how the meter
    is wired."""

    title: str
    look: Callable[[], float]
    certain: bool = True

    def read_w(self) -> float:
        """Read the power in watts. Raises MeterError if that fails or the value is impossible."""
        try:
            watts = self.look()
        except (OSError, ValueError) as error:
            raise MeterError(f"{self.title} cannot be read ({error}): the power meter is gone or broken.") from None
        if not 0 <= watts < _ABSURD_W:
            raise MeterError(f"{self.title} says {watts:g} W, which cannot be: check its wiring and its driver.")
        return watts


def find_meters(root: Path = Path("/")) -> Iterator[Meter]:
    """Find the power meters at the input of this machine. `root` is the root of the file system with /sys."""
    for folder in sorted((root / "sys/class/hwmon").glob("hwmon*")):
        name = machine.text(folder / "name") or ""
        label = machine.text(folder / "in1_label")
        if name in _ONE_CHANNEL and (label is None or label in _INPUT_RAILS):
            where = f", channel {label}" if label else ", taken to be wired to the board's input"
            yield _ina_channel(folder, 1, f"{name.upper()} ({folder.name}){where}", certain=label is not None)
        elif name == "ina3221":
            for channel in (1, 2, 3):  # in4 to in7 are shunt voltages
                label = machine.text(folder / f"in{channel}_label")
                if label in _INPUT_RAILS and machine.text(folder / f"in{channel}_enable") != "0":
                    yield _ina_channel(folder, channel, f"INA3221 ({folder.name}), channel {label}")


def mean_power(
    meter: Meter,
    window_s: float,
    clock: Callable[[], float] = time.monotonic,
    sleep: Callable[[float], None] = time.sleep,
) -> float:
    """Read `meter` for `window_s` seconds and return the mean in watts, by the trapezoidal rule. Raises MeterError at
    the first reading that fails. Short windows are unreliable: one study needed readings at 350 Hz. So let the same
    work run for many seconds."""
    start_s, times_s, watts = clock(), [], []
    steps = max(1, round(window_s / _PERIOD_S))
    for step in range(steps + 1):
        sleep(max(0.0, start_s + window_s * step / steps - clock()))
        before_s = clock()
        watts.append(meter.read_w())
        times_s.append((before_s + clock()) / 2)
    return float(np.trapezoid(watts, times_s)) / (times_s[-1] - times_s[0])


def _ina_channel(folder: Path, channel: int, title: str, certain: bool = True) -> Meter:
    power = folder / f"power{channel}_input"

    def look() -> float:
        if power.exists():
            return float(power.read_text()) / 1e6
        # An INA3221 reports volts and amperes only. A small negative current (-1 mA at no load) is its offset: zero.
        current_ma = float((folder / f"curr{channel}_input").read_text())
        mv = float((folder / f"in{channel}_input").read_text())
        return mv * (0.0 if -5 < current_ma < 0 else current_ma) / 1e6

    return Meter(title=title, look=look, certain=certain)
