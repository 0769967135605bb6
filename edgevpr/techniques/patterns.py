"""Blocks of 2x2 cells in fewer numbers: the slow patterns of a block, which hold most of what there is to compare.

A block is four histograms. Written as waves, over the cells (their mean, left against right, top against bottom, and
diagonal against diagonal) and over the orientations (the frequencies of a Fourier series), its power lies mostly in
the slow ones. Of the 32 patterns of 8 orientations the 20 are kept that had the most of it on the sets tuned on: the
product that compares all blocks with all blocks has so much less to do, and recall does not fall.
"""

from functools import lru_cache

import numpy as np

# Over the cells top left, top right, bottom left, bottom right, and the frequencies over the orientations that go with
# it (None: all).
_KEPT = (
    ((1, 1, 1, 1), None),
    ((1, -1, 1, -1), (0, 1, 2)),
    ((1, 1, -1, -1), (0, 1, 2)),
    ((1, -1, -1, 1), (1,)),
)


@lru_cache
def slow_patterns(bins: int) -> np.ndarray:
    """The kept patterns of blocks of 2x2 cells of `bins` orientations, each of length 1 and at right angles to all
    others: float32 (4 bins, patterns)."""
    frequency, waves = _waves(bins)
    return np.vstack(
        [
            np.kron(np.array(cells) / 2, wave)
            for cells, kept in _KEPT
            for at, wave in zip(frequency, waves, strict=True)
            if kept is None or at in kept
        ]
    ).T.astype(np.float32, order="C")


def _waves(bins: int) -> tuple[np.ndarray, np.ndarray]:
    """The real Fourier series over `bins` orientations: the frequency of each wave, and the waves (bins, bins), each
    of length 1."""
    turn = 2 * np.pi * np.arange(bins) / bins
    number = np.arange(bins)
    frequency = (number + 1) // 2
    # The constant, then cosine and sine of each frequency; the highest of an even number of bins has a cosine only.
    waves = np.cos(frequency[:, None] * turn - np.pi / 2 * (number[:, None] % 2 == 0) * (number[:, None] > 0))
    return frequency, waves / np.linalg.norm(waves, axis=1, keepdims=True)
