"""The coarse stage of `cohog` for a camera that looks straight down: a place is the *layout* of its structures.

The patterns of a picture's good regions (see `make_slow_patterns`) are averaged in the cells of a square grid, minus
the mean of their surroundings. A query is compared with a place under each of 24 rotations, 15 degrees apart, and every
whole-cell shift that covers enough of the place. The score is the correlation of the two fields where they overlap,
divided by the *scatter*: the standard deviation that this correlation has for independent fields of the same strength.
All places are compared on a coarse grid, under every second rotation, and only the best pairs of a place and a rotation
on a fine grid. A place stores both in RAM, with 4 bits per value."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from edgevpr.core.arrays import Array, Bools, Bytes, Doubles, Ints, Singles


@dataclass(frozen=True, slots=True)
class Grid:
    """A grid of `side` x `side` cells over a place. `channels`: indices of the patterns that are averaged, those that
    vary most from cell to cell."""

    side: int
    channels: tuple[int, ...]

    @property
    def size(self) -> int:
        """The number of values in the field of a place."""
        return self.side**2 * len(self.channels)


COARSE = Grid(8, (0, 1, 2, 3, 4, 7, 8, 13))
FINE = Grid(12, (0, 1, 2, 3, 4, 7, 8, 9, 12, 13, 15, 17))
PLACE_BYTES = (COARSE.size + FINE.size) // 2  # of a place in RAM
ROTATIONS = 24
_SURROUND_SD = 0.25  # standard deviation of the surroundings of a cell, as a fraction of the place's side
_MIN_SEEN_FRACTION = 0.1  # of a cell that good regions must cover
_MIN_STRENGTH = 0.01  # of a cell; weaker cells are noise
_MAX_LEVEL = 7  # of a stored value, on either side of 0
_LEVEL_PERCENTILE = 99  # percentile of a place's values that becomes the highest level
_MIN_OVERLAP = {8: 0.5, 12: 0.35}  # fraction of the place that the query covers, by the side of the grid
_MIN_LARGER_OVERLAP = {8: 1.0, 12: 0.75}  # the same, for a query that shows more ground than a place
_MIN_SCATTER = 0.3  # relative to the usual scatter; a smaller one, of a small or empty overlap, is raised to it
# Pairs of a place and a rotation that are compared on the fine grid: if all headings are known, and otherwise.
_FINE_PAIRS = (1000, 2000)
_RIVAL_PLACES = 2048  # places out of reach that are scored
_ROWS_PER_PRODUCT = 256
_TINY = 1e-9

# Returns the field of the query on a grid, under a rotation in steps of 15 degrees.
Fields = Callable[[int, Grid], Singles]

_EMPTY_BYTE = 0x88  # a byte of two zeros

# The two values stored in each byte, the low half first.
_BYTE_VALUES = np.stack(np.divmod(np.arange(256), 16)[::-1], axis=1).astype(np.float32) - (_MAX_LEVEL + 1)


def make_field(grid: Grid, patterns: Array, indices: Ints, sides: tuple[int, int]) -> Array:
    """Average the patterns of good regions in the cells of a grid. `patterns` (G, 20) belong to the regions `indices`,
    int (G,), row-major in `sides[0]` x `sides[0]` regions. A place has `sides[1]` a side, and the same centre. Returns
    the field (C, m, m) of C channels; m is `grid.side` or, for a picture of more ground, larger by an even number."""
    side, place_side = sides
    padded = np.zeros((side * side, len(grid.channels) + 1), patterns.dtype)
    padded[indices, :-1] = patterns[:, grid.channels]
    padded[indices, -1] = 1
    pooling = _make_pooling(side, place_side, grid.side)
    pooled = _apply_weights(pooling, padded.reshape(side, side, -1).transpose(2, 0, 1))
    values, weight = pooled[:-1], pooled[-1]
    values = values - weight * (values.sum(axis=(1, 2)) / max(float(weight.sum()), _TINY))[:, None, None]
    surround = _make_distance_weights(len(weight), _SURROUND_SD * grid.side)
    values -= weight * _apply_weights(surround, values) / np.maximum(_apply_weights(surround, weight), _TINY)
    values /= np.sqrt(np.maximum(np.sqrt((values**2).sum(axis=0)), _MIN_STRENGTH))
    return np.asarray(values * (weight > _MIN_SEEN_FRACTION))


def encode_place(patterns: Array, good: Bools, side: int) -> Bytes:
    """Return the coarse part of a place, uint8 (PLACE_BYTES,), from the patterns (side * side, 20) of all its regions;
    only those that are `good`, bool (side * side,), are used."""
    indices = np.flatnonzero(good)
    stored = []
    for grid in (COARSE, FINE):
        values = make_field(grid, patterns[indices], indices, (side, side)).ravel()
        largest = max(float(np.percentile(np.abs(values), _LEVEL_PERCENTILE)), _TINY)
        clipped = np.clip(np.rint(values * (_MAX_LEVEL / largest)), -_MAX_LEVEL, _MAX_LEVEL)
        levels = clipped.astype(np.uint8) + (_MAX_LEVEL + 1)
        stored.append(levels[::2] | levels[1::2] << 4)
    return np.asarray(np.concatenate(stored).astype(np.uint8))


def scan_places(fields: Fields, rows: Bytes, rotation_deg: Doubles | None, likely: Bools | None) -> Singles:
    """Score all places by their coarse parts, `rows` uint8 (N, PLACE_BYTES), under each rotation: float32 (N, 24).
    `rotation_deg` (N,) is the expected rotation of each place: only the nearest step and its two neighbours are scored,
    and the others are -inf (NaN or None: all are scored). `likely` bool (N,): places that may be compared on the fine
    grid (None: all). A pair compared there scores 0 to 1; any other has its coarse score minus 1. About two thousand
    of the places that are not likely, evenly spaced, are scored as rivals."""
    scores = np.full((len(rows), ROTATIONS), -np.inf, np.float32)
    if likely is not None and (step := np.count_nonzero(~likely) // _RIVAL_PLACES) > 1:
        sample = likely.copy()
        sample[np.flatnonzero(~likely)[::step]] = True
        sample_deg = None if rotation_deg is None else rotation_deg[sample]
        scores[sample] = scan_places(fields, rows[sample], sample_deg, likely[sample])
        return scores
    turns = np.full(len(rows), -1)
    if rotation_deg is not None:
        turns = np.nan_to_num(np.rint(rotation_deg * (ROTATIONS / 360)) % ROTATIONS, nan=-1).astype(np.intp)
    coarse = rows[:, : COARSE.size // 2]
    for turn in np.unique(turns):
        group = slice(None) if rotation_deg is None else np.flatnonzero(turns == turn)
        tested_turns = np.arange(0, ROTATIONS, 2) if turn < 0 else np.arange(turn - 1, turn + 2) % ROTATIONS
        pairs = _compare_fields(COARSE, [fields(int(number), COARSE) for number in tested_turns], coarse[group])
        if turn < 0:
            pairs = np.stack([pairs, (pairs + np.roll(pairs, -1, axis=1)) / 2], axis=2).reshape(len(pairs), -1)
            tested_turns = np.arange(ROTATIONS)
        scores[np.arange(len(rows))[group][:, None], tested_turns] = pairs
    scores -= 1
    pair_scores = scores if likely is None else np.where(likely[:, None], scores, -np.inf)
    count = min(_FINE_PAIRS[int(turns.min() < 0)], pair_scores.size)
    best = np.argpartition(-pair_scores, count - 1, axis=None)[:count]
    slots, best_turns = np.divmod(best[np.isfinite(pair_scores.flat[best])], ROTATIONS)
    for turn in np.unique(best_turns):
        best_slots = np.sort(slots[best_turns == turn])
        pairs = _compare_fields(FINE, [fields(int(turn), FINE)], rows[best_slots, COARSE.size // 2 :])
        scores[best_slots, turn] = np.clip(pairs[:, 0], 0, 1)
    return scores


def compute_agreement(query: Array, place: Array, shift: tuple[float, float]) -> float:
    """Return the score (see `scan_places`), 0 to 1, of the fine field of a query, (C, m, m), on that of a place, (C, n,
    n), if the query's centre is at `shift` (dx, dy) from the place's, in sides of the place, or up to a cell away."""
    n = place.shape[1]
    dx, dy = (round(fraction * n) for fraction in shift)
    padded = _pad_field(query, n)
    first = (padded.shape[1] - n) // 2
    steps = [(first - dy - y, first - dx - x) for y in (-1, 0, 1) for x in (-1, 0, 1)]
    windows = [(y, x) for y, x in steps if 0 <= y <= padded.shape[1] - n and 0 <= x <= padded.shape[1] - n]
    if not windows:
        return 0.0
    shifted = np.stack([padded[:, y : y + n, x : x + n] for y, x in windows])
    strength = (place**2).sum(axis=0)
    scatter_sq = ((shifted**2).sum(axis=1) * strength).sum(axis=(1, 2))
    query_strength = float((query**2).sum() / query[0].size)  # mean over its cells
    scatter_sq = np.maximum(scatter_sq, _MIN_SCATTER**2 * query_strength * strength.sum())
    scores = np.einsum("scij,cij->s", shifted, place) / (np.sqrt(scatter_sq + _TINY) * n)
    return float(np.clip(scores.max(), 0, 1))


def _compare_fields(grid: Grid, queries: list[Singles], packed: Bytes) -> Singles:
    """Compare R fields of the query with N places, uint8 (N, B): the best score over all shifts, float32 (N, R). The
    scatter is estimated from the query's cells on the place and the mean strength of the place's cells."""
    shifted = [_shift_field(query, grid.side) for query in queries]
    fields = np.concatenate(shifted) if len(shifted) > 1 else shifted[0]  # a megabyte, so avoid a needless copy
    strengths = [(query**2).sum(axis=0, keepdims=True) for query in queries]
    scatter_sq = np.concatenate([_shift_field(strength, grid.side).sum(axis=1) for strength in strengths])
    limits = [_MIN_SCATTER**2 * float(strength.mean()) * grid.side**2 for strength in strengths]
    fields /= np.sqrt(np.maximum(scatter_sq, np.repeat(limits, [len(query) for query in shifted])) + _TINY)[:, None]
    best = np.empty((len(packed), len(queries)), np.float32)
    last_is_filled, used_fields = None, fields
    for start in range(0, len(packed), _ROWS_PER_PRODUCT):
        part = packed[start : start + _ROWS_PER_PRODUCT]
        # Wide pictures leave the same cells of every place empty.
        is_filled = (part != _EMPTY_BYTE).any(axis=0)
        if last_is_filled is None or (is_filled != last_is_filled).any():
            last_is_filled, used_fields = is_filled, fields.compress(np.repeat(is_filled, 2), axis=1)
        places = np.take(_BYTE_VALUES, part[:, is_filled], axis=0).reshape(len(part), -1)
        scores = (used_fields @ places.T).reshape(len(queries), -1, len(part)).max(axis=1)
        strength = np.einsum("nd,nd->n", places, places)
        best[start : start + len(part)] = (scores / np.sqrt(strength + _TINY)).T
    return best


def _pad_field(query: Array, n: int) -> Array:
    """Pad a field (C, m, m) with `n` empty cells on each side, ten times faster than `np.pad`."""
    m = query.shape[1]
    padded = np.zeros((len(query), m + 2 * n, m + 2 * n), query.dtype)
    padded[:, n : n + m, n : n + m] = query
    return padded


def _shift_field(query: Singles, n: int) -> Singles:
    """Return the part of a query's field (C, m, m) on a place of `n` x `n` cells, for each shift: (S, C n n)."""
    windows = sliding_window_view(_pad_field(query, n), (n, n), axis=(1, 2)).transpose(1, 2, 0, 3, 4)  # (K, K, C, n, n)
    y, x = _list_shifts(query.shape[1], n)
    return windows[y, x].reshape(len(y), -1)


