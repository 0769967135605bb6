"""Power meters at a board's input: INA chips (hwmon) of Jetsons and add-on boards, and the power chip of the Pi 5.

A meter returns a number, or raises MeterError with a sentence: a missing file, text, a negative or an absurd value is
never passed on as a figure. Sensors of a part of the board (RAPL: the processor alone; the other rails of a Jetson) are
not used, since a profile's watts are those at the board's input. `calibrate` reads these meters.
"""

import re
import subprocess
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from edgevpr.core.errors import EdgevprError
from edgevpr.power import machine

NO_METER = (
    "This machine has no power meter at its input that edgevpr knows (an INA219, INA226 or INA3221 in "
    "/sys/class/hwmon, or the power chip of a Raspberry Pi 5): write its watts into a profile by hand, from a meter in "
    "its supply."
)
_ABSURD_W = 1000.0  # no companion computer draws this: the reading is wrong (also the bound of `full_w` in a profile)
_MOST_FAILURES = 3  # in a row: the meter is gone, which a mean of the readings before would hide
# Channels that carry everything the module draws, by NVIDIA's rail names: Orin and Xavier NX; Nano.
_INPUT_RAILS = ("VDD_IN", "POM_5V_IN")
_ONE_CHANNEL = ("ina219", "ina220", "ina226", "ina230", "ina231", "ina260")


class MeterError(EdgevprError):
    """A power meter cannot be read, or gives an impossible value."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Meter:
    """A power meter. `look` returns watts; calling it more often than every `period_s` seconds is no use. `certain` is
    False if `title` contains an assumption, such as how the meter is wired."""

    title: str
    period_s: float
    look: Callable[[], float]
    certain: bool = True

    def read_w(self) -> float:
        """Read the power in watts. Raises MeterError if that fails or the value is impossible."""
        watts = self.look()
        if not 0 <= watts < _ABSURD_W:
            raise MeterError(f"{self.title} says {watts:g} W, which cannot be: check its wiring and its driver.")
        return watts


def find_meters(root: Path = Path("/")) -> tuple[Meter, ...]:
    """Find the power meters at the input of this machine. `root` is the root of the file system with /proc and /sys."""
    return (*_ina_meters(root), *_pmic_meters(root))


def mean_power(
    meter: Meter,
    window_s: float,
    clock: Callable[[], float] = time.monotonic,
    sleep: Callable[[float], None] = time.sleep,
) -> float:
    """Read `meter` every `meter.period_s` for `window_s` seconds and return the mean in watts, by the trapezoidal rule.

    A reading that fails is left out, and the readings before and after it are joined. Raises MeterError if three fail
    in a row, if fewer than two succeed, or if more than half fail. Short windows are unreliable: one study needed
    readings at 350 Hz. So let the same work run for many seconds.
    """
    start_s = clock()
    steps = max(1, round(window_s / meter.period_s))  # at least two readings, the last one at the very end
    times_s: list[float] = []
    watts: list[float] = []
    skipped = failed_in_a_row = 0
    for step in range(steps + 1):
        sleep(max(0.0, start_s + window_s * step / steps - clock()))
        before_s = clock()
        try:
            watts.append(meter.read_w())
        except MeterError as error:
            skipped, failed_in_a_row = skipped + 1, failed_in_a_row + 1
            if failed_in_a_row == _MOST_FAILURES:
                raise MeterError(
                    f"{meter.title} failed {_MOST_FAILURES} times in a row; the last time: {error}"
                ) from None
        else:
            times_s.append((before_s + clock()) / 2)
            failed_in_a_row = 0
    if len(watts) < 2 or skipped > len(watts) or times_s[-1] <= times_s[0]:
        raise MeterError(
            f"{meter.title} gave {len(watts)} usable readings in {window_s:g} s and failed {skipped} times: measure "
            "for longer, or check its wiring."
        )
    return float(np.trapezoid(watts, times_s)) / (times_s[-1] - times_s[0])


def _ina_meters(root: Path) -> Iterator[Meter]:
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


def _ina_channel(folder: Path, channel: int, title: str, certain: bool = True) -> Meter:
    power = folder / f"power{channel}_input"

    def look() -> float:
        if power.exists():
            return _number(power) / 1e6
        # An INA3221 reports volts and amperes only. A small negative current (-1 mA at no load) is its offset: zero.
        current_ma = _number(folder / f"curr{channel}_input")
        return _number(folder / f"in{channel}_input") * (0.0 if -5 < current_ma < 0 else current_ma) / 1e6

    return Meter(title=title, period_s=0.05, look=look, certain=certain)


def _pmic_meters(root: Path) -> Iterator[Meter]:
    program = machine.vcgencmd(root)
    if program and re.search(r"Raspberry Pi (5|Compute Module 5)", machine.model(root) or ""):
        yield Meter(
            title="power chip of the Raspberry Pi 5 (sum of its rails, corrected; without USB devices)",
            period_s=0.5,  # a reading starts a process: more often would be a load of its own
            look=lambda: _pmic_w(program),
            certain=False,
        )


def _pmic_w(program: Path) -> float:
    """Return the watts at the board's input, computed from the volts and amperes of all rails that report both.

    The rails do not include the losses of converters. 1.1451 x + 0.5879 W, x being the sum over the rails, is the
    public fit to a meter in the supply (project jfikar/RPi5-power).
    """
    try:
        done = subprocess.run([program, "pmic_read_adc"], capture_output=True, timeout=2, check=True)
    except (OSError, subprocess.SubprocessError) as error:
        raise MeterError(
            f"The power chip cannot be read with vcgencmd ({error}): see that your user is in the group video."
        ) from None
    answer = done.stdout.decode(errors="replace")
    rails: dict[str, dict[str, float]] = {"A": {}, "V": {}}
    for name, unit, value in re.findall(r"(\w+)_([AV])\b[^=\n]*=\s*(-?[0-9.]+)[AV]\s*$", answer, re.MULTILINE):
        rails[unit][name] = _parsed(value, f"{program} pmic_read_adc, {name}")
    both = rails["A"].keys() & rails["V"].keys()
    if not both:
        raise MeterError(f"{program} pmic_read_adc lists no rail with volts and amperes: this firmware cannot be used.")
    return 1.1451 * sum(rails["A"][name] * rails["V"][name] for name in both) + 0.5879


def _number(path: Path) -> float:
    try:
        return _parsed(path.read_text(errors="replace"), str(path))
    except OSError as error:
        raise MeterError(f"{path} cannot be read ({error.strerror}): the power meter is gone.") from None


def _parsed(text: str, where: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not abs(value) < float("inf"):
        raise MeterError(f"{where} says {text.strip()[:40]!r}, which is no number: the power meter does not work.")
    return value
