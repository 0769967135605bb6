"""Entropy of an image around each pixel, and the blocks of high entropy: the good blocks of CoHOG (thesis 6.2.1).

There are two entropy maps, both in 0..1. Both take the histogram of the intensities inside a disc around each pixel (81
pixels for radius 5), counting only pixels inside the image, and divide the result by 8 bits, the most that 256
intensities can have. `good_blocks` mostly answers without computing a map.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache, partial, reduce

import cv2
import numpy as np
from numpy.typing import NDArray

from edgevpr.core.arrays import Array, Bools, Bytes, Singles

DISC_RADIUS_PX = 5
SHANNON_SIDE_PX = 100  # the authors' public code takes the Shannon entropy of a copy of this size
# Sizes of the parts that are computed at once, so that the sums stay in cache.
_STRIP_ROWS = 32
_STRIP_CELLS = 32
_STRIP_PIXELS = 256
_STRIP_INTENSITIES = 16
_ROUNDING = 1e-5  # more than float32 rounding can change the mean entropy of a block
_LOG2 = np.log2(np.arange(257, dtype=np.float32).clip(1))
_LOG2_OVER_8 = _LOG2 / 8
_COUNT_LOG2 = np.arange(256, dtype=np.float32) * _LOG2[:256]


def filled_bins(grey: Bytes) -> Singles:
    """Compute log2 of the number of different intensities in each disc, over 8: the algorithm printed in thesis 6.2.1.
    uint8 (H, W) to float32 (H, W) in 0..1."""
    padded = _replicated(grey)
    entropy = np.empty(grey.shape, np.float32)
    for top in range(0, len(grey), _STRIP_ROWS):
        different = _different(padded[top : top + _STRIP_ROWS + 2 * DISC_RADIUS_PX])
        entropy[top : top + _STRIP_ROWS] = _LOG2_OVER_8[different]
    return entropy


def shannon(grey: Bytes) -> Array:
    """Compute the Shannon entropy (bits) of the intensities in each disc, over 8, from a 100x100 copy scaled back up,
    as the authors' public code does: uint8 (H, W) to float32 (H, W) in 0..1."""
    height, width = grey.shape
    return cv2.resize(_shannon_of(_shannon_copy(grey)), (width, height), interpolation=cv2.INTER_LINEAR)


def block_means(per_pixel: Array, cell_px: int) -> Array:
    """Average values of pixels over every block of 2x2 cells of `cell_px` pixels. The blocks start one cell apart:
    float32 (H, W) to (H/cell_px - 1, W/cell_px - 1)."""
    cell = _cell_means(per_pixel, cell_px)
    means: Array = (cell[:-1, :-1] + cell[:-1, 1:] + cell[1:, :-1] + cell[1:, 1:]) / 4
    return means


def good_blocks(grey: Bytes, which: str, cell_px: int, threshold: float, among: Bools | bool = True) -> Bools:
    """Find the good blocks (thesis 6.2.1): those whose mean entropy is at least `threshold` (0..1). The result equals
    `block_means(entropy(grey), cell_px) >= threshold`, where `which` names the entropy: "filled_bins" or "shannon".
    Cheap bounds decide nearly every block, and only the pixels under the others are computed exactly. `grey` is uint8
    (H, W) with sides that are multiples of `cell_px`. Returns bool (H/cell_px - 1, W/cell_px - 1), False where `among`,
    bool of this shape, is False (True: consider all)."""
    bounds = _BOUNDS[which](grey, cell_px)
    low = bounds.low
    undecided = (bounds.blocks(low) < threshold + _ROUNDING) & (bounds.blocks(bounds.high) >= threshold - _ROUNDING)
    undecided &= among
    if undecided.any():
        matters = (bounds.down.T @ undecided @ bounds.across > 0) & (low < bounds.high)
        low[matters] = bounds.exact(matters)
        if (np.abs(bounds.blocks(low)[undecided] - threshold) < _ROUNDING).any():
            return (block_means(_MAPS[which](grey), cell_px) >= threshold) & among
    return (bounds.blocks(low) >= threshold) & among


@dataclass(frozen=True, slots=True, kw_only=True)
class _Bounds:
    """Bounds `low` and `high` of an entropy, float32 (h, w), at the points of a grid over the image. Values on this
    grid are averaged over the blocks by `down` @ values @ `across`.T. `exact` computes the entropy itself at the True
    points of a bool (h, w), one value each."""

    low: Array
    high: Array
    down: Singles
    across: Singles
    exact: Callable[[Bools], Singles]

    def blocks(self, values: Array) -> Singles:
        means: Singles = self.down @ values @ self.across.T
        return means


