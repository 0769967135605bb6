"""Entropy of an image around each pixel, and the blocks of high entropy: the good blocks of CoHOG (thesis 6.2.1).

Both entropies use the histogram of the intensities in a disc around each pixel (81 pixels for radius 5), without pixels
outside the image. They are divided by 8 bits, the maximum for 256 intensities."""

from functools import lru_cache, reduce

import cv2
import numpy as np

from edgevpr.core.arrays import Array, Bools, Bytes, Singles

DISC_RADIUS_PX = 5
SHANNON_SIDE_PX = 100  # the authors' public code uses a copy of this size
# Sizes of the parts that are processed at once, so that the sums stay in cache.
_STRIP_ROWS = 32
_STRIP_PIXELS = 256
_STRIP_INTENSITIES = 16
_MAX_ROUNDING = 1e-5  # float32 rounding changes the mean entropy of a block by less
_LOG2 = np.log2(np.arange(257, dtype=np.float32).clip(1))
_LOG2_OVER_8 = _LOG2 / 8
_COUNT_LOG2 = np.arange(256, dtype=np.float32) * _LOG2[:256]


def compute_filled_bins(grey: Bytes) -> Singles:
    """Compute log2 of the number of distinct intensities in each disc, divided by 8: the algorithm printed in thesis
    6.2.1. uint8 (H, W) to float32 (H, W) in 0..1."""
    r = DISC_RADIUS_PX
    # Copies of the border add no intensity: the original pixel is nearer the disc's centre, so it is in the disc.
    padded = cv2.copyMakeBorder(grey, r, r, r, r, cv2.BORDER_REPLICATE)
    entropy = np.empty(grey.shape, np.float32)
    for top in range(0, len(grey), _STRIP_ROWS):
        entropy[top : top + _STRIP_ROWS] = _LOG2_OVER_8[_count_distinct(padded[top : top + _STRIP_ROWS + 2 * r])]
    return entropy


def compute_shannon(grey: Bytes) -> Array:
    """Compute the Shannon entropy (bits) of the intensities in each disc, divided by 8, on a 100x100 copy, and enlarge
    it, as the authors' public code does: uint8 (H, W) to float32 (H, W) in 0..1."""
    height, width = grey.shape
    return cv2.resize(_compute_shannon_map(_make_shannon_copy(grey)), (width, height), interpolation=cv2.INTER_LINEAR)


