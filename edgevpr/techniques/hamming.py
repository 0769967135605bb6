"""Exact scan of binary vectors: the number of bits in which the query differs from each place of the map.

With the optional library `simsimd` the scan takes about half the time; both ways give the same numbers.
"""

import numpy as np

try:
    import simsimd
except ImportError:
    simsimd = None

_BYTES_AT_ONCE = 1 << 20  # about a second-level cache: with smaller blocks the calls cost more than the cache saves
_GROUP = 64  # places
_PLACES_AT_ONCE = 1 << 13  # simsimd returns float64: with few places at once there is little to convert
_EVEN_BYTES = np.uint64(0x00FF00FF00FF00FF)
_ADD_LANES = np.uint64(0x0001000100010001)


def hamming(query: np.ndarray, codes: np.ndarray) -> np.ndarray:
    """Count differing bits: uint8 (B,), uint8 (N, B) to uint16 (N,), or uint32 for more than 8191 bytes."""
    return hamming_numpy(query, codes) if simsimd is None else hamming_simd(query, codes)


def hamming_simd(query: np.ndarray, codes: np.ndarray) -> np.ndarray:
    """Compute `hamming` by simsimd, which must be importable."""
    asked, places = query[None], np.ascontiguousarray(codes)
    distances = np.empty(len(codes), _counts_of(codes))
    for start in range(0, len(codes), _PLACES_AT_ONCE):
        here = slice(start, start + _PLACES_AT_ONCE)
        distances[here] = simsimd.hamming(asked, places[here], dtype="bin8")
    return distances


def hamming_numpy(query: np.ndarray, codes: np.ndarray) -> np.ndarray:
    """Compute `hamming` in NumPy: XOR and count, in the widest words that fit, block by block.

    NumPy is slow along short axes. So a group of places is compared with as many copies of the query at once. The
    counts of eight words are the bytes of one 64-bit number, and are added inside it.
    """
    length = codes.shape[1]
    word = np.dtype(next(form for form in ("u8", "u4", "u2", "u1") if length % np.dtype(form).itemsize == 0))
    words = length // word.itemsize
    group = np.tile(query.view(word), _GROUP)
    places = np.ascontiguousarray(codes).view(word)

    block = min(max(1, _BYTES_AT_ONCE // (length * _GROUP)) * _GROUP, len(codes))
    differ = np.empty((block, words), word)
    counts = np.zeros((block, -(-words // 8) * 8), np.uint8)  # the words beyond the last stay zero
    distances = np.empty(len(codes), _counts_of(codes))
    for start in range(0, len(codes), max(1, block)):
        part = places[start : start + block]
        here, grouped = slice(0, len(part)), len(part) // _GROUP * _GROUP
        np.bitwise_xor(part[:grouped].reshape(-1, group.size), group, out=differ[:grouped].reshape(-1, group.size))
        np.bitwise_xor(part[grouped:], group[:words], out=differ[grouped : len(part)])
        np.bitwise_count(differ[here], out=counts[here, :words])
        distances[start : start + block] = _sums_of_bytes(counts[here].view(np.uint64))
    return distances


def _counts_of(codes: np.ndarray) -> type:
    return np.uint16 if 8 * codes.shape[1] < 1 << 16 else np.uint32


def _sums_of_bytes(numbers: np.ndarray) -> np.ndarray:
    """Sum all bytes of each row: uint64 (n, k) to (n,); a byte is at most 64."""
    sums = numbers >> 8
    sums &= _EVEN_BYTES
    sums += numbers & _EVEN_BYTES
    sums *= _ADD_LANES
    sums >>= 48
    return sums[:, 0] if sums.shape[1] == 1 else sums.sum(axis=1)
