"""The coarse stage of `cohog` for a forward camera: places of 144 bytes, recognised even if the camera has moved.

The block-normalised HOG is averaged over 12x12 cells (its *grid*), minus the map's mean grid. The L orientations of
each cell are written as a Fourier series, as neighbours are correlated, and only the signs of its coefficients are
kept. A query is compared under every shift of its grid, a *hypothesis*: one matrix product compares them all."""

from functools import lru_cache

import numpy as np

from edgevpr.core.arrays import Array, Bools, Bytes, Floats, Ints, Singles
from edgevpr.techniques.gradients import make_waves

SIDE = 12  # cells along one side
_SAMPLES_PER_SIDE = 3  # along one side of a cell: about one per block, for 31 blocks
_MIN_OVERLAP = 0.5  # a smaller one needs more shifts, but recognised no more places on any data set
_FULL_SCAN_PLACES = 500  # compared under all shifts; takes a tenth of the time of a scan of 10,000
_BITS_PER_PRODUCT = 1 << 19  # of places: 2 MB as float32

# The eight bits of each byte, first bit first, as +1 or -1: a look-up replaces `unpackbits` and arithmetic.
_BYTE_SIGNS = np.unpackbits(np.arange(256, dtype=np.uint8)[:, None], axis=1).astype(np.float32) * 2 - 1


_DY, _DX = np.mgrid[1 - SIDE : SIDE, 1 - SIDE : SIDE]
_HAS_OVERLAP = (SIDE - abs(_DX)) * (SIDE - abs(_DY)) >= _MIN_OVERLAP * SIDE**2
# int8 (S, 2): every shift (dx, dy) in cells under which two grids overlap by at least half.
SHIFTS = np.stack([_DX[_HAS_OVERLAP], _DY[_HAS_OVERLAP]], axis=1).astype(np.int8)


