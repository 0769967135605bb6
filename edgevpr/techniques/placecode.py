"""A place in 144 bytes that is still found when the camera has moved or turned: the coarse stage of `cohog`.

The block-normalised HOG is averaged over 12x12 cells (its *grid*); the map's mean is taken away, the L orientations of
each cell are written as a Fourier series, and only the signs stay, one bit for each of its L numbers: neighbouring
orientations rise and fall together, and their signs would say half of it twice. A query is compared under every shift
of the grid, for a camera of unknown heading under every rotation too: each such *hypothesis* is one row of a matrix,
the map is the other, and one product answers for all places. Neither shifting nor turning touches the picture: both
move the numbers of the grid.
"""

from functools import lru_cache

import numpy as np

from edgevpr.techniques.patterns import waves

SIDE = 12  # cells along one side
_SAMPLES = 3  # along one side of a cell: with 31 blocks about one a block
_MIN_OVERLAP = 0.5  # with less, more is compared, and on no set was a place more found
_AROUND_CELLS = 3.0  # standard deviation
_LOOKED_CLOSER = 500  # places; they take a tenth of the time of a scan of 10 000
_BITS_AT_ONCE = 1 << 19  # of places: 2 MB as float32

# Byte -> its eight bits, first bit first, as +1 and -1: `unpackbits`, conversion and offset in one look-up.
_SIGNS = np.unpackbits(np.arange(256, dtype=np.uint8)[:, None], axis=1).astype(np.float32) * 2 - 1


def _shifts() -> np.ndarray:
    steps = np.arange(1 - SIDE, SIDE)
    dy, dx = np.meshgrid(steps, steps, indexing="ij")
    enough = (SIDE - abs(dx)) * (SIDE - abs(dy)) >= _MIN_OVERLAP * SIDE**2
    return np.stack([dx[enough], dy[enough]], axis=1).astype(np.int8)


# int8 (S, 2): every (dx, dy) in cells under which enough of two grids lies on the other.
SHIFTS = _shifts()


def grid(blocks: np.ndarray) -> np.ndarray:
    """Mean orientations of the cells of a picture: blocks float32 (n, n, 4L) -> float32 (12, 12, L), each cell of
    length 1 (so that contrast and haze do not count)."""
    return turned_grids(blocks, np.zeros(1))[0][0]


