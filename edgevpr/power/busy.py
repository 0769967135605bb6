"""Keeping the machine busy to a given share, and measuring how busy it is: the tools to calibrate its power."""

import os
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

PERIOD_S = 0.1  # of the duty cycle: short beside a power meter's window, long beside one product


@contextmanager
def load(share: float, threads: int | None = None) -> Iterator[None]:
    """Hold all usable cores at `share` (0..1) while the block runs, with one thread a core.

    Each thread multiplies small float32 matrices, as cohog's matching does; NumPy lets the other threads run meanwhile.
    Threads start their periods at different times, so that the sum is level. Give NumPy's library one thread
    (OPENBLAS_NUM_THREADS, which edgevpr's command line sets); `utilisation` tells which share was really reached.
    """
    stop = threading.Event()
    count = threads or len(os.sched_getaffinity(0))

    def run(first_s: float) -> None:
        work = _product()
        stop.wait(first_s)
        while not stop.is_set():
            stop.wait(duty(share, work))

    workers = [threading.Thread(target=run, args=(PERIOD_S * n / count,), daemon=True) for n in range(count)]
    if share > 0:
        for worker in workers:
            worker.start()
    try:
        yield
    finally:
        stop.set()
        for worker in workers:
            if worker.ident:
                worker.join()


def duty(share: float, work: Callable[[], object], clock: Callable[[], float] = time.perf_counter) -> float:
    """Work for `share` of one period, in whole calls of `work`, and return the seconds to rest (0 at full load). The
    ratio of work to rest is as asked, however long the last call took."""
    start_s = clock()
    if share <= 0:
        return PERIOD_S
    while clock() - start_s < share * PERIOD_S:
        work()
    return max(0.0, (clock() - start_s) * (1 - share) / share)


def _product() -> Callable[[], object]:
    left, right = np.ones((256, 32), np.float32), np.ones((32, 256), np.float32)
    out = np.empty((256, 256), np.float32)
    return lambda: np.matmul(left, right, out=out)


def cpu_times(root: Path = Path("/")) -> tuple[float, float]:
    """Return (busy, all) ticks of all cores since start, every process counted. A tick is some 10 ms: look seconds
    apart.

    Guest time is left out: it is part of user time already.
    """
    words = (root / "proc/stat").read_text().split("\n", 1)[0].split()
    ticks = [float(word) for word in words[1:9]]
    waiting = sum(ticks[3:5])  # idle, and idle with a disk at work
    return sum(ticks) - waiting, sum(ticks)


def utilisation(before: tuple[float, float], after: tuple[float, float]) -> float:
    """Return U of equation 5.1 between two results of `cpu_times`: the busy share of all cores, 0..1."""
    busy, passed = after[0] - before[0], after[1] - before[1]
    return min(1.0, max(0.0, busy / passed)) if passed > 0 else 0.0
