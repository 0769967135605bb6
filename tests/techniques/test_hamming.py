"""The scan of binary vectors, against a count bit by bit."""

import numpy as np
import pytest

from edgevpr.techniques.vectors import hamming


@pytest.mark.parametrize(
    ("places", "length"), [(37, 8), (37, 136), (20_001, 64), (3, 8184), (40, 17_864), (0, 64), (1, 64)]
)
def test_every_bit_that_differs_counts(places, length):
    rng = np.random.default_rng(length)
    query, wide = rng.integers(0, 256, length, np.uint8), rng.integers(0, 256, (places, length + 3), np.uint8)
    codes = wide[:, 3:]
    distances = hamming(query, codes)
    assert distances.dtype == (np.uint16 if length < 8192 else np.uint32)
    np.testing.assert_array_equal(distances, (np.unpackbits(query) != np.unpackbits(codes, axis=1)).sum(axis=1))


def test_opposite_vectors_differ_in_all_bits_and_equal_ones_in_none():
    zeros = np.zeros(136, np.uint8)
    np.testing.assert_array_equal(hamming(zeros, np.stack([zeros, ~zeros])), [0, 8 * 136])
