"""How much an image says, pixel by pixel: the two entropy maps of CoHOG (thesis 6.2.1), both in 0..1.

Both look at the histogram of the intensities inside a disc around each pixel (81 pixels for radius 5), counting only
pixels inside the image, and divide by the 8 bits that 256 intensities could say. `good_blocks` answers the only
question that CoHOG asks of such a map, mostly without making the map.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

DISC_RADIUS_PX = 5
SHANNON_SIDE_PX = 100  # the authors' public code takes the Shannon entropy of a copy of this size
# How much is done at once, so that what is summed stays in cache.
_STRIP_ROWS = 32
_STRIP_CELLS = 32
_STRIP_PIXELS = 256
_STRIP_INTENSITIES = 16
_ROUNDING = 1e-5  # more than float32 rounding can move the mean entropy of a block
_LOG2 = np.log2(np.arange(257, dtype=np.float32).clip(1))
_LOG2_OVER_8 = _LOG2 / 8
_COUNT_LOG2 = np.arange(256, dtype=np.float32) * _LOG2[:256]


def filled_bins(grey: np.ndarray, radius_px: int = DISC_RADIUS_PX) -> np.ndarray:
    """log2 of the number of different intensities in each disc, over 8: the algorithm printed in thesis 6.2.1.

    `grey` is uint8 (H, W); returns float32 (H, W).
    """
    padded = _replicated(grey, radius_px)
    entropy = np.empty(grey.shape, np.float32)
    for top in range(0, len(grey), _STRIP_ROWS):
        strip = padded[top : top + _STRIP_ROWS + 2 * radius_px]
        entropy[top : top + _STRIP_ROWS] = _LOG2_OVER_8[_different(strip, radius_px)]
    return entropy


def shannon(grey: np.ndarray, radius_px: int = DISC_RADIUS_PX) -> np.ndarray:
    """Shannon entropy (bits) of the intensities in each disc, over 8, from a 100x100 copy scaled back up.

    This is what the authors' public code computes where the thesis's text has `filled_bins`. `grey` is uint8 (H, W);
    returns float32 (H, W).
    """
    height, width = grey.shape
    small = _shannon_copy(grey)
    return cv2.resize(_shannon_of(small, radius_px), (width, height), interpolation=cv2.INTER_LINEAR)


def block_means(per_pixel: np.ndarray, cell_px: int) -> np.ndarray:
    """Mean over every block of 2x2 cells, stride one cell: float32 (H, W) -> (H/cell_px - 1, W/cell_px - 1)."""
    cell = _cell_means(per_pixel, cell_px)
    return (cell[:-1, :-1] + cell[:-1, 1:] + cell[1:, :-1] + cell[1:, 1:]) / 4


def good_blocks(grey: np.ndarray, which: str, cell_px: int, threshold: float) -> np.ndarray:
    """The goodness of thesis 6.2.1: bool, `block_means(filled_bins(grey), cell_px) >= threshold`, or of `shannon`.

    Nearly every block is decided by bounds of its entropy that cost a tenth of the map; only what the others cover is
    looked at in full. `grey` is uint8 (H, W) with sides that are multiples of `cell_px`.
    """
    bounds = _BOUNDS[which](grey, cell_px)
    low = bounds.low
    undecided = (bounds.blocks(low) < threshold + _ROUNDING) & (bounds.blocks(bounds.high) >= threshold - _ROUNDING)
    if undecided.any():
        matters = (bounds.down.T @ undecided @ bounds.across > 0) & (low < bounds.high)
        low[matters] = bounds.exact(matters)
        if (np.abs(bounds.blocks(low)[undecided] - threshold) < _ROUNDING).any():
            return block_means(_MAPS[which](grey), cell_px) >= threshold
    return bounds.blocks(low) >= threshold


@dataclass(frozen=True, slots=True, kw_only=True)
class _Bounds:
    """What an entropy is at least and at most, float32 (h, w) on some grid over the image. `down` (rows, h) and
    `across` (cols, w), nowhere negative, make the means of the blocks; `exact` tells the entropy at the points of a
    bool (h, w)."""

    low: np.ndarray
    high: np.ndarray
    down: np.ndarray
    across: np.ndarray
    exact: Callable[[np.ndarray], np.ndarray]

    def blocks(self, values: np.ndarray) -> np.ndarray:
        return self.down @ values @ self.across.T


def _bound_filled_bins(grey: np.ndarray, cell_px: int) -> _Bounds:
    """Bounds of the mean of `filled_bins` over each cell, from the last six bits of the intensities.

    n intensities never have more than n different endings; and where all of a neighbourhood lie within 64 k values,
    at most k of them share one.
    """
    r = DISC_RADIUS_PX
    padded = _replicated(grey, r)
    at_least = np.empty(grey.shape, np.uint8)
    for top in range(0, len(grey), _STRIP_ROWS):
        endings = over_disc(_bit(padded[top : top + _STRIP_ROWS + 2 * r]), r, np.bitwise_or)
        at_least[top : top + _STRIP_ROWS] = np.bitwise_count(endings)
    at_most = cv2.multiply(at_least, (_range(grey) >> 6) + 1)  # stops at 255

    def exact(cells: np.ndarray) -> np.ndarray:
        side = cell_px + 2 * r
        patches = np.lib.stride_tricks.sliding_window_view(padded, (side, side))[::cell_px, ::cell_px][cells]
        means = np.empty(len(patches), np.float32)
        for start in range(0, len(patches), _STRIP_CELLS):
            strip = slice(start, start + _STRIP_CELLS)
            means[strip] = _LOG2_OVER_8[_different(patches[strip], r)].mean(axis=(1, 2))
        return means

    low, high = (_cell_means(cv2.LUT(number, _LOG2_OVER_8[:256]), cell_px) for number in (at_least, at_most))
    down, across = (_pairs(side // cell_px) for side in grey.shape)
    return _Bounds(low=low, high=high, down=down, across=across, exact=exact)


def _bound_shannon(grey: np.ndarray, cell_px: int) -> _Bounds:
    """Bounds of `shannon` at each pixel of the copy, from the last four bits of the intensities.

    To know only the ending says less, never more; and where all of a neighbourhood lie within 16 k values, to know
    the rest as well says at most log2 k bits more.
    """
    small = _shannon_copy(grey)
    low = _shannon_of(small & 15, DISC_RADIUS_PX)
    high = low + _LOG2_OVER_8[(_range(small) >> 4) + 1]

    def exact(pixels: np.ndarray) -> np.ndarray:
        return _shannon_at(small, pixels, DISC_RADIUS_PX)

    down, across = (_scaled_pairs(side, cell_px) for side in grey.shape)
    return _Bounds(low=low, high=high, down=down, across=across, exact=exact)


_MAPS = {"filled_bins": filled_bins, "shannon": shannon}
_BOUNDS = {"filled_bins": _bound_filled_bins, "shannon": _bound_shannon}


def _cell_means(per_pixel: np.ndarray, cell_px: int) -> np.ndarray:
    height, width = per_pixel.shape
    return cv2.resize(per_pixel, (width // cell_px, height // cell_px), interpolation=cv2.INTER_AREA)


def _shannon_copy(grey: np.ndarray) -> np.ndarray:
    # Exact: the plain one differs by a grey level between processors, and a map must fly on any of them.
    return cv2.resize(grey, (SHANNON_SIDE_PX, SHANNON_SIDE_PX), interpolation=cv2.INTER_LINEAR_EXACT)


@lru_cache(maxsize=4)
def _pairs(cells: int) -> np.ndarray:
    """float32 (cells - 1, cells): the mean of each cell and the next."""
    return (np.eye(cells - 1, cells, dtype=np.float32) + np.eye(cells - 1, cells, 1, dtype=np.float32)) / 2


@lru_cache(maxsize=4)
def _scaled_pairs(side_px: int, cell_px: int) -> np.ndarray:
    """float32 (cells - 1, SHANNON_SIDE_PX): `_pairs` of what the copy becomes when it is scaled back up."""
    unit = np.eye(SHANNON_SIDE_PX, dtype=np.float32)
    back = cv2.resize(unit, (SHANNON_SIDE_PX, side_px), interpolation=cv2.INTER_LINEAR)
    return _pairs(side_px // cell_px) @ back.reshape(-1, cell_px, SHANNON_SIDE_PX).mean(axis=1)


def _range(grey: np.ndarray) -> np.ndarray:
    """Largest minus smallest intensity in the square around each disc."""
    square = np.ones((2 * DISC_RADIUS_PX + 1,) * 2, np.uint8)
    return cv2.subtract(cv2.dilate(grey, square), cv2.erode(grey, square))


def _replicated(grey: np.ndarray, radius_px: int) -> np.ndarray:
    """`grey` with its border repeated outwards, which adds no intensity to any disc: a pixel outside takes the value
    of the one inside that is nearest to it, and that one is nearer to the middle of the disc."""
    r = radius_px
    return cv2.copyMakeBorder(grey, r, r, r, r, cv2.BORDER_REPLICATE)


def _bit(grey: np.ndarray) -> np.ndarray:
    """The set of one intensity, by its last six bits, as one bit of a word."""
    return np.left_shift(np.uint64(1), grey & 63, dtype=np.uint64)


def _different(padded: np.ndarray, radius_px: int) -> np.ndarray:
    """Number of different intensities in each disc: uint8 (..., H + 2r, W + 2r) -> int16 (..., H, W).

    The set of intensities of a pixel is 256 bits in four words, so that the disc is a union of bit sets and the number
    is a count of bits.
    """
    bit, word_of = _bit(padded), padded >> 6
    unions = (over_disc(bit * (word_of == word), radius_px, np.bitwise_or) for word in range(4))
    return sum(np.bitwise_count(union).astype(np.int16) for union in unions)


def _shannon_of(small: np.ndarray, radius_px: int) -> np.ndarray:
    """Shannon entropy over 8 of the disc of every pixel: uint8 (H, W) -> float32 (H, W)."""
    padded = np.pad(small.astype(np.int16), radius_px, constant_values=-1)  # -1: outside, no intensity
    said = np.zeros(small.shape, np.float32)
    present = np.flatnonzero(np.bincount(small.ravel()))[:, None, None]
    for start in range(0, len(present), _STRIP_INTENSITIES):
        one_hot = (padded == present[start : start + _STRIP_INTENSITIES]).view(np.uint8)
        counts = over_disc(one_hot, radius_px, np.add)
        said += _COUNT_LOG2.take(counts).sum(axis=0)
    in_disc = over_disc((padded >= 0).view(np.uint8), radius_px, np.add)
    # -sum p log2 p with p = c/n is log2 n - (sum c log2 c)/n.
    return (_COUNT_LOG2[in_disc] - said) / in_disc / 8


def _shannon_at(small: np.ndarray, pixels: np.ndarray, radius_px: int) -> np.ndarray:
    """`_shannon_of` at the pixels of a bool (H, W): float32, one a pixel, each from its own histogram."""
    r = radius_px
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
        said = _COUNT_LOG2.take(counts).sum(axis=1)
        entropy[start : start + _STRIP_PIXELS] = (_COUNT_LOG2[in_disc] - said) / in_disc / 8
    return entropy


def over_disc(planes: np.ndarray, radius_px: int, combine: np.ufunc) -> np.ndarray:
    """Combine every plane over a disc by an associative ufunc (add, bitwise_or): (..., H + 2r, W + 2r) -> (..., H, W).

    The disc is a stack of rows: each row is widened once for all rows of the disc that have its width. All planes are
    one flat array here; a row runs on into the next, but all that this spoils lies in the padding.
    """
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
