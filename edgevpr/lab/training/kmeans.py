"""k-means in NumPy, block by block: for ten thousand words from a hundred thousand descriptors."""

from collections.abc import Iterator

import numpy as np

_BLOCK_VALUES = 8_000_000  # distances held at once: 32 MB


def kmeans(points: np.ndarray, count: int, rounds: int, rng: np.random.Generator) -> Iterator[np.ndarray]:
    """Yield `count` centres, float32 (count, D), of `points` float32 (N, D), after each of `rounds` (Lloyd 1982).

    The centres start as points drawn at random. A centre to which no point belongs moves to one of the points that lie
    furthest from their centres. N must be at least `count`.
    """
    centres = points[np.sort(rng.choice(len(points), count, replace=False))].copy()
    for _ in range(rounds):
        nearest, distance = _assigned(points, centres)
        order = np.argsort(nearest, kind="stable")
        sizes = np.bincount(nearest, minlength=count)
        used = np.flatnonzero(sizes)
        starts = np.concatenate([[0], np.cumsum(sizes[used])[:-1]])
        # Sorted by centre, the points of one centre are neighbours, and `reduceat` can sum them.
        centres[used] = np.add.reduceat(points[order], starts, axis=0) / sizes[used, None]
        empty = np.flatnonzero(sizes == 0)
        centres[empty] = points[np.argsort(-distance, kind="stable")[: len(empty)]]
        yield centres


def _assigned(points: np.ndarray, centres: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Find the nearest centre of each point, int (N,), and the square of its distance, float32 (N,)."""
    nearest = np.empty(len(points), np.intp)
    distance = np.empty(len(points), np.float32)
    half_squares = 0.5 * np.einsum("kd,kd->k", centres, centres)
    rows = max(1, _BLOCK_VALUES // len(centres))
    for start in range(0, len(points), rows):
        block = points[start : start + rows]
        closeness = block @ centres.T
        closeness -= half_squares
        best = closeness.argmax(axis=1)
        nearest[start : start + rows] = best
        own = np.einsum("nd,nd->n", block, block)
        distance[start : start + rows] = own - 2 * closeness[np.arange(len(block)), best]
    return nearest, distance
