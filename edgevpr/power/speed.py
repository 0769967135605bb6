"""Speed of this machine at edgevpr's work, relative to the machine that `profiles/generic-x86.yaml` names.

Two figures are kept apart, because they do not scale alike: matrix products (cohog's matching) depend on wide vector
units, passes over bytes (encoding an image, scanning a map) do not. A small ARM core loses far more at the first.
"""

import math
import os
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from threading import Barrier

import numpy as np

from edgevpr.power.boards import MachineSpeed

# Rounds a second of one core of the reference, an AMD EPYC (Zen 4) in a virtual machine, by `_round_times_s` below with
# OPENBLAS_NUM_THREADS=1, Python 3.11 and NumPy 2.4 (OpenBLAS 0.3.31).
REFERENCE_PRODUCTS_HZ = 1585.0
REFERENCE_PASSES_HZ = 1960.0

_LEAST_S = 0.4  # of each of the four measurements
_LEAST_ROUNDS = 5


def micro_benchmark() -> MachineSpeed:
    """Measure the speed, in about two seconds (a slow board: some more). The machine should have nothing else to do.

    NumPy's library must have one thread (OPENBLAS_NUM_THREADS=1, which edgevpr's command line sets before NumPy is
    imported). Then one thread is one core, and all cores are loaded by as many threads of our own. `single` and `multi`
    are the geometric means of both kinds of work.
    """
    cores = len(os.sched_getaffinity(0))
    products, all_products = (hz / REFERENCE_PRODUCTS_HZ for hz in _rates_hz(product_round, cores))
    passes, all_passes = (hz / REFERENCE_PASSES_HZ for hz in _rates_hz(pass_round, cores))
    figures = {
        "single": math.sqrt(products * passes),
        "multi": math.sqrt(all_products * all_passes),
        "products": products,
        "passes": passes,
    }
    rounded = {name: float(f"{value:.3g}") for name, value in figures.items()}
    source = "edgevpr's micro-benchmark, run on it; single and multi are means of both kinds"
    return MachineSpeed(**rounded, verified=True, source=source)


def product_round() -> Callable[[], object]:
    """Return a function that makes one float32 product of 961 x 32 by 32 x 961: the regions of a query with those of a
    place."""
    random = np.random.default_rng(1)
    query = random.random((961, 32), np.float32)
    place = random.random((961, 32), np.float32)
    out = np.empty((961, 961), np.float32)
    return lambda: np.matmul(query, place.T, out=out)


def pass_round() -> Callable[[], object]:
    """Return a function that makes gradient magnitudes of a 512 x 512 picture, and a scan of 4096 codes of 512 bits
    with two queries."""
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
    """Return the rounds a second of one thread, by its quickest round, since disturbances of other rounds are not the
    machine's speed; and those of `threads` threads at once, in all. NumPy lets them run in parallel."""
    alone_hz = 1 / min(_round_times_s(make(), Barrier(1)))
    start = Barrier(threads)
    with ThreadPoolExecutor(threads) as pool:
        together = list(pool.map(lambda work: _round_times_s(work, start), [make() for _ in range(threads)]))
    return alone_hz, sum(len(times_s) / sum(times_s) for times_s in together)


def _round_times_s(work: Callable[[], object], start: Barrier) -> list[float]:
    """Return how long each round took, after a first one that does not count and a wait for all to be ready."""
    work()
    start.wait()
    times_s: list[float] = []
    while len(times_s) < _LEAST_ROUNDS or sum(times_s) < _LEAST_S:
        before_s = time.perf_counter()
        work()
        times_s.append(time.perf_counter() - before_s)
    return times_s