def turned_grids(
    blocks: np.ndarray, rotations_deg: np.ndarray, seen: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """The grids of a picture turned counter-clockwise: blocks float32 (n, n, 4L), angles (R,) -> float32 (R, 12, 12,
    L), and bool (R, 12, 12), whether at least half of the cell lies in the picture (where bool (n, n) `seen` allows).

    Every cell averages samples at the places they came from; the orientations turn with them, shared linearly between
    the two nearest bins.
    """
    n, bins = blocks.shape[0], blocks.shape[2] // 4
    seen = np.ones((n, n), bool) if seen is None else seen
    # One row more, for samples from outside the picture: nothing is seen there.
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
    """What sets a picture apart: grids (N, 12, 12, L) less the map's mean (12, 12, L), the orientations of each cell as
    a Fourier series. Returns float32 of the shape of `grids`.

    `locally`, also less what the (`seen`) cells around have in common: where any rotation may meet any place, the mean
    of a cell over the map leaves in what comes from the light and from fields that all run one way.
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
    """Rows of the index: grids (N, 12, 12, L), the map's mean (12, 12, L) -> uint8 (N, 18 L), the signs bit by bit."""
    return np.packbits((special(grids, mean, locally=locally) >= 0).reshape(len(grids), -1), axis=1)


def hypotheses(grids: np.ndarray, seen: np.ndarray, mean: np.ndarray, locally: bool = False) -> np.ndarray:
    """A query as it would look from elsewhere: grids and `seen` of its R rotations by `turned_grids`, the map's mean ->
    float32 (R, S, 144 L), its signs (0 where it sees nothing), moved by the S `SHIFTS`."""
    signs = np.where(special(grids, mean, seen, locally) >= 0, np.float32(1), np.float32(-1)) * seen[..., None]
    asked = np.zeros((len(signs), len(SHIFTS), *signs.shape[1:]), np.float32)
    for at, (dx, dy) in enumerate(SHIFTS.tolist()):
        asked[:, at, _to(dy), _to(dx)] = signs[:, _to(-dy), _to(-dx)]
    return asked.reshape(*asked.shape[:2], -1)


def scan(asked: np.ndarray, codes: np.ndarray) -> np.ndarray:
    """Compare every hypothesis, float32 (R, S, 8 B), with every place, uint8 (N, B): the best score of each rotation,
    float32 (N, R).

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
    """`scan` for a camera that looks ahead: all places under a quarter of the shifts, each blurred with those around
    it so that none is overlooked, and the best of those under all."""
    if len(codes) <= _LOOKED_CLOSER:
        return scan(asked, codes)
    scores = scan(_blurred() @ asked, codes)
    best = np.argpartition(-scores[:, 0], _LOOKED_CLOSER)[:_LOOKED_CLOSER]
    scores[best] = scan(asked, codes[best])
    return scores


def scan_near(asked: np.ndarray, codes: np.ndarray, expected: np.ndarray) -> np.ndarray:
    """`scan` where the heading is known: place n only under rotation `expected` [n] and the two beside it, -inf for the
    others. int (N,), below 0 where nobody knows: such a place under all of them.

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
    """float32 (shifts even both ways, S): the weights of the shifts in the mean about each, by how far they are off."""
    kept = SHIFTS[(SHIFTS % 2 == 0).all(axis=1)]
    weight = np.maximum(1 - abs(kept[:, None] - SHIFTS) / 2, 0).prod(axis=2)
    return (weight / weight.sum(axis=1, keepdims=True)).astype(np.float32)


@lru_cache
def _around() -> np.ndarray:
    """float32 (144, 144): how much each cell counts for what the cells around another have in common."""
    away = np.subtract.outer(np.arange(SIDE), np.arange(SIDE))
    near = np.exp(-(away**2) / (2 * _AROUND_CELLS**2))
    return np.kron(near, near).astype(np.float32)


@lru_cache(maxsize=8)
def _sources(n: int, rotations_deg: tuple[float, ...]) -> np.ndarray:
    """int (R, 144, 9): for every sample of every cell the block it comes from, `n` n where that is outside."""
    middle = (np.arange(SIDE * _SAMPLES) + 0.5) / (SIDE * _SAMPLES) - 0.5
    y, x = (part.reshape(SIDE, _SAMPLES, SIDE, _SAMPLES) for part in np.meshgrid(middle, middle, indexing="ij"))
    x, y = (part.swapaxes(1, 2).reshape(SIDE**2, _SAMPLES**2) for part in (x, y))
    angle = np.radians(rotations_deg)[:, None, None]
    column = np.floor((x * np.cos(angle) - y * np.sin(angle) + 0.5) * n).astype(np.intp)
    row = np.floor((x * np.sin(angle) + y * np.cos(angle) + 0.5) * n).astype(np.intp)
    inside = (row >= 0) & (row < n) & (column >= 0) & (column < n)
    return np.where(inside, row * n + column, n * n)


def _turned_bins(cells: np.ndarray, rotation_deg: float) -> np.ndarray:
    """Orientations (..., L) of a picture turned counter-clockwise. They are measured towards y, which points down, so
    that turning lowers them."""
    whole, part = divmod(rotation_deg / 360 * cells.shape[-1], 1)
    return (1 - part) * np.roll(cells, -int(whole), axis=-1) + part * np.roll(cells, -int(whole) - 1, axis=-1)


def _to(step: int) -> slice:
    """The cells of one side that something moved by `step` cells comes to lie on."""
    return slice(max(0, step), SIDE + min(0, step))