@lru_cache
def _list_shifts(m: int, n: int) -> tuple[Ints, Ints]:
    """Return the first row and column, int (S,) each, of the windows of `n` cells in which the query covers enough of a
    place. The query has `m` cells along a side and a border of n on every side."""
    first = np.arange(m + n + 1)
    overlap = np.minimum(first + n, m + n) - np.maximum(first, n)
    min_overlap = _MIN_OVERLAP[n] if m == n else _MIN_LARGER_OVERLAP[n]
    y, x = np.nonzero(np.outer(overlap.clip(0), overlap.clip(0)) >= min_overlap * n * n)
    return y, x


@lru_cache
def _make_pooling(side: int, place_side: int, cells: int) -> Singles:
    """Return the weights, float32 (m, side), that average a row of `side` regions in m cells with the same centre;
    `cells` of these are as long as the `place_side` regions of a place."""
    pitch = place_side / cells
    m = cells + 2 * max(0, int(np.ceil((side / pitch - cells) / 2 - _TINY)))
    starts = (np.arange(m)[:, None] - m / 2) * pitch
    region = np.arange(side) - side / 2
    overlap = np.minimum(starts + pitch, region + 1) - np.maximum(starts, region)
    return np.asarray((overlap.clip(0) / pitch).astype(np.float32))


@lru_cache
def _make_distance_weights(cells: int, sd: float) -> Singles:
    """Return Gaussian weights of the distances between the cells of a row, float32 (cells, cells)."""
    distance = np.subtract.outer(np.arange(cells), np.arange(cells))
    return np.asarray(np.exp(-(distance**2) / (2 * sd**2)).astype(np.float32))


def _apply_weights(weights: Singles, values: Array) -> Array:
    """Apply `weights` (m, n) along both sides of `values` (..., n, n): (..., m, m)."""
    return np.asarray(weights @ values @ weights.T)
