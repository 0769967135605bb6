"""The displacement vote: regions that belong to the same place have all moved the same way.

Every asking region finds its best region in the reference; the step between the two, in cells, is one vote. Where the
place is the same the votes pile up on one step, where it is another they scatter. The share of the votes at the peak
is the score: a share of agreeing regions, which a mean of cosines is not.
"""

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np


@dataclass(frozen=True, slots=True)
class Displacement:
    """`share` (0..1) of the regions agrees on the step `shift_cells` (dx, dy), from the query to the reference;
    `covariance_cells2` (var x, cov xy, var y) is that of the votes around the peak."""

    share: float
    shift_cells: tuple[float, float]
    covariance_cells2: tuple[float, float, float]


_NOTHING = Displacement(0.0, (0.0, 0.0), (0.0, 0.0, 0.0))


def displacement(asking: np.ndarray, best: np.ndarray, side: int, window: int) -> Displacement:
    """Count the votes of regions on a grid of `side` x `side`.

    `asking` and `best` are int (G,): each asking region, and the region of the reference that is most like it, both
    numbered row by row. The peak is the `window` x `window` (odd) square of steps with the most votes.
    """
    if not len(asking):
        return _NOTHING
    # Both numbers in rows as wide as the steps are many: the difference is the number of the step.
    wide = 2 * side - 1
    number = _numbers(side, wide)
    step = number[best] - number[asking] + (side - 1) * (wide + 1)
    votes = np.bincount(step, minlength=wide * wide).reshape(wide, wide).astype(np.float32)
    around = cv2.boxFilter(votes, -1, (window, window), normalize=False, borderType=cv2.BORDER_CONSTANT)
    peak_y, peak_x = divmod(int(around.argmax()), wide)
    half = window // 2
    top, left = max(peak_y - half, 0), max(peak_x - half, 0)
    agreeing = votes[top : peak_y + half + 1, left : peak_x + half + 1]
    count = float(agreeing.sum())
    shares_x, shares_y = agreeing.sum(axis=0) / count, agreeing.sum(axis=1) / count
    x, y = np.arange(len(shares_x)), np.arange(len(shares_y))
    mean_x, mean_y = float(shares_x @ x), float(shares_y @ y)
    # A step is known to a cell at best: 1/12 is the variance within one.
    covariance = (
        float(shares_x @ (x - mean_x) ** 2) + 1 / 12,
        float((y - mean_y) @ agreeing @ (x - mean_x)) / count,
        float(shares_y @ (y - mean_y) ** 2) + 1 / 12,
    )
    shift = (left + mean_x - (side - 1), top + mean_y - (side - 1))
    return Displacement(count / len(asking), shift, covariance)


@lru_cache
def _numbers(side: int, wide: int) -> np.ndarray:
    """The numbers of `side` x `side` regions in a grid that is `wide` wide."""
    return np.add.outer(np.arange(side) * wide, np.arange(side)).ravel()
