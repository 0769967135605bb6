"""Entropy of an image around each pixel, and the blocks of high entropy: the good blocks of CoHOG (thesis 6.2.1).

There are two entropy maps, both in 0..1. Both take the histogram of the intensities inside a disc around each pixel (81
pixels for radius 5), counting only pixels inside the image, and divide the result by 8 bits, the most that 256
intensities can have. `good_blocks` mostly answers without computing a map.
"""

from functools import lru_cache, reduce

import cv2
import numpy as np

from edgevpr.core.arrays import Array, Bools, Bytes, Singles

DISC_RADIUS_PX = 5
SHANNON_SIDE_PX = 100  # the authors' public code takes the Shannon entropy of a copy of this size
# Sizes of the parts that are computed at once, so that the sums stay in cache.
_STRIP_ROWS = 32
_STRIP_PIXELS = 256
_STRIP_INTENSITIES = 16
_ROUNDING = 1e-5  # more than float32 rounding can change the mean entropy of a block
_LOG2 = np.log2(np.arange(257, dtype=np.float32).clip(1))
_LOG2_OVER_8 = _LOG2 / 8
_COUNT_LOG2 = np.arange(256, dtype=np.float32) * _LOG2[:256]


def filled_bins(grey: Bytes, radius_px: int = DISC_RADIUS_PX) -> Singles:
    """Compute log2 of the number of different intensities in each disc, over 8: the algorithm printed in thesis 6.2.1.

    `grey` is uint8 (H, W); returns float32 (H, W) in 0..1.
    """
    # Copies of the border add no intensity to any disc: the pixel copied is nearer to the middle of the disc.
    padded: Array = cv2.copyMakeBorder(grey, *(radius_px,) * 4, cv2.BORDER_REPLICATE)
    entropy = np.empty(grey.shape, np.float32)
    for top in range(0, len(grey), _STRIP_ROWS):
        strip = padded[top : top + _STRIP_ROWS + 2 * radius_px]
        # A set of intensities is 256 bits in four words. The union of the sets in a disc has one bit for each of them.
        bit, word_of = np.left_shift(np.uint64(1), strip & 63, dtype=np.uint64), strip >> 6
        unions = (_over_disc(bit * (word_of == word), radius_px, np.bitwise_or) for word in range(4))
        different: Array = reduce(np.add, (np.bitwise_count(union).astype(np.int16) for union in unions))
        entropy[top : top + _STRIP_ROWS] = _LOG2_OVER_8[different]
    return entropy


def shannon(grey: Bytes, radius_px: int = DISC_RADIUS_PX) -> Array:
    """Compute the Shannon entropy (bits) of the intensities in each disc, over 8, from a 100x100 copy scaled back up.

    The authors' public code computes this, where the thesis's text has `filled_bins`. `grey` is uint8 (H, W); returns
    float32 (H, W) in 0..1.
    """
    height, width = grey.shape
    small = _shannon_copy(grey)
    return cv2.resize(_shannon_of(small, radius_px), (width, height), interpolation=cv2.INTER_LINEAR)


