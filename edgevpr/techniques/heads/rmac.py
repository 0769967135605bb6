"""R-MAC: regional maxima of a feature map (Tolias, Sicre and Jégou, ICLR 2016)."""

import numpy as np

from edgevpr.core.errors import ModelError
from edgevpr.techniques.heads.vlad import unit

_OVERLAP = 0.4  # wanted, of neighbouring regions (section 3.2)
_SCALES = 3


def square_regions(height: int, width: int) -> list[tuple[int, int, int]]:
    """Return squares (top, left, side) at three scales over a feature map (section 3.2).

    At scale l the squares are 2 min(H, W) / (l + 1) wide. There are l along the short side and l + m - 1 along the long
    one, evenly spaced. m is the number that brings the overlap of two neighbours at the first scale closest to 40 %.
    Raises ModelError for a feature map so small that a square of the last scale is not one activation wide.
    """
    short, long = min(height, width), max(height, width)
    if 2 * short // (_SCALES + 1) < 1:
        raise ModelError(
            f"A feature map of {height}x{width} is too small for the regions of R-MAC: it must be at least 2 wide."
        )
    # A square feature map has one region at the first scale; for others 2 to 7 are tried, as in the authors' code.
    m = 1 if long == short else min(range(2, 8), key=lambda n: abs(1 - (long - short) / (n - 1) / short - _OVERLAP))
    regions = []
    for scale in range(1, _SCALES + 1):
        side = 2 * short // (scale + 1)
        down, across = (scale, scale + m - 1) if height <= width else (scale + m - 1, scale)
        regions += [(top, left, side) for top in _starts(height, side, down) for left in _starts(width, side, across)]
    return regions


def regional_vectors(features: np.ndarray, regions: list[tuple[int, int, int]]) -> np.ndarray:
    """Return the largest activation of each channel in each region, power- and L2-normalised: (C, H, W) to float32
    (R, C).

    The power normalisation is the signed square root, as the thesis uses it (4.2). The paper whitens by PCA instead,
    which would have to be learned.
    """
    vectors = np.stack([features[:, y : y + side, x : x + side].max(axis=(1, 2)) for y, x, side in regions])
    return unit(np.sign(vectors) * np.sqrt(np.abs(vectors))).astype(np.float32, copy=False)


def aggregate(vectors: np.ndarray) -> np.ndarray:
    """Sum the regional vectors and L2-normalise the sum (section 3.2): (R, C) to float32 (C,)."""
    return unit(vectors.sum(axis=0))


def _starts(length: int, side: int, count: int) -> list[int]:
    return [i * (length - side) // max(count - 1, 1) for i in range(count)]
