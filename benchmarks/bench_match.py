"""Comparing one place in full: edgevpr's `cohog` with the displacement vote, the published way without it
(competitor.py), and the bare float32 product of the same size.

The three take turns over the same references on one thread; ratios are taken turn by turn. Each reference is another
picture, as in a map: the published way reads 246 KB a reference, edgevpr 31 KB.
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before NumPy is imported

import sys
from dataclasses import dataclass

import competitor
import cv2
import numpy as np
from bench_encode import frames, timed_s

from edgevpr.techniques import create


@dataclass(frozen=True, slots=True)
class MatchRow:
    """Medians over all turns, a reference; `ratio` is the published way's time over ours."""

    references: int
    ours_ms: float
    competitor_ms: float
    ratio: float
    product_ms: float
    times_product: float


def row(turns: int = 15, references: int = 60) -> MatchRow:
    """Time one query against `references` pictures, `turns` times."""
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    technique = create("cohog")
    pictures = frames()
    # Shifted copies stand in where there are too few pictures: the time does not depend on what they show.
    places = [technique.encode(np.roll(pictures[at % len(pictures)], at)) for at in range(references)]
    query = technique.encode(pictures[0])
    asking = query.regions[query.good]
    exact = [place.regions.astype(np.float64) for place in places]
    single = [place.regions for place in places]
    stored = [place.fine for place in places]

    def bare_products(_: None) -> None:
        for reference in single:
            asking @ reference.T

    ways = (
        lambda _: [technique.match(query, fine, None) for fine in stored],
        lambda _: competitor.match(query.regions.astype(np.float64), query.good, exact),
        bare_products,
    )
    times_s = np.array([[timed_s(way, None) / references for way in ways] for _ in range(turns)])
    cv2.setNumThreads(threads)
    ours_s, theirs_s, product_s = times_s.T
    ours_ms, competitor_ms, product_ms = 1000 * np.median(times_s, axis=0)
    return MatchRow(
        references,
        float(ours_ms),
        float(competitor_ms),
        float(np.median(theirs_s / ours_s)),
        float(product_ms),
        float(np.median(ours_s / product_s)),
    )


def table(result: MatchRow) -> str:
    """The result as a Markdown table."""
    return (
        "| compare one place | edgevpr with vote ms | published way, no vote, ms | ratio | bare product ms "
        "| times the product |\n|---|---|---|---|---|---|\n"
        f"| {result.references} references | {result.ours_ms:.2f} | {result.competitor_ms:.2f} | {result.ratio:.2f} "
        f"| {result.product_ms:.2f} | {result.times_product:.2f} |"
    )


if __name__ == "__main__":
    print(table(row(int(sys.argv[1]) if len(sys.argv) > 1 else 15)))
