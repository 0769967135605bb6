"""Speed of this machine at edgevpr's work, relative to the machine that `profiles/generic-x86.yaml` names.

Two figures are kept apart, because they do not scale alike: matrix products (cohog's matching) depend on wide vector
units, passes over bytes (encoding an image, scanning a map) do not. A small ARM core loses far more at the first.
"""

import math
import os
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

# Rounds a second of one core of the reference, an AMD EPYC (Zen 4) in a virtual machine, by `_rate` below with
# OPENBLAS_NUM_THREADS=1, Python 3.11 and NumPy 2.4 (OpenBLAS 0.3.31).
REFERENCE_PRODUCTS_HZ = 1585.0
REFERENCE_PASSES_HZ = 1960.0

_LEAST_S = 0.4  # of each of the four measurements
_LEAST_ROUNDS = 5


@dataclass(frozen=True, slots=True)
class Speed:
    """Relative speed, 1 for one core of the reference. One thread: `products`, `passes`, and `single`, their geometric
    mean; `multi` is that mean for all usable cores together."""

    single: float
    multi: float
    products: float
    passes: float


def score() -> Speed:
    """Measure the speed, in about two seconds (a slow board: some more). The machine should have nothing else to do.

    NumPy's library must have one thread (OPENBLAS_NUM_THREADS=1, which edgevpr's command line sets before NumPy is
    imported). Then one thread is one core, and all cores are loaded by as many threads of our own.
    """
    cores = len(os.sched_getaffinity(0))
    products = _rate(product_round()) / REFERENCE_PRODUCTS_HZ
    passes = _rate(pass_round()) / REFERENCE_PASSES_HZ
    all_products = _rate_together(product_round, cores) / REFERENCE_PRODUCTS_HZ
    all_passes = _rate_together(pass_round, cores) / REFERENCE_PASSES_HZ
    return Speed(math.sqrt(products * passes), math.sqrt(all_products * all_passes), products, passes)


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


def _rate(work: Callable[[], object]) -> float:
    """Return the rounds a second of one thread, by its quickest round: disturbances of other rounds are not the
    machine's speed."""
    work()
    quickest_s, rounds, start_s = math.inf, 0, time.perf_counter()
    while rounds < _LEAST_ROUNDS or time.perf_counter() - start_s < _LEAST_S:
        before_s = time.perf_counter()
        work()
        quickest_s = min(quickest_s, time.perf_counter() - before_s)
        rounds += 1
    return 1 / quickest_s


def _rate_together(make: Callable[[], Callable[[], object]], threads: int) -> float:
    """Return the rounds a second of `threads` threads at once, in all; NumPy lets them run in parallel."""
    start, rates = threading.Barrier(threads), [0.0] * threads

    def run(thread: int) -> None:
        work = make()
        work()
        start.wait()
        rounds, start_s = 0, time.perf_counter()
        while rounds < _LEAST_ROUNDS or time.perf_counter() - start_s < _LEAST_S:
            work()
            rounds += 1
        rates[thread] = rounds / (time.perf_counter() - start_s)

    workers = [threading.Thread(target=run, args=(thread,)) for thread in range(threads)]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()
    return sum(rates)
