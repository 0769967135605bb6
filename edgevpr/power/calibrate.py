"""Power meters at a board's input, INA chips (hwmon) of Jetsons and add-on boards, and the calibration of a board's
power model with them: the constants a and s of equation 5.2.

A meter returns a number, or raises MeterError with a sentence: a missing file, text, a negative or an absurd value is
never passed on as a figure. Sensors of a part of the board (RAPL: the processor alone; the other rails of a Jetson) are
not used, since a profile's watts are those at the board's input.

The machine is held at several loads. A line P = a + s U is fitted to the points (utilisation U, watts) for its profile.
"""

import os
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import psutil

from edgevpr.core.errors import EdgevprError
from edgevpr.power import machine
from edgevpr.power.boards import Board

NO_METER = (
    "This machine has no power meter at its input that edgevpr knows (an INA219, INA226 or INA3221 in "
    "/sys/class/hwmon): write its watts into a profile by hand, from a meter in its supply."
)
_ABSURD_W = 1000.0  # no companion computer draws this: the reading is wrong (also the bound of `full_w` in a profile)
_PERIOD_S = 0.05  # between two readings
# Channels that carry everything the module draws, by NVIDIA's rail names: Orin and Xavier NX; Nano.
_INPUT_RAILS = ("VDD_IN", "POM_5V_IN")
_ONE_CHANNEL = ("ina219", "ina220", "ina226", "ina230", "ina231", "ina260")
LOADS = (0.0, 0.25, 0.5, 0.75, 1.0)
DUTY_PERIOD_S = 0.1  # short compared with a power meter's window, long compared with one product
_SETTLE_S, _WINDOW_S = 5.0, 20.0
_LEAST_LOADS = 3  # any two points lie on a line; a third shows whether power follows it
_SAME_LOAD = 0.05  # utilisations closer than this count as one load
_LEAST_R2 = 0.5  # below it, the load explains less than half of the changes of power


class MeterError(EdgevprError):
    """A power meter cannot be read, or gives an impossible value."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Meter:
    """A power meter. The function `look` reads it, in watts. `certain` is False if `title` contains an assumption, such
    as how the meter is wired."""

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


@dataclass(frozen=True, slots=True, kw_only=True)
class PowerFit:
    """Straight line P = `idle_w` + `span_w` U (a and s of the thesis; U: utilisation, 0..1), fitted to the points
    `samples` (U, W). `residual_w`: root mean square of the residuals. `r2`: coefficient of determination."""

    idle_w: float
    span_w: float
    residual_w: float
    r2: float
    samples: tuple[tuple[float, float], ...]

    @property
    def full_w(self) -> float:
        """Watts with every core busy: `full_w` of a profile."""
        return self.idle_w + self.span_w

    def applied_to(self, board: Board, meter: Meter) -> Board:
        """Return a copy of `board` with this power. It is marked as verified if the wiring of `meter` is certain."""
        source = (
            f"straight line through {len(self.samples)} loads measured on this machine with its {meter.title}; "
            f"residual {self.residual_w:.2g} W, R2 {self.r2:.3f}"
        )
        return replace(board, idle_w=self.idle_w, full_w=self.full_w, verified=meter.certain, source=source)


def calibrate(meter: Meter, progress: Callable[[float], None]) -> PowerFit:
    """Hold each load of `LOADS` for 25 s, measure the power, and fit a line. `progress` is called with each load (0..1)
    before it is held. Raises MeterError if the meter fails, or if no board can have such a line."""
    samples = []
    for share in LOADS:
        progress(share)
        samples.append(measure_at(meter, share))
    return fit_power(samples)


def measure_at(
    meter: Meter, share: float, settle_s: float = _SETTLE_S, window_s: float = _WINDOW_S
) -> tuple[float, float]:
    """Hold the load `share` (0..1), let the meter settle for `settle_s` seconds, and measure for `window_s` seconds.
    Returns the utilisation of the whole machine, 0..1, including other programs, since the meter measures them too, and
    the mean power in watts. Raises MeterError."""
    with hold_load(share):
        time.sleep(settle_s)
        psutil.cpu_percent()  # starts the interval of the next call
        mean_w = mean_power(meter, window_s)
        return psutil.cpu_percent() / 100, mean_w


def fit_power(samples: Sequence[tuple[float, float]]) -> PowerFit:
    """Fit W = a + s U by least squares to `samples` (U, W), U in 0..1. Raises MeterError if no board can have this
    line."""
    u, watts = np.array(samples, np.float64).reshape(-1, 2).T
    distinct = len(set(np.round(u / _SAME_LOAD)))
    if distinct < _LEAST_LOADS:
        raise MeterError(
            f"Power was measured at {distinct} different loads; a line needs {_LEAST_LOADS}: stop other programs, and "
            "let this one use all cores."
        )
    (idle_w, span_w), *_ = np.linalg.lstsq(np.column_stack([np.ones_like(u), u]), watts, rcond=None)
    residuals = watts - (idle_w + span_w * u)
    spread = float(((watts - watts.mean()) ** 2).sum())
    r2 = 1.0 - float((residuals**2).sum()) / spread if spread > 0 else 0.0
    if idle_w < -1e-9 or span_w <= 0 or r2 < _LEAST_R2:
        raise MeterError(
            f"The measured power is of no board: {idle_w:.3g} W idle, {span_w:.3g} W more at full load, R2 {r2:.2f}: "
            "see that the meter is wired to what feeds the CPU, and measure again."
        )
    return PowerFit(
        idle_w=max(0.0, float(idle_w)),
        span_w=float(span_w),
        residual_w=float(np.sqrt((residuals**2).mean())),
        r2=r2,
        samples=tuple((float(a), float(b)) for a, b in samples),
    )


@contextmanager
def hold_load(share: float) -> Iterator[None]:
    """Hold all usable cores at `share` (0..1) while the block of the `with` statement runs, with one thread per core.

    Each thread multiplies small float32 matrices, as cohog's matching does; NumPy lets the other threads run meanwhile.
    The threads start their periods at different times, so that the total load is steady. NumPy's library must have one
    thread (OPENBLAS_NUM_THREADS=1, set by edgevpr's command line). `measure_at` returns the load really reached.
    """
    stop = threading.Event()
    count = len(os.sched_getaffinity(0)) if share > 0 else 0

    def run(first_s: float) -> None:
        left, right = np.ones((256, 32), np.float32), np.ones((32, 256), np.float32)
        product = np.empty((256, 256), np.float32)
        stop.wait(first_s)
        while not stop.is_set():
            stop.wait(work_a_period(share, lambda: np.matmul(left, right, out=product)))

    with ThreadPoolExecutor(max(1, count)) as pool:
        for number in range(count):
            pool.submit(run, DUTY_PERIOD_S * number / count)
        try:
            yield
        finally:
            stop.set()


def work_a_period(share: float, work: Callable[[], object], clock: Callable[[], float] = time.perf_counter) -> float:
    """Call `work` again and again for `share` (above 0, up to 1) of one duty period. Returns the seconds to rest
    afterwards (0 at full load). If the last call took longer, the rest is longer too, so that the load stays
    `share`."""
    start_s = clock()
    while clock() - start_s < share * DUTY_PERIOD_S:
        work()
    return max(0.0, (clock() - start_s) * (1 - share) / share)


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
