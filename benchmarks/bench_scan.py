"""How long the scans of the index take, one thread: binary vectors against the bandwidth of plain sums, and the place
codes of `cohog` as the map grows. `python benchmarks/bench_scan.py` prints both as tables.
"""

import os

for _library in ("OPENBLAS", "OMP", "MKL"):
    os.environ.setdefault(f"{_library}_NUM_THREADS", "1")  # before NumPy is imported

import time  # noqa: E402
from collections.abc import Callable  # noqa: E402

import numpy as np  # noqa: E402

from edgevpr.techniques import hamming, placecode, placewords  # noqa: E402


def medians_s(ways: dict[str, Callable[[], object]], rounds: int) -> dict[str, float]:
    """Median seconds of each way, run in turn so that a busy moment hits all of them; the first round only warms."""
    taken: dict[str, list[float]] = {name: [] for name in ways}
    for _ in range(rounds + 1):
        for name, way in ways.items():
            start = time.perf_counter()
            way()
            taken[name].append(time.perf_counter() - start)
    return {name: float(np.median(times[1:])) for name, times in taken.items()}


def binary_rows(places: int = 100_000, code_bytes: int = 64, rounds: int = 30) -> list[dict]:
    """The exact scan of binary vectors (multiples of 8 bytes), and sums of the same bytes: as they are, and as 64-bit
    words, which is the fastest that NumPy reads memory. `of_byte_sum` and `of_word_sum` are shares of them."""
    rng = np.random.default_rng(0)
    codes = rng.integers(0, 256, (places, code_bytes), dtype=np.uint8)
    query = codes[0].copy()
    ways = {
        "sum of bytes": codes.sum,
        "sum of 64-bit words": codes.view(np.uint64).sum,
        "hamming, numpy": lambda: hamming.hamming_numpy(query, codes),
    }
    if hamming.simsimd is not None:
        ways["hamming, simsimd"] = lambda: hamming.hamming_simd(query, codes)
    taken = medians_s(ways, rounds)
    return [
        {
            "what": name,
            "t_ms": 1e3 * t_s,
            "gb_per_s": codes.nbytes / t_s / 1e9,
            "of_byte_sum": taken["sum of bytes"] / t_s,
            "of_word_sum": taken["sum of 64-bit words"] / t_s,
        }
        for name, t_s in taken.items()
    ]


def growth_rows(places: tuple[int, ...] = (1_000, 3_000, 10_000, 30_000, 100_000)) -> list[dict]:
    """The scan as the map grows: place codes ahead, words looking down (24 rotations); the data of the plot. The
    query's own part does not grow, and stands apart as `t_query_ms`."""
    rng = np.random.default_rng(0)
    blocks = rng.random((31, 31, 32), dtype=np.float32)
    mean = rng.random((placecode.SIDE, placecode.SIDE, 8), dtype=np.float32)
    patterns = rng.normal(size=(700, 20)).astype(np.float32)
    numbers = np.sort(rng.permutation(31 * 31)[:700])

    def ask_ahead() -> np.ndarray:
        return placecode.hypotheses(*placecode.seen_grid(blocks, np.ones((31, 31), bool)), mean)

    def ask_down() -> placewords.Asked:
        asking = dict.fromkeys(range(6), (patterns, numbers))
        return placewords.of_query(placewords.load("ground_words"), asking, 6, (31, 31))

    def codes(count: int) -> np.ndarray:
        return rng.integers(0, 256, (count, placecode.SIDE**2), dtype=np.uint8)

    def words(count: int) -> np.ndarray:
        return rng.integers(0, 1024, (count, placewords.SIDE**2), dtype=np.uint16)

    rows = []
    for turns, ask, scan, made in (
        (1, ask_ahead, placecode.scan_ahead, codes),
        (24, ask_down, placewords.scan, words),
    ):
        asked = ask()
        for count in places:
            there = made(count)
            ways = {"query": ask, "scan": lambda there=there, asked=asked, scan=scan: scan(asked, there)}
            taken = medians_s(ways, rounds=max(1, min(20, 2_000_000 // (count * turns))))
            rows.append(
                {
                    "places": count,
                    "rotations": turns,
                    "place_bytes": there.nbytes // count,
                    "t_query_ms": 1e3 * taken["query"],
                    "t_scan_ms": 1e3 * taken["scan"],
                    "index_mb": there.nbytes / 1e6,
                }
            )
    return rows


def _print(rows: list[dict]) -> None:
    print("".join(f"{name:>22}" for name in rows[0]))
    for row in rows:
        print("".join(f"{value:>22.3f}" if isinstance(value, float) else f"{value:>22}" for value in row.values()))


if __name__ == "__main__":
    _print(binary_rows())
    print()
    _print(growth_rows())
