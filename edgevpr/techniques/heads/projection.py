"""Gaussian random projection to fewer dimensions, in a form that fits a small board.

A matrix of Gaussian values keeps the angles between vectors to about 1 / sqrt(dimensions). For the 43 008 activations
of CALC and 1064 dimensions it takes 183 MB (46 MB in 8 bits), and drawing it anew for each picture takes far longer
than the network. Here its rows are the cyclic shifts of *one* Gaussian vector, applied after a random sign for each
activation (Hinrichs and Vybíral 2011). Each row is still Gaussian, and angles are kept as well. The matrix is two
vectors (0.5 MB). The product is a correlation, which the Fourier transform computes in a twentieth of the time.

The same seed must give the same matrix for as long as a map is used. NumPy promises that for the raw numbers of its bit
generators, not for `standard_normal` (NEP 19). So the Gaussian values are made of raw PCG64 numbers here.
"""

from dataclasses import dataclass

import numpy as np

from edgevpr.core.errors import ModelError


@dataclass(frozen=True, slots=True)
class Projection:
    """A projection: `spectrum` complex128 (n // 2 + 1,) of the Gaussian row, `signs` float32 (n,), `length` of the
    result."""

    spectrum: np.ndarray
    signs: np.ndarray
    length: int

    def __call__(self, vector: np.ndarray) -> np.ndarray:
        """Project float32 (n,) to float32 (length,); the Euclidean length is kept on average."""
        size = len(self.signs)
        shifted = np.fft.irfft(self.spectrum * np.fft.rfft(vector * self.signs, size), size)
        return (shifted[: self.length] / np.sqrt(self.length)).astype(np.float32)


def gaussian_projection(size: int, length: int, seed: int) -> Projection:
    """Make the projection from `size` to `length` values that belongs to `seed`.

    Raises ModelError if `length` is larger than `size`.
    """
    if length > size:
        raise ModelError(
            f"A feature map of {size} values cannot be projected to {length} dimensions: ask for at most {size}."
        )
    row, signs = gaussian_row(size, seed)
    # Row j of the matrix is the Gaussian vector shifted by j. The product is a correlation, hence the conjugate.
    return Projection(np.conj(np.fft.rfft(row)), signs, length)


def gaussian_row(size: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Make the Gaussian vector float64 (size,) and the signs float32 (size,) of a seed.

    Both come from the raw 64-bit numbers of PCG64: first two for each pair of Gaussian values (Box and Muller 1958),
    then one for each sign.
    """
    pairs = -(-size // 2)
    raw = np.random.PCG64(seed).random_raw(2 * pairs + size)
    uniform = ((raw[: 2 * pairs] >> np.uint64(11)) + 0.5) * 2.0**-53  # never 0
    radius = np.sqrt(-2 * np.log(uniform[:pairs]))
    angle = 2 * np.pi * uniform[pairs:]
    row = np.concatenate([radius * np.cos(angle), radius * np.sin(angle)])[:size]
    signs = np.where(raw[2 * pairs :] >> np.uint64(63), np.float32(1), np.float32(-1))
    return row, signs
