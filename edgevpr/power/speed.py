"""Micro-benchmark: speed of this machine relative to the reference machine of `profiles/generic-x86.yaml`.

Two figures are measured, because machines differ in them: matrix products (cohog's matching) depend on wide vector
units, passes over bytes (encoding an image, scanning a map) do not. Small ARM cores fall behind more at products.
"""

import math
import os
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from threading import Barrier

import numpy as np

from edgevpr.power.boards import MachineSpeed

# Rounds per second of one core of the reference machine, an AMD EPYC (Zen 4) in a virtual machine. Measured by
# `_round_times_s` with OPENBLAS_NUM_THREADS=1, Python 3.11 and NumPy 2.4 (OpenBLAS 0.3.31).
REFERENCE_PRODUCTS_HZ = 1585.0
REFERENCE_PASSES_HZ = 1960.0

_MIN_TIME_S = 0.4  # of each of the four measurements
_MIN_ROUNDS = 5


def micro_benchmark() -> MachineSpeed:
    """Measure the speed of this machine, in about two seconds (longer on a slow board). Nothing else should run.
    `single` (one thread) and `multi` (one a core) are the geometric means of the speeds at products and at passes.
    NumPy's library must have one thread (OPENBLAS_NUM_THREADS=1, which edgevpr's command line sets before NumPy is
    imported)."""
    cores = len(os.sched_getaffinity(0))
    products, all_products = (hz / REFERENCE_PRODUCTS_HZ for hz in _rates_hz(product_round, cores))
    passes, all_passes = (hz / REFERENCE_PASSES_HZ for hz in _rates_hz(pass_round, cores))
    figures = (math.sqrt(products * passes), math.sqrt(all_products * all_passes), products, passes)
    single, multi, products, passes = (float(f"{value:.3g}") for value in figures)
    source = "edgevpr's micro-benchmark, run on it; single and multi are means of both kinds"
    return MachineSpeed(single=single, multi=multi, products=products, passes=passes, verified=True, source=source)


def product_round() -> Callable[[], object]:
    """Return a function that computes one float32 product of 961 x 32 by 32 x 961, which compares the regions of a
    query with those of a place."""
    random = np.random.default_rng(1)
    query, place = random.random((2, 961, 32), np.float32)
    out = np.empty((961, 961), np.float32)
    return lambda: np.matmul(query, place.T, out=out)


def pass_round() -> Callable[[], object]:
    """Return a function that computes gradient magnitudes of a 512 x 512 picture, and scans 4096 codes of 512 bits for
    two queries."""
    random = np.random.default_rng(2)
    grey = random.integers(0, 256, (512, 512), np.uint8)
    codes = random.integers(0, 2**63, (4096, 8), np.uint64)
    queries = codes[:2].copy()

    def work() -> None:
        wide = grey.astype(np.int16)
        across = wide[1:-1, 2:] - wide[1:-1, :-2]
        down = wide[2:, 1:-1] - wide[:-2, 1:-1]
        np.sqrt(across.astype(np.float32) ** 2 + down.astype(np.float32) ** 2)
        for query in queries:
            np.bitwise_count(codes ^ query).sum(axis=1, dtype=np.uint16)

    return work


def _rates_hz(make: Callable[[], Callable[[], object]], threads: int) -> tuple[float, float]:
    """Return the calls of the work per second by one thread alone, and in total by `threads` threads at once, each with
    its own work from `make`."""
    alone_hz = 1 / min(_round_times_s(make(), Barrier(1)))  # a slower round was disturbed by something else
    start = Barrier(threads)
    with ThreadPoolExecutor(threads) as pool:
        together = list(pool.map(lambda work: _round_times_s(work, start), [make() for _ in range(threads)]))
    return alone_hz, sum(len(times_s) / sum(times_s) for times_s in together)


def _round_times_s(work: Callable[[], object], start: Barrier) -> list[float]:
    """Call `work` again and again, and return the seconds of each call. A first call is not counted; after it, this
    thread waits at the barrier `start` until all threads are ready."""
    work()
    start.wait()
    times_s: list[float] = []
    while len(times_s) < _MIN_ROUNDS or sum(times_s) < _MIN_TIME_S:
        before_s = time.perf_counter()
        work()
        times_s.append(time.perf_counter() - before_s)
    return times_s