def _bound_filled_bins(grey: Bytes, cell_px: int) -> _Bounds:
    """Bound the mean of `filled_bins` over each cell, from the last six bits of the intensities, their *endings*."""
    r = DISC_RADIUS_PX
    padded = _replicated(grey)
    at_least = np.empty(grey.shape, np.uint8)
    for top in range(0, len(grey), _STRIP_ROWS):
        endings = _over_disc(_bit(padded[top : top + _STRIP_ROWS + 2 * r]), np.bitwise_or)
        at_least[top : top + _STRIP_ROWS] = np.bitwise_count(endings)
    # n intensities have at most n endings; of those within 64 k values at most k share one.
    at_most = cv2.multiply(at_least, (_range(grey) >> 6) + 1)  # saturates at 255

    def exact(cells: Bools) -> Singles:
        side = cell_px + 2 * r
        patches = np.lib.stride_tricks.sliding_window_view(padded, (side, side))[::cell_px, ::cell_px][cells]
        means = np.empty(len(patches), np.float32)
        for start in range(0, len(patches), _STRIP_CELLS):
            strip = slice(start, start + _STRIP_CELLS)
            means[strip] = _LOG2_OVER_8[_different(patches[strip])].mean(axis=(1, 2))
        return means

    low, high = (_cell_means(cv2.LUT(number, _LOG2_OVER_8[:256]), cell_px) for number in (at_least, at_most))
    down, across = (_pairs(side // cell_px) for side in grey.shape)
    return _Bounds(low=low, high=high, down=down, across=across, exact=exact)


def _bound_shannon(grey: Bytes, cell_px: int) -> _Bounds:
    """Bound `shannon` at each pixel of its 100x100 copy, from the last four bits of the intensities, their
    *endings*."""
    small = _shannon_copy(grey)
    # The entropy of the endings is at most that of all bits; within 16 k values the others add at most log2 k.
    low = _shannon_of(small & 15)
    high = low + _LOG2_OVER_8[(_range(small) >> 4) + 1]
    down, across = (_scaled_pairs(side, cell_px) for side in grey.shape)
    return _Bounds(low=low, high=high, down=down, across=across, exact=partial(_shannon_at, small))


_MAPS = {"filled_bins": filled_bins, "shannon": shannon}
_BOUNDS = {"filled_bins": _bound_filled_bins, "shannon": _bound_shannon}


def _cell_means(per_pixel: Array, cell_px: int) -> Array:
    height, width = per_pixel.shape
    return cv2.resize(per_pixel, (width // cell_px, height // cell_px), interpolation=cv2.INTER_AREA)


def _shannon_copy(grey: Bytes) -> Array:
    # INTER_LINEAR_EXACT: plain INTER_LINEAR differs by a grey level between processors, and a map must work on all.
    return cv2.resize(grey, (SHANNON_SIDE_PX, SHANNON_SIDE_PX), interpolation=cv2.INTER_LINEAR_EXACT)


@lru_cache(maxsize=4)
def _pairs(cells: int) -> Array:
    """Return the matrix float32 (cells - 1, cells) that averages each cell of a row and the cell after it."""
    return (np.eye(cells - 1, cells, dtype=np.float32) + np.eye(cells - 1, cells, 1, dtype=np.float32)) / 2


@lru_cache(maxsize=4)
def _scaled_pairs(side_px: int, cell_px: int) -> Singles:
    """Return the matrix float32 (cells - 1, 100) that enlarges a row of the 100x100 copy to `side_px` pixels, and
    averages it over each pair of neighbouring cells of `cell_px` pixels."""
    unit = np.eye(SHANNON_SIDE_PX, dtype=np.float32)
    back = cv2.resize(unit, (SHANNON_SIDE_PX, side_px), interpolation=cv2.INTER_LINEAR)
    matrix: Singles = _pairs(side_px // cell_px) @ back.reshape(-1, cell_px, SHANNON_SIDE_PX).mean(axis=1)
    return matrix


def _range(grey: Bytes) -> Array:
    """Return, for each pixel, the largest minus the smallest intensity in the square around its disc: uint8 (H, W)."""
    square = np.ones((2 * DISC_RADIUS_PX + 1,) * 2, np.uint8)
    return cv2.subtract(cv2.dilate(grey, square), cv2.erode(grey, square))


def _replicated(grey: Bytes) -> Array:
    """Pad with copies of the border. They add no intensity to a disc: the pixel copied is nearer to its middle."""
    r = DISC_RADIUS_PX
    return cv2.copyMakeBorder(grey, r, r, r, r, cv2.BORDER_REPLICATE)


def _bit(grey: Bytes) -> NDArray[np.uint64]:
    """Return for each pixel a set with one element, as a word: the bit of the last six bits of the intensity is set."""
    sets: NDArray[np.uint64] = np.left_shift(np.uint64(1), grey & 63, dtype=np.uint64)
    return sets


def _different(padded: Bytes) -> Array:
    """Count the different intensities in each disc, by unions of sets of 256 bits; shapes as in `_over_disc`."""
    bit, word_of = _bit(padded), padded >> 6
    unions = (_over_disc(bit * (word_of == word), np.bitwise_or) for word in range(4))
    sizes: Array = reduce(np.add, (np.bitwise_count(union).astype(np.int16) for union in unions))
    return sizes


def _shannon_of(small: Array) -> Singles:
    """Compute the Shannon entropy of the disc of every pixel, in bits over 8: uint8 (H, W) to float32 (H, W)."""
    padded = np.pad(small.astype(np.int16), DISC_RADIUS_PX, constant_values=-1)  # -1: outside, no intensity
    of_counts = np.zeros(small.shape, np.float32)
    present = np.flatnonzero(np.bincount(small.ravel()))[:, None, None]
    for start in range(0, len(present), _STRIP_INTENSITIES):
        one_hot = (padded == present[start : start + _STRIP_INTENSITIES]).view(np.uint8)
        counts = _over_disc(one_hot, np.add)
        of_counts += _COUNT_LOG2.take(counts).sum(axis=0)
    in_disc = _over_disc((padded >= 0).view(np.uint8), np.add)
    # -sum p log2 p with p = c/n is log2 n - (sum c log2 c)/n.
    entropy: Singles = (_COUNT_LOG2[in_disc] - of_counts) / in_disc / 8
    return entropy


def _shannon_at(small: Bytes, pixels: Bools) -> Singles:
    """Compute `_shannon_of` at the P True pixels of a bool (H, W) only, each from its own histogram: float32 (P,)."""
    r = DISC_RADIUS_PX
    padded = np.pad(small.astype(np.int16), r, constant_values=256)  # 256: outside
    down, right = np.nonzero(np.hypot(*np.mgrid[-r : r + 1, -r : r + 1]) <= r)
    disc = down * padded.shape[1] + right
    row, col = np.nonzero(pixels)
    corner = row * padded.shape[1] + col
    entropy = np.empty(len(corner), np.float32)
    for start in range(0, len(corner), _STRIP_PIXELS):
        strip = corner[start : start + _STRIP_PIXELS, None]
        bins = padded.take(strip + disc) + 257 * np.arange(len(strip))[:, None]
        counts = np.bincount(bins.ravel(), minlength=257 * len(strip)).reshape(-1, 257)[:, :256]
        in_disc = counts.sum(axis=1)
        of_counts = _COUNT_LOG2.take(counts).sum(axis=1)
        entropy[start : start + _STRIP_PIXELS] = (_COUNT_LOG2[in_disc] - of_counts) / in_disc / 8
    return entropy


def _over_disc(planes: Array, combine: np.ufunc) -> Array:
    """Combine the values in the disc around each pixel of each plane by an associative ufunc (add, bitwise_or): planes
    padded by the radius r, (..., H + 2r, W + 2r), to (..., H, W)."""
    r, pitch = DISC_RADIUS_PX, planes.shape[-1]
    half_width = [int((r * r - dy * dy) ** 0.5) for dy in range(r + 1)]
    flat = planes.ravel()
    first = r * pitch + r  # the middle of the first disc
    discs = flat.size - 2 * first
    out = np.empty(planes.shape, planes.dtype)
    at_middles = out.reshape(-1)[:discs]
    at_middles[:] = 0
    row = flat.copy()
    for half in range(r + 1):
        if half:
            combine(row[half:-half], flat[: -2 * half], out=row[half:-half])
            combine(row[half:-half], flat[2 * half :], out=row[half:-half])
        for dy in (dy for dy in range(-r, r + 1) if half_width[abs(dy)] == half):
            start = first + dy * pitch
            combine(at_middles, row[start : start + discs], out=at_middles)
    return out[..., : planes.shape[-2] - 2 * r, : pitch - 2 * r]
