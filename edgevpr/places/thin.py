"""The choice of the best places of a map when not all fit: of high quality, and without wide gaps between them."""

import math

import numpy as np

from edgevpr.core.arrays import Floats, Ints
from edgevpr.core.geodesy import metres

_BLOCK = 256  # places in a block; the least worth in each block is stored, to find the least of all quickly


def best_places(lat_deg: Floats, lon_deg: Floats, quality: Floats, capacity: int) -> Ints:
    """Choose `capacity` of N places, given in the order they were mapped; return their indices, int, ascending.

    `lat_deg`, `lon_deg` (NaN: unknown) and `quality` (0..1) are float (N,).

    Places are dropped one at a time, always the one of least worth. The worth of a place is its quality times the
    distance to the nearer of its two remaining neighbours along the track. So gaps stay small, and places of high
    quality stay; age does not matter. The first and the last place are kept.
    """
    count = len(quality)
    if count <= capacity:
        return np.arange(count)
    east_m, north_m = metres(lat_deg, lon_deg)
    # If a position is unknown, the median distance of successive places is used instead.
    steps_m = np.hypot(np.diff(east_m), np.diff(north_m))
    usual_m = (float(np.nanmedian(steps_m)) if np.isfinite(steps_m).any() else 0.0) or 1.0

    def apart_m(a: int, b: int) -> float:
        away_m = math.hypot(east_m[b] - east_m[a], north_m[b] - north_m[a])
        return usual_m * (b - a) if math.isnan(away_m) else away_m

    def worth(before: int, at: int, after: int) -> float:
        if before < 0 or after >= count:
            return math.inf
        # A tiny share of the distance between its neighbours decides among places at the same position.
        nearer_m = min(apart_m(before, at), apart_m(at, after))
        return (nearer_m + 1e-6 * apart_m(before, after)) * max(float(quality[at]), 1e-3)

    # No lists, and few arrays: a map may have a million places.
    before, after = np.arange(-1, count - 1, dtype=np.int32), np.arange(1, count + 1, dtype=np.int32)
    worths = np.full(-(-count // _BLOCK) * _BLOCK, np.inf)  # places that were dropped have infinite worth too
    for at in range(count):
        worths[at] = worth(at - 1, at, at + 1)
    blocks = worths.reshape(-1, _BLOCK)
    least = blocks.min(axis=1)
    kept = np.ones(count, bool)
    for _ in range(count - max(capacity, 2)):
        block = int(least.argmin())
        at = block * _BLOCK + int(blocks[block].argmin())
        kept[at], worths[at] = False, np.inf
        ends = int(before[at]), int(after[at])
        after[ends[0]], before[ends[1]] = ends[1], ends[0]
        for end in ends:
            worths[end] = worth(int(before[end]), end, int(after[end]))
        for touched in {block, *(end // _BLOCK for end in ends)}:
            least[touched] = blocks[touched].min()
    return np.flatnonzero(kept)[:capacity]
