"""The two constants of a board's power, a and s of equation 5.2, from its own power meter.

The machine is held at several loads; the straight line P = a + s U through (U, W) is the board's profile.
"""

import os
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np
import psutil

from edgevpr.power.boards import Board
from edgevpr.power.sensors import Meter, MeterError, mean_power

LOADS = (0.0, 0.25, 0.5, 0.75, 1.0)
DUTY_PERIOD_S = 0.1  # short beside a power meter's window, long beside one product
_SETTLE_S, _WINDOW_S = 5.0, 20.0
_LEAST_LOADS = 3  # any two loads lie on a line: the third shows whether power follows one
_SAME_LOAD = 0.05  # utilisations nearer than this are one load
_LEAST_R2 = 0.5  # below it, most changes of the power do not follow the load


@dataclass(frozen=True, slots=True, kw_only=True)
class PowerFit:
    """Straight line P = `idle_w` + `span_w` U (a and s), with the root mean square of its residuals in watts, and R2;
    `samples` are its points (U, W)."""

    idle_w: float
    span_w: float
    residual_w: float
    r2: float
    samples: tuple[tuple[float, float], ...]

    @property
    def full_w(self) -> float:
        """Watts with every core busy, as a profile wants them."""
        return self.idle_w + self.span_w

    def applied_to(self, board: Board, meter: Meter) -> Board:
        """Return a board with these watts. They are verified where nobody had to assume how the meter is wired."""
        source = (
            f"straight line through {len(self.samples)} loads measured on this machine with its {meter.title}; "
            f"residual {self.residual_w:.2g} W, R2 {self.r2:.3f}"
        )
        return replace(board, idle_w=self.idle_w, full_w=self.full_w, verified=meter.certain, source=source)


def calibrate(meter: Meter, progress: Callable[[float], None]) -> PowerFit:
    """Hold each of `LOADS` for some seconds and fit a line. Raises MeterError for a meter that fails and for figures
    that no board can have. `progress` is called with each load before it is held."""
    samples = []
    for share in LOADS:
        progress(share)
        samples.append(measure_at(meter, share))
    return fit_power(samples)


def measure_at(
    meter: Meter, share: float, settle_s: float = _SETTLE_S, window_s: float = _WINDOW_S
) -> tuple[float, float]:
    """Hold a load and measure, once the meter has settled.

    Returns the utilisation of the whole machine (0..1), other programs included, since the meter measures them too, and
    the mean power in watts. Raises MeterError.
    """
    with hold_load(share):
        time.sleep(settle_s)
        psutil.cpu_percent()  # from here on
        mean_w = mean_power(meter, window_s)
        return psutil.cpu_percent() / 100, mean_w


def fit_power(samples: Sequence[tuple[float, float]]) -> PowerFit:
    """Fit W = a + s U by least squares to samples (U, W), U in 0..1. Raises MeterError where the result cannot be a
    board's."""
    u, watts = np.array(samples, np.float64).reshape(-1, 2).T
    if not (np.isfinite(u).all() and np.isfinite(watts).all()):
        raise MeterError("A power measurement is not a number: measure again.")
    distinct = len(set(np.round(u / _SAME_LOAD)))
    if distinct < _LEAST_LOADS:
        raise MeterError(
            f"Power was measured at {distinct} different loads; a line needs {_LEAST_LOADS}: stop other programs, and "
            "let this one use all cores."
        )
    (idle_w, span_w), *_ = np.linalg.lstsq(np.column_stack([np.ones_like(u), u]), watts, rcond=None)
    if idle_w < -1e-9:
        raise MeterError(
            f"The measured power would be {idle_w:.3g} W at idle, which cannot be: check the meter's wiring, and "
            "measure for longer."
        )
    residuals = watts - (idle_w + span_w * u)
    spread = float(((watts - watts.mean()) ** 2).sum())
    r2 = 1.0 - float((residuals**2).sum()) / spread if spread > 0 else 0.0
    if span_w <= 0 or r2 < _LEAST_R2:
        raise MeterError(
            f"The measured power does not follow the load ({span_w:.3g} W from idle to full, R2 {r2:.2f}): see that "
            "the meter is wired to what feeds the CPU, and measure for longer."
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
    """Hold all usable cores at `share` (0..1) while the block runs, with one thread a core.

    Each thread multiplies small float32 matrices, as cohog's matching does; NumPy lets the other threads run meanwhile.
    Threads start their periods at different times, so that the sum is level. Give NumPy's library one thread
    (OPENBLAS_NUM_THREADS, which edgevpr's command line sets); `measure_at` tells which share was really reached.
    """
    stop = threading.Event()
    count = len(os.sched_getaffinity(0)) if share > 0 else 0

    def run(first_s: float) -> None:
        left, right = np.ones((256, 32), np.float32), np.ones((32, 256), np.float32)
        product = np.empty((256, 256), np.float32)
        stop.wait(first_s)
        while not stop.is_set():
            stop.wait(work_a_period(share, lambda: np.matmul(left, right, out=product)))

    workers = [threading.Thread(target=run, args=(DUTY_PERIOD_S * n / count,), daemon=True) for n in range(count)]
    for worker in workers:
        worker.start()
    try:
        yield
    finally:
        stop.set()
        for worker in workers:
            worker.join()


def work_a_period(share: float, work: Callable[[], object], clock: Callable[[], float] = time.perf_counter) -> float:
    """Work for `share` of one period, in whole calls of `work`, and return the seconds to rest (0 at full load). The
    ratio of work to rest is as asked, however long the last call took."""
    start_s = clock()
    while clock() - start_s < share * DUTY_PERIOD_S:
        work()
    return max(0.0, (clock() - start_s) * (1 - share) / share)
