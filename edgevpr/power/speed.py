"""Micro-benchmark: speed of this machine relative to the reference machine of `profiles/generic-x86.yaml`.

Two figures are measured because machines differ in both: matrix products (cohog's matching) depend on wide vector
units; passes over bytes (encoding an image, scanning a map) do not. Small ARM cores are further behind in products.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

# Rounds per second of one core of the reference machine, an AMD EPYC (Zen 4) in a virtual machine. Measured with
# `_time_rounds_s`, OPENBLAS_NUM_THREADS=1, Python 3.11 and NumPy 2.4 (OpenBLAS 0.3.31).
REFERENCE_PRODUCTS_HZ = 1585.0
REFERENCE_PASSES_HZ = 1960.0

_MIN_TIME_S = 0.4  # of each of the two measurements
_MIN_ROUNDS = 5


@dataclass(frozen=True, slots=True)
class Speed:
    """Speed of one thread of a machine divided by that of another machine. `products`: in matrix products (networks,
    and full comparisons of candidates). `passes`: in passes over bytes (everything else)."""

    products: float
    passes: float


def run_micro_benchmark() -> Speed:
    """Measure the speed of this machine relative to the reference, in about a second (longer on a slow board). Nothing
    else should be running. NumPy's BLAS must use one thread (OPENBLAS_NUM_THREADS=1, which edgevpr's command line sets
    before NumPy is imported)."""
    return Speed(
        products=1 / min(_time_rounds_s(make_product_round())) / REFERENCE_PRODUCTS_HZ,
        passes=1 / min(_time_rounds_s(make_pass_round())) / REFERENCE_PASSES_HZ,
    )


def make_product_round() -> Callable[[], object]:
    """Return a function that computes one float32 product of 961 x 32 by 32 x 961, as used to compare the regions of a
    query with those of a place."""
    random = np.random.default_rng(1)
    query, place = random.random((2, 961, 32), np.float32)
    out = np.empty((961, 961), np.float32)
    return lambda: np.matmul(query, place.T, out=out)


def make_pass_round() -> Callable[[], object]:
    """Return a function that computes gradient magnitudes of a 512 x 512 picture, and scans 4096 codes of 512 bits for
    two queries."""
    random = np.random.default_rng(2)
    grey = random.integers(0, 256, (512, 512), np.uint8)
    codes = random.integers(0, 2**63, (4096, 8), np.uint64)
    queries = codes[:2].copy()

    def work() -> None:
        signed = grey.astype(np.int16)
        dx = signed[1:-1, 2:] - signed[1:-1, :-2]
        dy = signed[2:, 1:-1] - signed[:-2, 1:-1]
        np.sqrt(dx.astype(np.float32) ** 2 + dy.astype(np.float32) ** 2)
        for query in queries:
            np.bitwise_count(codes ^ query).sum(axis=1, dtype=np.uint16)

    return work


def _time_rounds_s(work: Callable[[], object]) -> list[float]:
    """Call `work` repeatedly and return the seconds of each call, after one call to warm up. Callers use the minimum,
    because slower rounds were disturbed by something else."""
    work()
    times_s: list[float] = []
    while len(times_s) < _MIN_ROUNDS or sum(times_s) < _MIN_TIME_S:
        before_s = time.perf_counter()
        work()
        times_s.append(time.perf_counter() - before_s)
    return times_s
