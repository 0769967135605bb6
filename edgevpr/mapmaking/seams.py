"""Straight seams of an orthophoto, where parts of another day or another brightness meet."""

import cv2
import numpy as np
from numpy.lib.stride_tricks import as_strided

from edgevpr.core.arrays import Bools, Floats, Image

WINDOW_PX = 512  # a power of two
# Where parts meet, all of a step is between two pixels; edges of what is on the ground are spread over more.
_HARD = 0.6
_MOST_GREY = 40.0  # of a step, so that a few large ones do not make a line
_BESIDE_PX = 21
# Grey values. Pictures from space have 6 at most, mosaics of two days 11 to 33. 5 of 405 pictures of drones have more
# than this (measured in November 2026 by a script that is no longer in the repository).
_LEAST_GREY = 12.0


def has_seam(image: Image, valid: Bools) -> bool:
    """Say if a straight seam runs through a picture, uint8 (H, W, 3) with sides of up to WINDOW_PX pixels, as they are
    in the file; `valid`, bool (H, W), is False where there is no data."""
    grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY).astype(np.float32)
    turned = (grey, valid), (grey.T, valid.T)
    return any(_strongest(each[:, ::way], seen[:, ::way]) > _LEAST_GREY for each, seen in turned for way in (1, -1))


def _strongest(grey: Floats, valid: Bools) -> float:
    """Return by how much the hard steps along one line, from top to bottom and to the right by at most as much, are
    above those of the lines beside it: their mean, in grey values."""
    rows, columns = grey.shape
    one, three = np.abs(grey[:, 2:-1] - grey[:, 1:-2]), np.abs(grey[:, 3:] - grey[:, :-3])
    seen = valid[:, 3:] & valid[:, 2:-1] & valid[:, 1:-2] & valid[:, :-3]
    # Lines that leave the picture go on in nothing.
    steps = np.zeros((WINDOW_PX, 2 * WINDOW_PX + _BESIDE_PX), np.float32)
    steps[:rows, : columns - 3] = np.minimum(one, _MOST_GREY) * ((one > _HARD * three) & seen)
    along = _line_sums(steps) / WINDOW_PX
    return float((along - cv2.blur(along, (_BESIDE_PX, 1)))[:, : columns - 3].max())


def _line_sums(values: Floats) -> Floats:
    """Return the sums of `values`, float32 (N, W), N a power of two, along lines: float32 (N, W - N + 1), [k, x] along
    the line from (row 0, column x) to (row N - 1, column x + k). Each sum is of those of the line's upper and lower
    half (Goetz and Druckmueller, Pattern Recognition 29(4), 1996)."""
    sums = values[:, None]  # of N lines with one row each
    while len(sums) > 1:
        upper, lower = sums[::2], np.ascontiguousarray(sums[1::2])
        lines, slopes, columns = lower.shape
        of_line, of_slope, of_column = lower.strides
        # The lower half of the line with slope j begins j columns to the right; as a view, without a copy.
        sheared = (lines, slopes, columns - slopes), (of_line, of_slope + of_column, of_column)
        longer = np.empty((lines, 2 * slopes, columns - slopes), np.float32)
        for more in (0, 1):
            np.add(upper[..., : columns - slopes], as_strided(lower[..., more:], *sheared), out=longer[:, more::2])
        sums = longer
    total: Floats = sums[0]
    return total
