"""Which places stay in RAM when not all of a map fits: the map keeps its best ones, and the file keeps all."""

import heapq
import math

import numpy as np

from edgevpr.geodesy import metres


def best_places(
    lat_deg: np.ndarray,
    lon_deg: np.ndarray,
    quality: np.ndarray,
    capacity: int,
    numbers: np.ndarray | None = None,
) -> np.ndarray:
    """Choose `capacity` of the places (N,), given in the order they were mapped; returns their slots, in that order.

    `numbers` (N,) int, ascending, say how many places were mapped between these where some were given up before
    (None: none were): of two places without a position nothing else says how far apart they are.

    One place after another is given up: the one that is worth least beside its neighbours along the track that are
    still there. A place is worth its quality times the distance to the nearer of the two, so that gaps stay small
    and places that say much stay; age does not matter. The first and the last place are kept.
    """
    count = len(quality)
    if count <= capacity:
        return np.arange(count)
    before, after = list(range(-1, count - 1)), list(range(1, count + 1))
    kept = np.ones(count, bool)
    east_m, north_m = metres(lat_deg, lon_deg)
    # Where a position is unknown, places are taken to be as far apart as they usually are.
    number = (np.arange(count) if numbers is None else numbers).tolist()
    steps_m = np.hypot(np.diff(east_m), np.diff(north_m)) / np.diff(number)
    usual_m = (float(np.nanmedian(steps_m)) if np.isfinite(steps_m).any() else 0.0) or 1.0
    at_m = list(zip(east_m.tolist(), north_m.tolist(), strict=True))  # of Python's floats: the loop below is of scalars

    def apart_m(a: int, b: int) -> float:
        away_m = math.dist(at_m[a], at_m[b])
        return usual_m * (number[b] - number[a]) if math.isnan(away_m) else away_m

    def worth(at: int) -> float:
        if before[at] < 0 or after[at] >= count:
            return math.inf
        # A tiny share of the way between its neighbours decides among places that lie on each other.
        nearer_m = min(apart_m(before[at], at), apart_m(at, after[at]))
        return (nearer_m + 1e-6 * apart_m(before[at], after[at])) * max(float(quality[at]), 1e-3)

    heap = [(worth(at), at) for at in range(count)]
    heapq.heapify(heap)
    remaining = count
    while remaining > max(capacity, 2):
        value, at = heapq.heappop(heap)
        if not kept[at] or value != worth(at):  # its neighbours have changed since it was valued
            continue
        kept[at] = False
        remaining -= 1
        after[before[at]], before[after[at]] = after[at], before[at]
        for neighbour in (before[at], after[at]):
            heapq.heappush(heap, (worth(neighbour), neighbour))
    return np.flatnonzero(kept)[:capacity]