def block_means(per_pixel: Array, cell_px: int) -> Array:
    """Average a map over every block of 2x2 cells of `cell_px` pixels. The blocks start one cell apart: float32 (H, W)
    to (H/cell_px - 1, W/cell_px - 1)."""
    height, width = per_pixel.shape
    cell = cv2.resize(per_pixel, (width // cell_px, height // cell_px), interpolation=cv2.INTER_AREA)
    means: Array = (cell[:-1, :-1] + cell[:-1, 1:] + cell[1:, :-1] + cell[1:, 1:]) / 4
    return means


def good_blocks(grey: Bytes, which: str, cell_px: int, threshold: float, among: Bools | bool = True) -> Bools:
    """Tell which blocks are good (thesis 6.2.1): those whose mean entropy is at least `threshold` (0..1). The result
    equals `block_means(filled_bins(grey), cell_px) >= threshold`, or that of `shannon`, as `which` names.

    Cheap bounds of the Shannon entropy decide nearly every block, and only the pixels under the others are computed
    exactly. `grey` is uint8 (H, W) with sides that are multiples of `cell_px`. Returns bool (H/cell_px - 1, W/cell_px -
    1), False where `among`, bool of this shape, is False (True: consider all).
    """
    if which == "filled_bins":
        return (block_means(filled_bins(grey), cell_px) >= threshold) & among
    small = _shannon_copy(grey)
    down, across = (_scaled_pairs(side, cell_px) for side in grey.shape)

    def over_blocks(per_pixel: Singles) -> Singles:
        means: Array = down @ per_pixel @ across.T
        return means

    # Of the last four bits alone, the entropy is never more. If all intensities around a pixel lie within 16 k values,
    # the other bits add at most log2 k.
    low = _shannon_of(small & 15, DISC_RADIUS_PX)
    high = low + _LOG2_OVER_8[(_range(small) >> 4) + 1]
    undecided = (over_blocks(low) < threshold + _ROUNDING) & (over_blocks(high) >= threshold - _ROUNDING) & among
    if undecided.any():
        matters = (down.T @ undecided @ across > 0) & (low < high)
        low[matters] = _shannon_at(small, matters)
        if (np.abs(over_blocks(low)[undecided] - threshold) < _ROUNDING).any():
            return (block_means(shannon(grey), cell_px) >= threshold) & among
    return (over_blocks(low) >= threshold) & among


def _shannon_copy(grey: Bytes) -> Array:
    # INTER_LINEAR_EXACT: plain INTER_LINEAR differs by a grey level between processors, and a map must work on all.
    return cv2.resize(grey, (SHANNON_SIDE_PX, SHANNON_SIDE_PX), interpolation=cv2.INTER_LINEAR_EXACT)


@lru_cache(maxsize=4)
def _scaled_pairs(side_px: int, cell_px: int) -> Singles:
    """Return the matrix float32 (cells - 1, 100) that enlarges a row of the copy and averages it over blocks."""
    unit = np.eye(SHANNON_SIDE_PX, dtype=np.float32)
    back = cv2.resize(unit, (SHANNON_SIDE_PX, side_px), interpolation=cv2.INTER_LINEAR)
    cells = side_px // cell_px
    pairs: Array = (np.eye(cells - 1, cells, dtype=np.float32) + np.eye(cells - 1, cells, 1, dtype=np.float32)) / 2
    matrix: Singles = pairs @ back.reshape(-1, cell_px, SHANNON_SIDE_PX).mean(axis=1)
    return matrix


def _range(grey: Bytes) -> Array:
    """Return, for each pixel, the largest minus the smallest intensity in the square around its disc: uint8 (H, W)."""
    square = np.ones((2 * DISC_RADIUS_PX + 1,) * 2, np.uint8)
    return cv2.subtract(cv2.dilate(grey, square), cv2.erode(grey, square))


def _shannon_of(small: Array, radius_px: int) -> Singles:
    """Compute the Shannon entropy of the disc of every pixel, in bits over 8: uint8 (H, W) to float32 (H, W)."""
    padded = np.pad(small.astype(np.int16), radius_px, constant_values=-1)  # -1: outside, no intensity
    of_counts = np.zeros(small.shape, np.float32)
    present = np.flatnonzero(np.bincount(small.ravel()))[:, None, None]
    for start in range(0, len(present), _STRIP_INTENSITIES):
        one_hot = (padded == present[start : start + _STRIP_INTENSITIES]).view(np.uint8)
        counts = _over_disc(one_hot, radius_px, np.add)
        of_counts += _COUNT_LOG2.take(counts).sum(axis=0)
    in_disc = _over_disc((padded >= 0).view(np.uint8), radius_px, np.add)
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


def _over_disc(planes: Array, radius_px: int, combine: np.ufunc) -> Array:
    """Combine each plane over discs by an associative ufunc (add, bitwise_or): (..., H + 2r, W + 2r) to (..., H, W)."""
    r, pitch = radius_px, planes.shape[-1]
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