def average_blocks(per_pixel: Array, cell_px: int) -> Array:
    """Average values of pixels over every block of 2x2 cells of `cell_px` pixels. The blocks start one cell apart:
    float32 (H, W) to (H/cell_px - 1, W/cell_px - 1)."""
    height, width = per_pixel.shape
    cells = cv2.resize(per_pixel, (width // cell_px, height // cell_px), interpolation=cv2.INTER_AREA)
    return np.asarray((cells[:-1, :-1] + cells[:-1, 1:] + cells[1:, :-1] + cells[1:, 1:]) / 4)


def find_good_blocks(grey: Bytes, kind: str, cell_px: int, threshold: float, eligible: Bools | bool = True) -> Bools:
    """Find the good blocks (thesis 6.2.1): those whose mean entropy is at least `threshold` (0..1). `kind` is the
    entropy: "filled_bins" or "shannon". `grey` is uint8 (H, W) with sides that are multiples of `cell_px`. Returns bool
    (H/cell_px - 1, W/cell_px - 1), False where `eligible`, bool of this shape, is False (True: consider all).

    Cheap bounds of the Shannon entropy settle nearly every block. The entropy is computed only at the pixels of the
    other blocks; the result is the same as with the full entropy map."""
    if kind == "filled_bins":
        return (average_blocks(compute_filled_bins(grey), cell_px) >= threshold) & eligible
    small = _make_shannon_copy(grey)
    # The entropy of the lower four bits is a lower bound. In a range of 16 k values, the upper bits add at most log2 k.
    entropy = _compute_shannon_map(small & 15)
    square = np.ones((2 * DISC_RADIUS_PX + 1,) * 2, np.uint8)  # around the disc of each pixel
    intensity_range: Array = cv2.subtract(cv2.dilate(small, square), cv2.erode(small, square))
    upper = entropy + _LOG2_OVER_8[(intensity_range >> 4) + 1]
    down, across = (_make_block_matrix(side, cell_px) for side in grey.shape)

    def average(values: Array) -> Singles:
        return np.asarray(down @ values @ across.T)

    undecided = (average(entropy) < threshold + _MAX_ROUNDING) & (average(upper) >= threshold - _MAX_ROUNDING)
    undecided &= eligible
    if undecided.any():
        is_needed = (down.T @ undecided @ across > 0) & (entropy < upper)
        entropy[is_needed] = _compute_shannon_pixels(small, is_needed)
        if (np.abs(average(entropy)[undecided] - threshold) < _MAX_ROUNDING).any():
            return (average_blocks(compute_shannon(grey), cell_px) >= threshold) & eligible
    return (average(entropy) >= threshold) & eligible


def _make_shannon_copy(grey: Bytes) -> Array:
    # INTER_LINEAR_EXACT, because INTER_LINEAR differs by a grey level between processors, and a map must work on all.
    return cv2.resize(grey, (SHANNON_SIDE_PX, SHANNON_SIDE_PX), interpolation=cv2.INTER_LINEAR_EXACT)


@lru_cache(maxsize=4)
def _make_block_matrix(side_px: int, cell_px: int) -> Singles:
    """Return the matrix float32 (cells - 1, 100) that enlarges a row of the 100x100 copy to `side_px` pixels, and
    averages it over each pair of neighbouring cells of `cell_px` pixels."""
    unit = np.eye(SHANNON_SIDE_PX, dtype=np.float32)
    enlargement = cv2.resize(unit, (SHANNON_SIDE_PX, side_px), interpolation=cv2.INTER_LINEAR)
    cells = side_px // cell_px
    pairs = np.eye(cells - 1, cells, dtype=np.float32) + np.eye(cells - 1, cells, 1, dtype=np.float32)
    return np.asarray((pairs / 2) @ enlargement.reshape(-1, cell_px, SHANNON_SIDE_PX).mean(axis=1))


def _count_distinct(padded: Array) -> Array:
    """Count the distinct intensities in each disc by unions of 256-bit sets; for shapes see `_combine_over_disc`."""
    bit, word_index = np.left_shift(np.uint64(1), padded & 63, dtype=np.uint64), padded >> 6
    unions = (_combine_over_disc(bit * (word_index == word), np.bitwise_or) for word in range(4))
    return np.asarray(reduce(np.add, (np.bitwise_count(union).astype(np.int16) for union in unions)))


def _compute_shannon_map(small: Array) -> Singles:
    """Compute the Shannon entropy of the disc of every pixel, in bits divided by 8: uint8 (H, W) to float32 (H, W)."""
    padded = np.pad(small.astype(np.int16), DISC_RADIUS_PX, constant_values=-1)  # -1: outside the image
    sums = np.zeros(small.shape, np.float32)
    present = np.flatnonzero(np.bincount(small.ravel()))[:, None, None]
    for start in range(0, len(present), _STRIP_INTENSITIES):
        one_hot = (padded == present[start : start + _STRIP_INTENSITIES]).view(np.uint8)
        sums += _COUNT_LOG2.take(_combine_over_disc(one_hot, np.add)).sum(axis=0)
    in_disc = _combine_over_disc((padded >= 0).view(np.uint8), np.add)
    # -sum p log2 p with p = c/n is log2 n - (sum c log2 c)/n.
    return np.asarray((_COUNT_LOG2[in_disc] - sums) / in_disc / 8)


def _compute_shannon_pixels(small: Bytes, pixels: Bools) -> Singles:
    """Compute `_compute_shannon_map` only at the P True pixels of bool (H, W), each by its histogram: float32 (P,)."""
    r = DISC_RADIUS_PX
    padded = np.pad(small.astype(np.int16), r, constant_values=256)  # 256: outside the image
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
        sums = _COUNT_LOG2.take(counts).sum(axis=1)
        entropy[start : start + _STRIP_PIXELS] = (_COUNT_LOG2[in_disc] - sums) / in_disc / 8
    return entropy


def _combine_over_disc(planes: Array, combine: np.ufunc) -> Array:
    """Combine the values in the disc around each pixel of each plane with an associative ufunc (add, bitwise_or):
    planes padded by the radius r, (..., H + 2r, W + 2r), to (..., H, W)."""
    r, pitch = DISC_RADIUS_PX, planes.shape[-1]
    half_width = [int((r * r - dy * dy) ** 0.5) for dy in range(r + 1)]
    flat = planes.ravel()
    first_centre = r * pitch + r  # index in `flat`
    discs = flat.size - 2 * first_centre
    out = np.empty(planes.shape, planes.dtype)
    disc_values = out.reshape(-1)[:discs]
    disc_values[:] = 0
    row = flat.copy()
    for half in range(r + 1):
        if half:
            combine(row[half:-half], flat[: -2 * half], out=row[half:-half])
            combine(row[half:-half], flat[2 * half :], out=row[half:-half])
        for dy in (dy for dy in range(-r, r + 1) if half_width[abs(dy)] == half):
            start = first_centre + dy * pitch
            combine(disc_values, row[start : start + discs], out=disc_values)
    return out[..., : planes.shape[-2] - 2 * r, : pitch - 2 * r]
