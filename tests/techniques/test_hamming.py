import numpy as np
import pytest

from edgevpr.techniques import vectors as scans


def _random(places: int, length: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(length)
    return rng.integers(0, 256, length, dtype=np.uint8), rng.integers(0, 256, (places, length), dtype=np.uint8)


def _bit_by_bit(query: np.ndarray, codes: np.ndarray) -> np.ndarray:
    return (np.unpackbits(query) != np.unpackbits(codes, axis=1)).sum(axis=1)


@pytest.fixture(params=["numpy", "simd"])
def scan(request):
    if request.param == "simd" and scans.simsimd is None:
        pytest.skip("the optional library simsimd is not installed")
    return {"numpy": scans.hamming_numpy, "simd": scans.hamming_simd}[request.param]


@pytest.mark.parametrize("length", [1, 2, 5, 8, 12, 63, 64, 65, 72, 113, 900, 8191])
def test_every_bit_that_differs_counts_whatever_the_length(scan, length):
    query, codes = _random(37, length)
    distances = scan(query, codes)
    assert distances.dtype == np.uint16
    np.testing.assert_array_equal(distances, _bit_by_bit(query, codes))


def test_several_blocks_and_a_last_short_one_are_one_scan(scan):
    query, codes = _random(20_001, 64)
    np.testing.assert_array_equal(scan(query, codes), _bit_by_bit(query, codes))


@pytest.mark.parametrize("length", [64, 5, 8191])
def test_opposite_vectors_differ_in_all_bits_and_equal_ones_in_none(scan, length):
    zeros = np.zeros(length, np.uint8)
    np.testing.assert_array_equal(scan(zeros, np.stack([zeros, ~zeros])), [0, 8 * length])


@pytest.mark.parametrize("places", [0, 1])
def test_a_map_of_no_place_or_one_has_as_many_distances(scan, places):
    query, codes = _random(places, 64)
    np.testing.assert_array_equal(scan(query, codes), _bit_by_bit(query, codes))


def test_rows_of_a_wider_array_are_scanned_alike(scan):
    query, wide = _random(100, 32)
    np.testing.assert_array_equal(scan(query[:16], wide[:, 3:19]), _bit_by_bit(query[:16], wide[:, 3:19]))


def test_without_the_library_numpy_answers(monkeypatch):
    monkeypatch.setattr(scans, "simsimd", None)
    query, codes = _random(10, 64)
    np.testing.assert_array_equal(scans.hamming(query, codes), _bit_by_bit(query, codes))
