"""A place in 144 bytes that is still found when the camera has moved or turned: the coarse stage of `cohog`.

The block-normalised HOG is averaged over 12x12 cells (its *grid*), and the map's mean is subtracted. The L orientations
of each cell are written as a Fourier series, and only the signs stay, one bit for each of its L numbers. Without the
series the signs would repeat half of their information, since neighbouring orientations rise and fall together. A query
is compared under every shift of the grid and, for a camera of unknown heading, under every rotation. Each such
*hypothesis* is one row of a matrix, the places of the map are another matrix, and one product compares them all. Shifts
and rotations move the numbers of the grid, not the picture.
"""

from functools import lru_cache

import numpy as np

from edgevpr.techniques.patterns import waves

SIDE = 12  # cells along one side
_SAMPLES = 3  # along one side of a cell: about one per block, for 31 blocks
_MIN_OVERLAP = 0.5  # a smaller overlap costs more shifts, and found no further place on any data set
_AROUND_CELLS = 3.0  # standard deviation of the weights around a cell
_LOOKED_CLOSER = 500  # places; comparing them takes a tenth of the time of a scan of 10 000
_BITS_AT_ONCE = 1 << 19  # of places: 2 MB as float32

# Each byte as its eight bits, first bit first, +1 or -1: one look-up instead of `unpackbits`, conversion and offset.
_SIGNS = np.unpackbits(np.arange(256, dtype=np.uint8)[:, None], axis=1).astype(np.float32) * 2 - 1


def _shifts() -> np.ndarray:
    steps = np.arange(1 - SIDE, SIDE)
    dy, dx = np.meshgrid(steps, steps, indexing="ij")
    enough = (SIDE - abs(dx)) * (SIDE - abs(dy)) >= _MIN_OVERLAP * SIDE**2
    return np.stack([dx[enough], dy[enough]], axis=1).astype(np.int8)


# int8 (S, 2): every shift (dx, dy) in cells under which two grids overlap by at least half.
SHIFTS = _shifts()


def grid(blocks: np.ndarray) -> np.ndarray:
    """Average the orientations over the cells of a picture: blocks float32 (n, n, 4L) to float32 (12, 12, L), each cell
    of length 1 (so that contrast and haze do not count)."""
    return turned_grids(blocks, np.zeros(1))[0][0]


