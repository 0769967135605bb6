"""How much an image says, pixel by pixel: the two entropy maps of CoHOG (thesis 6.2.1), both in 0..1.

Both look at the histogram of the intensities inside a disc around each pixel (81 pixels for radius 5), counting only
pixels inside the image, and divide by the 8 bits that 256 intensities could say.
"""

from collections.abc import Callable

import cv2
import numpy as np

DISC_RADIUS_PX = 5
SHANNON_SIDE_PX = 100  # the authors' public code takes the Shannon entropy of a copy of this size
_STRIP_ROWS = 32  # rows done at once, so that the bit sets stay in cache


def filled_bins(grey: np.ndarray, radius_px: int = DISC_RADIUS_PX) -> np.ndarray:
    """log2 of the number of different intensities in each disc, over 8: the algorithm printed in thesis 6.2.1.

    `grey` is uint8 (H, W); returns float32 (H, W). The set of intensities of a pixel is 256 bits in four words, so
    that the disc is a union of bit sets and the number is a count of bits.
    """
    height, width = grey.shape
    log2_of = np.log2(np.arange(1, 257, dtype=np.float32)) / 8
    words = np.zeros((4, height + 2 * radius_px, width + 2 * radius_px), np.uint64)
    bit = np.uint64(1) << (grey & 63).astype(np.uint64)
    inside = words[:, radius_px : radius_px + height, radius_px : radius_px + width]
    for word in range(4):
        np.copyto(inside[word], bit, where=(grey >> 6) == word)
    entropy = np.empty((height, width), np.float32)
    for top in range(0, height, _STRIP_ROWS):
        bottom = min(top + _STRIP_ROWS, height)
        filled = over_disc(words[:, top : bottom + 2 * radius_px], radius_px, np.bitwise_or)
        entropy[top:bottom] = log2_of[np.bitwise_count(filled).sum(axis=0, dtype=np.intp) - 1]
    return entropy


def shannon(grey: np.ndarray, radius_px: int = DISC_RADIUS_PX) -> np.ndarray:
    """Shannon entropy (bits) of the intensities in each disc, over 8, from a 100x100 copy scaled back up.

    This is what the authors' public code computes where the thesis's text has `filled_bins`. `grey` is uint8 (H, W);
    returns float32 (H, W).
    """
    height, width = grey.shape
    small = cv2.resize(grey, (SHANNON_SIDE_PX, SHANNON_SIDE_PX), interpolation=cv2.INTER_LINEAR)
    padded = np.pad(small.astype(np.int16), radius_px, constant_values=-1)  # -1: outside, no intensity
    one_hot = (padded == np.unique(small)[:, None, None]).view(np.uint8)
    counts = over_disc(one_hot, radius_px, np.add)
    in_disc = counts.sum(axis=0, dtype=np.intp)
    count = np.arange(in_disc.max() + 1, dtype=np.float32)
    count_log2 = count * np.log2(np.maximum(count, 1))
    # -sum p log2 p with p = c/n is log2 n - (sum c log2 c)/n.
    entropy = (count_log2[in_disc] - count_log2[counts].sum(axis=0)) / in_disc / 8
    return cv2.resize(entropy.astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR)


def over_disc(planes: np.ndarray, radius_px: int, combine: Callable[..., np.ndarray]) -> np.ndarray:
    """Combine every plane over a disc by an associative ufunc whose identity is 0 (add, bitwise_or).

    `planes` is (P, H + 2r, W + 2r), padded with zeros; returns (P, H, W). The disc is a stack of rows: each row is
    widened once for all rows of the disc that have its width.
    """
    r = radius_px
    height, width = planes.shape[1] - 2 * r, planes.shape[2] - 2 * r
    half_width = [int((r * r - dy * dy) ** 0.5) for dy in range(r + 1)]
    out = None
    row = planes[:, :, r : r + width].copy()  # the window of half width 0 around each pixel
    for half in range(r + 1):
        if half:
            combine(row, planes[:, :, r - half : r - half + width], out=row)
            combine(row, planes[:, :, r + half : r + half + width], out=row)
        for dy in (dy for dy in range(-r, r + 1) if half_width[abs(dy)] == half):
            window = row[:, r + dy : r + dy + height]
            out = window.copy() if out is None else combine(out, window, out=out)
    return out
