"""Pooling of a feature map to one vector. A feature map is float32 (channels, height, width) throughout."""

import numpy as np

from edgevpr.core.errors import ModelError


def flatten(features: np.ndarray) -> np.ndarray:
    """Return all activations one after the other: (C, H, W) to float32 (C * H * W,)."""
    return np.ascontiguousarray(features, np.float32).ravel()


def maximum(features: np.ndarray) -> np.ndarray:
    """Compute MAC, the largest activation of each channel (Tolias et al. 2016, equation 1): (C, H, W) to float32
    (C,)."""
    return features.max(axis=(1, 2)).astype(np.float32, copy=False)


def gem(features: np.ndarray, p: float = 3.0) -> np.ndarray:
    """Compute the generalised mean of each channel (Radenović et al. 2018, equation 3): (C, H, W) to float32 (C,).

    p = 1 is the mean, p towards infinity the maximum. Activations below 1e-6 count as 1e-6, so that any p is defined.
    Each channel is divided by its maximum first: the result is the same, and no power leaves the range of float32.
    """
    positive = np.maximum(features, 1e-6)
    largest = positive.max(axis=(1, 2))
    shares = positive / largest[:, None, None]
    return (largest * np.mean(shares**p, axis=(1, 2)) ** (1 / p)).astype(np.float32, copy=False)


def grid(features: np.ndarray, rows: int, columns: int, how: str = "mean") -> np.ndarray:
    """Pool ("mean" or "max") over each cell of a grid: (C, H, W) to float32 (rows * columns * C,), cell by cell.

    Cell i of n covers floor(i H / n) to ceil((i + 1) H / n) (He et al. 2014, section 2.2), so that no activation is
    left out and no cell is empty. Raises ModelError for a feature map with fewer rows or columns than the grid.
    """
    _, height, width = features.shape
    if rows > height or columns > width:
        raise ModelError(
            f"A feature map of {height}x{width} is too small for a grid of {rows}x{columns}: use a coarser grid or a "
            "network with a larger feature map."
        )
    reduce = {"mean": np.mean, "max": np.max}[how]
    cells = [
        reduce(features[:, top:bottom, left:right], axis=(1, 2))
        for top, bottom in _cells(height, rows)
        for left, right in _cells(width, columns)
    ]
    return np.concatenate(cells).astype(np.float32, copy=False)


def pyramid(features: np.ndarray, levels: tuple[int, ...] = (1, 2, 3, 4)) -> np.ndarray:
    """Pool the maxima of a spatial pyramid (He et al. 2014, section 2.2): grids of n x n cells for each n of `levels`,
    one after the other: (C, H, W) to float32 (sum of n^2, times C,).

    The levels 1 to 4 (30 cells) are those of the public benchmark code of the thesis's author for AMOSNet and HybridNet
    (Chen et al. 2017). That code leaves out the row and column between two cells; here nothing is left out. Raises
    ModelError for a feature map smaller than the finest level.
    """
    return np.concatenate([grid(features, n, n, "max") for n in levels])


def _cells(length: int, count: int) -> list[tuple[int, int]]:
    return [(i * length // count, -(-(i + 1) * length // count)) for i in range(count)]
