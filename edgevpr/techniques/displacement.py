"""The displacement vote: regions that belong to the same place have all moved the same way.

Every asking region finds its best region in the reference; the step between the two, in cells, is one vote. Where the
place is the same the votes pile up on one step, where it is another they scatter. The share of the votes at the peak
says how well: a share of agreeing regions, which a mean of cosines is not.
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


def displacement(asking: np.ndarray, best: np.ndarray, side: int, counts: tuple[float, ...]) -> Displacement:
    """Count the votes of regions on a grid of `side` x `side`.

    `asking` and `best` are int (G,): each asking region, and the region of the reference that is most like it, both
    numbered row by row. The peak is the step with the most votes about it, where a vote that is n cells off, along the
    rows or along the columns, counts `counts[n]`, and further off nothing.
    """
    if not len(asking):
        return _NOTHING
    # Both numbers in rows as wide as the steps are many: the difference is the number of the step. Around the steps
    # that there are, room for the square about the peak.
    room = len(counts) - 1
    wide = 2 * (side - 1 + room) + 1
    number = _numbers(side, wide)
    step = number[best] - number[asking] + wide // 2 * (wide + 1)
    votes = np.bincount(step, minlength=wide * wide).reshape(wide, wide).astype(np.float32)
    weights = _weights(counts)
    around = cv2.filter2D(votes, -1, weights, borderType=cv2.BORDER_CONSTANT)[room : wide - room, room : wide - room]
    peak_y, peak_x = divmod(int(around.argmax()), 2 * side - 1)
    agreeing = votes[peak_y : peak_y + len(weights), peak_x : peak_x + len(weights)] * weights
    count = float(agreeing.sum())
    shares_x, shares_y = agreeing.sum(axis=0) / count, agreeing.sum(axis=1) / count
    off = np.arange(-room, room + 1)
    mean_x, mean_y = float(shares_x @ off), float(shares_y @ off)
    # A step is known to a cell at best: 1/12 is the variance within one.
    covariance = (
        float(shares_x @ (off - mean_x) ** 2) + 1 / 12,
        float((off - mean_y) @ agreeing @ (off - mean_x)) / count,
        float(shares_y @ (off - mean_y) ** 2) + 1 / 12,
    )
    shift = (peak_x - (side - 1) + mean_x, peak_y - (side - 1) + mean_y)
    return Displacement(count / len(asking), shift, covariance)


@lru_cache
def _numbers(side: int, wide: int) -> np.ndarray:
    """The numbers of `side` x `side` regions in a grid that is `wide` wide."""
    return np.add.outer(np.arange(side) * wide, np.arange(side)).ravel()


@lru_cache
def _weights(counts: tuple[float, ...]) -> np.ndarray:
    """What a vote counts, by how far it is off: float32 (2 n - 1, 2 n - 1) for n counts."""
    off = np.abs(np.arange(1 - len(counts), len(counts)))
    return np.array(counts, np.float32)[np.maximum.outer(off, off)]
