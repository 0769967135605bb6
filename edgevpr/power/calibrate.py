"""The profile of this machine with measured speed and, by the power meter at a Jetson's input, an INA3221 (hwmon),
measured idle and full watts: P_i and P_b of equation 5.1.

Sensors of a part of the board (RAPL: the processor alone; the other rails of a Jetson) are not used, since a profile's
watts are those at the board's input; nor chips that nothing says the wiring of.
"""

import os
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import fmean

import numpy as np
import psutil

from edgevpr.core.errors import EdgevprError, UsageError
from edgevpr.core.files import require_folder, write_whole
from edgevpr.power import machine
from edgevpr.power.boards import Board, own_profile, profile_text
from edgevpr.power.speed import micro_benchmark

NO_METER = (
    "This machine has no power meter at its input that edgevpr knows (the INA3221 of a Jetson, in /sys/class/hwmon): "
    "write its watts into the profile by hand, from a meter in its supply."
)
_MAX_W = 1000.0  # no companion computer draws this: the reading is wrong (also the bound of `full_w` in a profile)
_PERIOD_S = 0.05  # between two readings
# Channels that carry everything the module draws, by NVIDIA's rail names: Orin and Xavier NX; Nano.
_INPUT_RAILS = ("VDD_IN", "POM_5V_IN")
_MIN_SPAN = 0.3  # between the utilisations of the two loads


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
        """Read the power in watts. Raises MeterError if that fails or the value is impossible: such a value is never
        passed on as a figure."""
        files = (self.folder / f"{kind}{self.channel}_input" for kind in ("in", "curr"))
        try:
            voltage_mv, current_ma = (float(file.read_text()) for file in files)
        except (OSError, ValueError) as error:
            raise MeterError(f"{self.title} cannot be read ({error}): the power meter is gone or broken.") from None
        # A small negative current (-1 mA at no load) is the chip's offset: zero.
        watts = voltage_mv * (0.0 if -5 < current_ma < 0 else current_ma) / 1e6
        if not 0 <= watts < _MAX_W:
            raise MeterError(f"{self.title} says {watts:g} W, which cannot be: check its wiring and its driver.")
        return watts


def find_meter(root: Path = Path("/")) -> Meter | None:
    """Find the power meter at the input of this machine (None: it has none). `root` is the root of the file system."""
    for folder in sorted((root / "sys/class/hwmon").glob("hwmon*")):
        for channel in (1, 2, 3) if machine.text(folder / "name") == "ina3221" else ():  # in4 to in7 are shunt voltages
            label = machine.text(folder / f"in{channel}_label")
            if label in _INPUT_RAILS and machine.text(folder / f"in{channel}_enable") != "0":
                return Meter(folder, channel, label)
    return None


def write_profile(path: Path) -> str:
    """Measure this machine and write its profile to a new file, completely or not at all: the speed by the
    micro-benchmark (two seconds), the power by the machine's meter, if it has one (a minute). Returns a sentence on
    the power.

    Raises UsageError before the work if the name does not end in .yaml, the folder does not exist, or the file exists
    already; MeterError for a meter that fails.
    """
    if path.suffix not in (".yaml", ".yml"):
        raise UsageError(f"{path}: a profile's name ends in .yaml: choose such a name.")
    require_folder(path)
    if path.exists():
        raise UsageError(f"{path} is there already: move it away, or choose another name.")
    board, power = own_profile(micro_benchmark()), NO_METER
    if meter := find_meter():
        board = calibrate(board, meter)
        power = f"Power: {board.idle_w:.3g} W idle, {board.full_w:.3g} W with every core busy: {board.source}."
    write_whole(path, lambda unfinished: unfinished.write_text(profile_text(board), "utf-8"))
    return power


def calibrate(board: Board, meter: Meter) -> Board:
    """Measure the power of this machine when idle and with all cores busy, 25 s each, and return a copy of `board` with
    it. The utilisations are those of the whole machine: the meter measures other programs too. Raises MeterError if the
    meter fails, or if no board can have such figures."""
    points = []
    for load in (0.0, 1.0):
        print(f"measuring power with the {meter.title}: load {load:.0%}", file=sys.stderr)
        points.append(measure_load(meter, load))
    (low_u, low_w), (high_u, high_w) = points
    if high_u - low_u < _MIN_SPAN:
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


def measure_load(meter: Meter, load: float, settle_s: float = 5.0, window_s: float = 20.0) -> tuple[float, float]:
    """Hold the `load` (0 or 1), let the meter settle for `settle_s` seconds, and measure for `window_s` seconds: short
    windows are unreliable. Returns the utilisation of the whole machine, 0..1, and the mean power in watts.

    For a load of 1 each usable core has a thread that multiplies small float32 matrices, as cohog's matching does;
    NumPy lets the other threads run meanwhile. NumPy's library must have one thread (OPENBLAS_NUM_THREADS=1, set by
    edgevpr's command line).
    """
    stop, count = threading.Event(), len(os.sched_getaffinity(0)) if load else 0

    def multiply() -> None:
        left, right = np.ones((256, 32), np.float32), np.ones((32, 256), np.float32)
        while not stop.is_set():
            np.matmul(left, right)

    with ThreadPoolExecutor(max(1, count)) as pool:
        try:
            for _ in range(count):
                pool.submit(multiply)
            time.sleep(settle_s)
            psutil.cpu_percent()  # starts the interval of the next call
            until_s, watts = time.monotonic() + window_s, [meter.read_w()]
            while time.monotonic() < until_s:
                time.sleep(_PERIOD_S)
                watts.append(meter.read_w())
            return psutil.cpu_percent() / 100, fmean(watts)
        finally:
            stop.set()