def make_grid(blocks: Singles, seen: Bools, used: Bools) -> tuple[Singles, Bools]:
    """Make the grid of a picture from its blocks float32 (n, n, 4 L), each of L orientations for its 2x2 cells. Only
    the central square of the blocks `seen`, bool (n, n), at least 12 wide, is used: it excludes the picture's border.
    The blocks `used`, bool (n, n), are averaged in each of 12x12 larger cells, normalised to length 1 against contrast
    and haze. Returns the grid float32 (12, 12, L), and bool (12, 12), True where at least half of the cell is used."""
    n = max(min(int(seen.any(axis=0).sum()), int(seen.any(axis=1).sum())), SIDE)
    middle, block_indices = slice((len(seen) - n) // 2, (len(seen) + n) // 2), _list_blocks(n)
    per_block, weights = blocks[middle, middle].reshape(n * n, 4, -1).mean(axis=1), used[middle, middle].ravel()
    cells = (per_block * weights[:, None])[block_indices].mean(axis=1)
    cells /= np.maximum(np.linalg.norm(cells, axis=-1, keepdims=True), 1e-6)
    return cells.reshape(SIDE, SIDE, -1), (weights[block_indices].mean(axis=1) >= 0.5).reshape(SIDE, SIDE)


def compute_deviations(grids: Floats, mean: Floats) -> Array:
    """Subtract the map's mean (12, 12, L) from `grids` (..., 12, 12, L) and write the orientations of each cell as a
    Fourier series: float32 of the shape of `grids`."""
    return np.asarray((np.asarray(grids, np.float32) - mean) @ make_waves(grids.shape[-1]).T)


def pack_grids(grids: Floats, mean: Floats) -> Bytes:
    """Make the rows of the index from `grids` (N, 12, 12, L) and the map's mean (12, 12, L): uint8 (N, 18 L), the sign
    of each value of `compute_deviations` as one bit."""
    return np.packbits((compute_deviations(grids, mean) >= 0).reshape(len(grids), -1), axis=1)


def make_hypotheses(grid: Singles, seen: Bools, mean: Floats) -> Singles:
    """Make the hypotheses of a query, float32 (S, 144 L), from its `grid` and `seen` (see `make_grid`) and the map's
    mean (12, 12, L). Row s has the signs of the query (0 where nothing is seen), shifted by `SHIFTS[s]`."""
    signs = np.where(compute_deviations(grid, mean) >= 0, np.float32(1), np.float32(-1)) * seen[..., None]
    queries = np.zeros((len(SHIFTS), *signs.shape), np.float32)
    for row, (dx, dy) in enumerate(SHIFTS.tolist()):
        queries[row, _slice_target(dy), _slice_target(dx)] = signs[_slice_target(-dy), _slice_target(-dx)]
    return queries.reshape(len(SHIFTS), -1)


def scan_codes(queries: Singles, codes: Bytes) -> Singles:
    """Compare hypotheses, `queries` float32 (S, 8 B), with every place, `codes` uint8 (N, B). Returns each place's best
    score, float32 (N,): the fraction of equal bits minus that of different ones (1: the same picture, 0: chance)."""
    transposed = queries.T
    best = np.empty(len(codes), np.float32)
    block = max(1, _BITS_PER_PRODUCT // queries.shape[1])
    bits = np.empty((block, codes.shape[1], 8), np.float32)
    scores = np.empty((block, len(queries)), np.float32)
    for start in range(0, len(codes), block):
        part = codes[start : start + block]
        count = len(part)
        np.take(_BYTE_SIGNS, part, axis=0, out=bits[:count], mode="clip")
        np.matmul(bits[:count].reshape(count, -1), transposed, out=scores[:count])
        np.max(scores[:count], axis=1, out=best[start : start + count])
    best /= queries.shape[1]
    return best


def scan_in_two_steps(queries: Singles, codes: Bytes) -> Singles:
    """Compare like `scan_codes`, but faster: all places under a quarter of the shifts, each averaged with the shifts
    around it, then only the best 500 places under all shifts."""
    if len(codes) <= _FULL_SCAN_PLACES:
        return scan_codes(queries, codes)
    scores = scan_codes(_make_blur_weights() @ queries, codes)
    best = np.argpartition(-scores, _FULL_SCAN_PLACES)[:_FULL_SCAN_PLACES]
    scores[best] = scan_codes(queries, codes[best])
    return scores


@lru_cache
def _make_blur_weights() -> Singles:
    """Return the averaging weights of `scan_in_two_steps`, float32 (E, S): row e has the weights of all S shifts in the
    mean around the e-th of the E shifts with even dx and dy."""
    even = SHIFTS[(SHIFTS % 2 == 0).all(axis=1)]
    weight = np.maximum(1 - abs(even[:, None] - SHIFTS) / 2, 0).prod(axis=2)
    return np.asarray((weight / weight.sum(axis=1, keepdims=True)).astype(np.float32))


@lru_cache(maxsize=8)
def _list_blocks(n: int) -> Ints:
    """Return the row-major indices, in the picture's n x n blocks, of the blocks that are averaged in each of the 12x12
    cells of a grid, 9 per cell (some may be equal): int (144, 9)."""
    samples = np.floor((np.arange(SIDE * _SAMPLES_PER_SIDE) + 0.5) / (SIDE * _SAMPLES_PER_SIDE) * n).astype(np.intp)
    indices = np.add.outer(samples * n, samples).reshape(SIDE, _SAMPLES_PER_SIDE, SIDE, _SAMPLES_PER_SIDE)
    return indices.swapaxes(1, 2).reshape(SIDE**2, _SAMPLES_PER_SIDE**2)


def _slice_target(step: int) -> slice:
    """Return the slice of one axis of the grid to which cells are copied if the grid is shifted by `step` cells along
    it; they are copied from the slice for `-step`."""
    return slice(max(0, step), SIDE + min(0, step))