def turned_grids(
    blocks: np.ndarray, rotations_deg: np.ndarray, seen: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Make the grids of a picture turned counter-clockwise: blocks float32 (n, n, 4L) and angles (R,) in degrees to
    float32 (R, 12, 12, L). Also returns bool (R, 12, 12): at least half of the cell lies in the picture, in blocks that
    bool (n, n) `seen` allows (None: all).

    Each cell averages samples of the blocks from which its points came. The orientations turn with the picture, shared
    linearly between the two nearest bins.
    """
    n, bins = blocks.shape[0], blocks.shape[2] // 4
    seen = np.ones((n, n), bool) if seen is None else seen
    # One extra row, for samples from outside the picture, where nothing is seen.
    known = np.append(seen.ravel(), False)
    source = np.zeros((n * n + 1, bins), np.float32)
    source[:-1] = blocks.reshape(n * n, 4, bins).mean(axis=1) * seen.reshape(-1, 1)

    at = _sources(n, tuple(rotations_deg.tolist()))
    share = known[at].mean(axis=-1)
    cells = source[at].mean(axis=2)
    cells = np.stack([_turned_bins(each, angle) for each, angle in zip(cells, rotations_deg, strict=True)])
    cells /= np.maximum(np.linalg.norm(cells, axis=-1, keepdims=True), 1e-6)
    square = (len(rotations_deg), SIDE, SIDE)
    return cells.reshape(*square, bins), (share >= 0.5).reshape(square)


def special(grids: np.ndarray, mean: np.ndarray, seen: np.ndarray | None = None, locally: bool = False) -> np.ndarray:
    """Return the part of a picture that sets it apart: grids (N, 12, 12, L) less the map's mean (12, 12, L), the
    orientations of each cell as a Fourier series. The result is float32 of the shape of `grids`.

    With `locally`, the mean of the (`seen`) cells around each cell is subtracted too. This is for maps in which any
    rotation may meet any place: there the mean over the map does not remove the effect of the light, nor that of fields
    that all run one way.
    """
    left = (np.asarray(grids, np.float32) - mean) @ waves(grids.shape[-1]).T
    if not locally:
        return left
    weight = np.ones(left.shape[:3], np.float32) if seen is None else seen.astype(np.float32)
    around, cells = _around(), (len(left), SIDE**2, -1)
    common = around @ (left * weight[..., None]).reshape(cells)
    common /= np.maximum(around @ weight.reshape(cells), 1e-6)
    return left - common.reshape(left.shape)


def pack(grids: np.ndarray, mean: np.ndarray, locally: bool = False) -> np.ndarray:
    """Make the rows of the index: grids (N, 12, 12, L) and the map's mean (12, 12, L) to uint8 (N, 18 L), bit by
    bit."""
    return np.packbits((special(grids, mean, locally=locally) >= 0).reshape(len(grids), -1), axis=1)


def hypotheses(grids: np.ndarray, seen: np.ndarray, mean: np.ndarray, locally: bool = False) -> np.ndarray:
    """Make a query's views from elsewhere: grids and `seen` of its R rotations (by `turned_grids`) and the map's mean
    to float32 (R, S, 144 L). Each is the signs of the query (0 where nothing is seen), moved by one of the S
    `SHIFTS`."""
    signs = np.where(special(grids, mean, seen, locally) >= 0, np.float32(1), np.float32(-1)) * seen[..., None]
    asked = np.zeros((len(signs), len(SHIFTS), *signs.shape[1:]), np.float32)
    for at, (dx, dy) in enumerate(SHIFTS.tolist()):
        asked[:, at, _to(dy), _to(dx)] = signs[:, _to(-dy), _to(-dx)]
    return asked.reshape(*asked.shape[:2], -1)


def scan(asked: np.ndarray, codes: np.ndarray) -> np.ndarray:
    """Compare every hypothesis, float32 (R, S, 8 B), with every place, uint8 (N, B). Returns the best score of each
    rotation, float32 (N, R).

    A score is the bits that agree less those that do not, over all bits: 1 is the same picture, 0 is chance.
    """
    rotations, moves, _ = asked.shape
    by_bit = asked.reshape(rotations * moves, -1).T
    best = np.empty((len(codes), rotations), np.float32)
    at_once = max(1, _BITS_AT_ONCE // asked.shape[2])
    bits = np.empty((at_once, codes.shape[1], 8), np.float32)
    scores = np.empty((at_once, rotations * moves), np.float32)
    for start in range(0, len(codes), at_once):
        part = codes[start : start + at_once]
        count = len(part)
        np.take(_SIGNS, part, axis=0, out=bits[:count], mode="clip")
        np.matmul(bits[:count].reshape(count, -1), by_bit, out=scores[:count])
        np.max(scores[:count].reshape(count, rotations, moves), axis=2, out=best[start : start + count])
    best /= asked.shape[2]
    return best


def scan_ahead(asked: np.ndarray, codes: np.ndarray) -> np.ndarray:
    """Scan for a forward camera: all places under a quarter of the shifts, then the best 500 places under all. Each
    shift of the quarter is blurred with those around it, so that none is missed. Takes and returns the same as
    `scan`."""
    if len(codes) <= _LOOKED_CLOSER:
        return scan(asked, codes)
    scores = scan(_blurred() @ asked, codes)
    best = np.argpartition(-scores[:, 0], _LOOKED_CLOSER)[:_LOOKED_CLOSER]
    scores[best] = scan(asked, codes[best])
    return scores


def scan_near(asked: np.ndarray, codes: np.ndarray, expected: np.ndarray) -> np.ndarray:
    """Scan where the heading is known: place n only under rotation `expected[n]` and the two beside it, with -inf for
    the others. `expected` is int (N,), below 0 where the heading is unknown: such a place is compared under all.

    Places that expect the same rotation are one product, so the work is that of three rotations.
    """
    best = np.full((len(codes), len(asked)), -np.inf, np.float32)
    for turn in np.unique(expected):
        group = np.flatnonzero(expected == turn)
        near = np.arange(len(asked)) if turn < 0 else np.arange(turn - 1, turn + 2) % len(asked)
        best[group[:, None], near] = scan(asked[near], codes[group])
    return best


@lru_cache
def _blurred() -> np.ndarray:
    """Return float32 (even shifts, S): the weights of all shifts in the mean around each even one, by distance."""
    kept = SHIFTS[(SHIFTS % 2 == 0).all(axis=1)]
    weight = np.maximum(1 - abs(kept[:, None] - SHIFTS) / 2, 0).prod(axis=2)
    return (weight / weight.sum(axis=1, keepdims=True)).astype(np.float32)


@lru_cache
def _around() -> np.ndarray:
    """Return float32 (144, 144): the weight of each cell in the mean of the cells around another."""
    away = np.subtract.outer(np.arange(SIDE), np.arange(SIDE))
    near = np.exp(-(away**2) / (2 * _AROUND_CELLS**2))
    return np.kron(near, near).astype(np.float32)


@lru_cache(maxsize=8)
def _sources(n: int, rotations_deg: tuple[float, ...]) -> np.ndarray:
    """Return int (R, 144, 9): the block that each sample of each cell comes from, `n * n` for samples from outside."""
    middle = (np.arange(SIDE * _SAMPLES) + 0.5) / (SIDE * _SAMPLES) - 0.5
    y, x = (part.reshape(SIDE, _SAMPLES, SIDE, _SAMPLES) for part in np.meshgrid(middle, middle, indexing="ij"))
    x, y = (part.swapaxes(1, 2).reshape(SIDE**2, _SAMPLES**2) for part in (x, y))
    angle = np.radians(rotations_deg)[:, None, None]
    column = np.floor((x * np.cos(angle) - y * np.sin(angle) + 0.5) * n).astype(np.intp)
    row = np.floor((x * np.sin(angle) + y * np.cos(angle) + 0.5) * n).astype(np.intp)
    inside = (row >= 0) & (row < n) & (column >= 0) & (column < n)
    return np.where(inside, row * n + column, n * n)


def _turned_bins(cells: np.ndarray, rotation_deg: float) -> np.ndarray:
    """Turn the orientations (..., L) of a picture that is turned counter-clockwise. Orientations are measured towards
    y, which points down, so that turning lowers them."""
    whole, part = divmod(rotation_deg / 360 * cells.shape[-1], 1)
    return (1 - part) * np.roll(cells, -int(whole), axis=-1) + part * np.roll(cells, -int(whole) - 1, axis=-1)


def _to(step: int) -> slice:
    """Return the slice of one side that its own cells cover after a move by `step` cells."""
    return slice(max(0, step), SIDE + min(0, step))
