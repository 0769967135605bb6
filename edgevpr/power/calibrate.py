"""The power meter at a Jetson's input, an INA3221 (hwmon), and the measurement of a board's idle and full watts by it:
P_i and P_b of equation 5.1.

A meter returns a number, or raises MeterError with a sentence: a missing file, text, a negative or an absurd value is
never passed on as a figure. Sensors of a part of the board (RAPL: the processor alone; the other rails of a Jetson) are
not used, since a profile's watts are those at the board's input; nor chips that nothing says the wiring of.
"""

import os
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import fmean

import numpy as np
import psutil

from edgevpr.core.errors import EdgevprError
from edgevpr.power import machine
from edgevpr.power.boards import Board

NO_METER = (
    "This machine has no power meter at its input that edgevpr knows (the INA3221 of a Jetson, in /sys/class/hwmon): "
    "write its watts into the profile by hand, from a meter in its supply."
)
_ABSURD_W = 1000.0  # no companion computer draws this: the reading is wrong (also the bound of `full_w` in a profile)
_PERIOD_S = 0.05  # between two readings
# Channels that carry everything the module draws, by NVIDIA's rail names: Orin and Xavier NX; Nano.
_INPUT_RAILS = ("VDD_IN", "POM_5V_IN")
_LEAST_APART = 0.3  # utilisations of the two loads


class MeterError(EdgevprError):
    """A power meter cannot be read, or gives an impossible value."""


@dataclass(frozen=True, slots=True)
class Meter:
    """The channel of an INA3221 that measures the input of a board, with its `folder` in /sys and its `label`."""

    folder: Path
    channel: int
    label: str

    @property
    def title(self) -> str:
        return f"INA3221 ({self.folder.name}), channel {self.label}"

    def read_w(self) -> float:
        """Read the power in watts. Raises MeterError if that fails or the value is impossible."""
        files = (self.folder / f"{what}{self.channel}_input" for what in ("in", "curr"))
        try:
            mv, current_ma = (float(file.read_text()) for file in files)
        except (OSError, ValueError) as error:
            raise MeterError(f"{self.title} cannot be read ({error}): the power meter is gone or broken.") from None
        # A small negative current (-1 mA at no load) is the chip's offset: zero.
        watts = mv * (0.0 if -5 < current_ma < 0 else current_ma) / 1e6
        if not 0 <= watts < _ABSURD_W:
            raise MeterError(f"{self.title} says {watts:g} W, which cannot be: check its wiring and its driver.")
        return watts


def find_meters(root: Path = Path("/")) -> Iterator[Meter]:
    """Find the power meters at the input of this machine. `root` is the root of the file system with /sys."""
    for folder in sorted((root / "sys/class/hwmon").glob("hwmon*")):
        for channel in (1, 2, 3) if machine.text(folder / "name") == "ina3221" else ():  # in4 to in7 are shunt voltages
            label = machine.text(folder / f"in{channel}_label")
            if label in _INPUT_RAILS and machine.text(folder / f"in{channel}_enable") != "0":
                yield Meter(folder, channel, label)


def calibrate(board: Board, meter: Meter, progress: Callable[[float], None]) -> Board:
    """Measure the power of this machine when idle and with all cores busy, 25 s each, and return a copy of `board` with
    it. `progress` is called with each load (0 and 1) before it is held. The utilisations are those of the whole
    machine: the meter measures other programs too. Raises MeterError if the meter fails, or if no board can have such
    figures."""
    points = []
    for load in (0.0, 1.0):
        progress(load)
        points.append(measure_at(meter, load))
    (low_u, low_w), (high_u, high_w) = points
    if high_u - low_u < _LEAST_APART:
        raise MeterError(
            f"{low_u:.0%} of the machine was busy when idle, and {high_u:.0%} at full load: stop other programs, and "
            "let this one use all cores."
        )
    span_w = (high_w - low_w) / (high_u - low_u)
    idle_w = low_w - span_w * low_u
    if idle_w < 0 or span_w <= 0:
        raise MeterError(
            f"The measured power is of no board: {idle_w:.3g} W idle, {span_w:.3g} W more at full load: see that the "
            "meter is wired to what feeds the CPU, and measure again."
        )
    source = f"measured on this machine, idle and with all cores busy, with its {meter.title}"
    return replace(board, idle_w=idle_w, full_w=idle_w + span_w, verified=True, source=source)


def measure_at(meter: Meter, load: float, settle_s: float = 5.0, window_s: float = 20.0) -> tuple[float, float]:
    """Hold the `load` (0 or 1), let the meter settle for `settle_s` seconds, and measure for `window_s` seconds: short
    windows are unreliable. Returns the utilisation of the whole machine, 0..1, and the mean power in watts.

    For a load of 1 each usable core has a thread that multiplies small float32 matrices, as cohog's matching does;
    NumPy lets the other threads run meanwhile. NumPy's library must have one thread (OPENBLAS_NUM_THREADS=1, set by
    edgevpr's command line).
    """
    stop, count = threading.Event(), len(os.sched_getaffinity(0)) if load else 0

    def run() -> None:
        left, right = np.ones((256, 32), np.float32), np.ones((32, 256), np.float32)
        while not stop.is_set():
            np.matmul(left, right)

    with ThreadPoolExecutor(max(1, count)) as pool:
        try:
            for _ in range(count):
                pool.submit(run)
            time.sleep(settle_s)
            psutil.cpu_percent()  # starts the interval of the next call
            until_s, watts = time.monotonic() + window_s, [meter.read_w()]
            while time.monotonic() < until_s:
                time.sleep(_PERIOD_S)
                watts.append(meter.read_w())
            return psutil.cpu_percent() / 100, fmean(watts)
        finally:
            stop.set()
