"""Exact scan of binary vectors: in how many bits does the query differ from every place of the map?

With the optional library `simsimd` the scan takes about half the time; both ways give the same numbers.
"""

import numpy as np

try:
    import simsimd
except ImportError:
    simsimd = None

_BYTES_AT_ONCE = 1 << 19  # with as much of the query beside it, this stays in the second-level cache
_EVEN_BYTES = np.uint64(0x00FF00FF00FF00FF)
_ADD_LANES = np.uint64(0x0001000100010001)


def hamming(query: np.ndarray, codes: np.ndarray) -> np.ndarray:
    """Differing bits: uint8 (B,), uint8 (N, B) -> uint16 (N,); B is at most 8191 bytes."""
    return hamming_numpy(query, codes) if simsimd is None else hamming_simd(query, codes)


def hamming_simd(query: np.ndarray, codes: np.ndarray) -> np.ndarray:
    """`hamming` by simsimd, which must be importable."""
    if not len(codes):
        return np.empty(0, np.uint16)
    distances = simsimd.hamming(query[None], np.ascontiguousarray(codes), dtype="bin8")
    return np.asarray(distances).astype(np.uint16).reshape(len(codes))


def hamming_numpy(query: np.ndarray, codes: np.ndarray) -> np.ndarray:
    """`hamming` in NumPy: XOR with copies of the query, as long as the block, and count, in the widest words that fit.

    The counts of eight words, bytes of one 64-bit number, are added inside it: NumPy is slow along short axes.
    """
    length = codes.shape[1]
    word = np.dtype(next(form for form in ("u8", "u4", "u2", "u1") if length % np.dtype(form).itemsize == 0))
    words = length // word.itemsize
    block = max(1, _BYTES_AT_ONCE // length)
    queries = np.tile(query.view(word), min(block, len(codes))).reshape(-1, words)
    differ = np.empty_like(queries)
    counts = np.zeros((len(queries), -(-words // 8) * 8), np.uint8)  # the words beyond the last stay zero

    places = np.ascontiguousarray(codes).view(word)
    distances = np.empty(len(codes), np.uint16)
    for start in range(0, len(codes), block):
        part = places[start : start + block]
        here = slice(0, len(part))
        np.bitwise_xor(part, queries[here], out=differ[here])
        np.bitwise_count(differ[here], out=counts[here, :words])
        distances[start : start + block] = _sums_of_bytes(counts[here].view(np.uint64))
    return distances


def _sums_of_bytes(numbers: np.ndarray) -> np.ndarray:
    """The sum of all bytes of each row: uint64 (n, k) -> (n,); a byte is at most 64."""
    pairs = (numbers & _EVEN_BYTES) + (numbers >> 8 & _EVEN_BYTES)
    sums = pairs * _ADD_LANES >> 48
    return sums[:, 0] if sums.shape[1] == 1 else sums.sum(axis=1)
