"""The displacement vote: regions that belong to the same place have all moved the same way.

Every asking region finds its best region in the reference; the step between the two, in cells, is one vote. Where the
place is the same the votes pile up on one step, where it is another they scatter. The share of the votes at the peak
is the score: a share of agreeing regions, which a mean of cosines is not.
"""

from dataclasses import dataclass

import cv2
import numpy as np


@dataclass(frozen=True, slots=True)
class Displacement:
    """`share` (0..1) of the regions agrees on the step `shift_cells` (dx, dy), from the query to the reference;
    `covariance_cells2` (var x, cov xy, var y) is that of the votes around the peak."""

    share: float
    shift_cells: tuple[float, float]
    covariance_cells2: tuple[float, float, float]


def displacement(asking: np.ndarray, best: np.ndarray, side: int, window: int) -> Displacement:
    """Count the votes of regions on a grid of `side` x `side`.

    `asking` and `best` are int (G,): each asking region, and the region of the reference that is most like it, both
    numbered row by row. The peak is the `window` x `window` (odd) square of steps with the most votes.
    """
    if not len(asking):
        return Displacement(0.0, (0.0, 0.0), (0.0, 0.0, 0.0))
    dy, dx = best // side - asking // side, best % side - asking % side
    reach = side - 1
    votes = np.bincount((dy + reach) * (2 * side - 1) + dx + reach, minlength=(2 * side - 1) ** 2)
    votes = votes.reshape(2 * side - 1, 2 * side - 1).astype(np.float32)
    around = cv2.boxFilter(votes, -1, (window, window), normalize=False, borderType=cv2.BORDER_CONSTANT)
    peak_y, peak_x = np.unravel_index(around.argmax(), around.shape)
    agree = (abs(dy + reach - peak_y) <= window // 2) & (abs(dx + reach - peak_x) <= window // 2)
    x, y = dx[agree], dy[agree]
    # A step is known to a cell at best: 1/12 is the variance within one.
    covariance = (float(x.var()) + 1 / 12, float(np.mean((x - x.mean()) * (y - y.mean()))), float(y.var()) + 1 / 12)
    return Displacement(len(x) / len(asking), (float(x.mean()), float(y.mean())), covariance)
