"""Pooling of a feature map to one vector, for `network` and `regions`. A feature map is float32 (channels, rows,
columns)."""

from collections.abc import Callable

import numpy as np

from edgevpr.core.arrays import Array, Doubles, Singles
from edgevpr.core.errors import ModelError

_TINY = 1e-12
_RMAC_OVERLAP = 0.4  # wanted, of neighbouring squares (Tolias et al. 2016, section 3.2)
_RMAC_SCALES = 3

Square = tuple[int, int, int]  # top, left, side


def unit(vectors: Array) -> Array:
    """Scale rows (or a single vector) to length 1; a zero vector stays zero."""
    unit_vectors: Array = vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), _TINY)
    return unit_vectors


def pyramid(features: Singles, levels: int) -> Singles:
    """Pool the maxima of a spatial pyramid (He et al. 2014, section 2.2): float32 (C, H, W) to float32 (C * sum of
    n^2,), the largest activation of each channel in each cell of one grid of n x n after the other, n = 1 to `levels`.

    Cell i of n covers floor(i H / n) to ceil((i + 1) H / n), so that no activation is left out. The levels 1 to 4 (30
    cells) are those of the public benchmark code of the thesis's author for AMOSNet and HybridNet (Chen et al. 2017),
    which leaves out the row and column between two cells. Raises ModelError for a feature map smaller than a grid.
    """
    _, height, width = features.shape
    if levels > min(height, width):
        raise ModelError(
            f"A feature map of {height}x{width} is too small for a grid of {levels}x{levels}: use fewer levels, or a "
            "network with a larger feature map."
        )
    return np.concatenate(
        [
            features[:, top:bottom, left:right].max(axis=(1, 2))
            for n in range(1, levels + 1)
            for top, bottom in _cells(height, n)
            for left, right in _cells(width, n)
        ]
    )


def gaussian_projection(size: int, length: int, seed: int) -> Callable[[Singles], Singles]:
    """Make a Gaussian random projection of float32 of `size` values in any shape to float32 (length,), in a form that
    fits a small board. It keeps the Euclidean length on average. The same `seed` always gives the same projection.

    A matrix of Gaussian values keeps the angles between vectors. For the 43 008 activations of CALC and 1064 dimensions
    it takes 183 MB. Here its rows are the cyclic shifts of *one* Gaussian vector, applied after a random sign for each
    activation (Hinrichs and Vybíral 2011): angles are kept as well, and the product is a correlation, which the Fourier
    transform computes in a twentieth of the time. Raises ModelError if `length` is larger than `size`.
    """
    if length > size:
        raise ModelError(
            f"A feature map of {size} values cannot be projected to {length} dimensions: ask for at most {size}."
        )
    row, signs = gaussian_row(size, seed)
    spectrum = np.conj(np.fft.rfft(row))  # row j of the matrix is the Gaussian vector shifted by j: a correlation

    def projected(features: Singles) -> Singles:
        shifted = np.fft.irfft(spectrum * np.fft.rfft(features.ravel() * signs, size), size)
        return np.asarray(shifted[:length] / np.sqrt(length), np.float32)

    return projected


def gaussian_row(size: int, seed: int) -> tuple[Doubles, Singles]:
    """Make the Gaussian vector float64 (size,) and the signs float32 (size,), +1 or -1, of a seed.

    The same seed must give the same matrix for as long as a map is used. NumPy promises that for the raw numbers of its
    bit generators, not for `standard_normal` (NEP 19). So both come from the raw 64-bit numbers of PCG64: first two for
    each pair of Gaussian values (Box and Muller 1958), then one for each sign.
    """
    pairs = -(-size // 2)
    raw = np.random.PCG64(seed).random_raw(2 * pairs + size)
    uniform = ((raw[: 2 * pairs] >> np.uint64(11)) + 0.5) * 2.0**-53  # never 0
    radius = np.sqrt(-2 * np.log(uniform[:pairs]))
    angle = 2 * np.pi * uniform[pairs:]
    row = np.concatenate([radius * np.cos(angle), radius * np.sin(angle)])[:size]
    signs = np.where(raw[2 * pairs :] >> np.uint64(63), np.float32(1), np.float32(-1))
    return row, signs


def square_regions(height: int, width: int) -> list[Square]:
    """Return the squares of R-MAC at three scales over a feature map (Tolias et al. 2016, section 3.2), in its cells.

    At scale l the squares are 2 min(H, W) / (l + 1) wide. There are l along the short side and l + m - 1 along the long
    one, evenly spaced. m is the number that brings the overlap of two neighbours at the first scale closest to 40 %.
    Raises ModelError for a feature map less than 2 wide.
    """
    short, long = min(height, width), max(height, width)
    if 2 * short // (_RMAC_SCALES + 1) < 1:
        raise ModelError(
            f"A feature map of {height}x{width} is too small for the regions of R-MAC: it must be at least 2 wide."
        )
    # A square feature map has one region at the first scale; for others 2 to 7 are tried, as in the authors' code.
    m = (
        1
        if long == short
        else min(range(2, 8), key=lambda n: abs(1 - (long - short) / (n - 1) / short - _RMAC_OVERLAP))
    )
    regions = []
    for scale in range(1, _RMAC_SCALES + 1):
        side = 2 * short // (scale + 1)
        down, across = (scale, scale + m - 1) if height <= width else (scale + m - 1, scale)
        regions += [(top, left, side) for top in _starts(height, side, down) for left in _starts(width, side, across)]
    return regions


def regional_vectors(features: Singles, regions: list[Square]) -> Singles:
    """Return the largest activation of each channel in each of R squares, of length 1: (C, H, W) to float32 (R, C). The
    signed square root is taken first, the power normalisation of the thesis (4.2); the paper whitens by PCA."""
    vectors = np.stack([features[:, y : y + side, x : x + side].max(axis=(1, 2)) for y, x, side in regions])
    return unit(np.sign(vectors) * np.sqrt(np.abs(vectors)))


def _starts(length: int, side: int, count: int) -> list[int]:
    return [i * (length - side) // max(count - 1, 1) for i in range(count)]


def _cells(length: int, count: int) -> list[tuple[int, int]]:
    return [(i * length // count, -(-(i + 1) * length // count)) for i in range(count)]
