"""Histograms of oriented gradients over cells and blocks, and the low-frequency ("slow") patterns of blocks.

A map made on one processor may be used on another, so results must be rounded identically on all of them: products,
sums and roots are computed one by one. The rounding of OpenCV's fused operations and matrix products differs."""

from functools import lru_cache

import cv2
import numpy as np

from edgevpr.core.arrays import Array, Bytes, Image, Ints, Mask, Singles

_STRIP_ROWS = 64  # rows computed at once, so that the planes of a strip stay in cache
_SIGN_BIT = np.uint32(1 << 31)
# Fitted to minimise the maximum error over -45..45 degrees (2e-6 of the magnitude); see `_sum_octants`.
_P = 2.904936713
_Q = 2.067222680
_R = 0.162280117
# Rows: the sums of `_sum_octants`. Columns: 0, 45, ... 315 degrees (x to the right, y down).
_ORIENTATIONS = np.array(
    [
        [0.25, 0, 0, 0, 0.25, 0, 0, 0],
        [0.25, 0, 0, 0, -0.25, 0, 0, 0],
        [0, 0, 0.25, 0, 0, 0, 0.25, 0],
        [0, 0, 0.25, 0, 0, 0, -0.25, 0],
        [0, 0.25, 0, 0.25, 0, 0.25, 0, 0.25],
        [0, 0.25, 0, -0.25, 0, -0.25, 0, 0.25],
        [0, 0.25, 0, 0.25, 0, -0.25, 0, -0.25],
        [0, 0.25, 0, -0.25, 0, 0.25, 0, -0.25],
    ],
    np.float32,
)
# Weights of the cells top left, top right, bottom left, bottom right, and the frequencies over orientations to keep
# for them (None: all).
_PATTERN_WAVES = (
    ((1, 1, 1, 1), None),
    ((1, -1, 1, -1), (0, 1, 2)),
    ((1, 1, -1, -1), (0, 1, 2)),
    ((1, -1, -1, 1), (1,)),
)


def make_grey_square(image: Image, side_px: int) -> Array:
    """Convert a uint8 image, (H, W) grey or (H, W, 3) BGR, to float32 grey (side_px, side_px), 0 to 255. The values are
    not rounded to grey levels, because processors round values between two levels differently."""
    grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    return cv2.resize(grey.astype(np.float32), (side_px, side_px), interpolation=cv2.INTER_LINEAR)


def round_levels(grey: Singles) -> Bytes:
    """Round grey, float32 0 to 255, to uint8, halves up."""
    return (grey + np.float32(0.5)).astype(np.uint8)


def make_mask_square(mask: Mask | None, side_px: int) -> Mask | None:
    """Scale a bool mask (H, W) to bool (side_px, side_px), by nearest neighbour; None stays None (all allowed)."""
    if mask is None:
        return None
    return cv2.resize(mask.astype(np.uint8), (side_px, side_px), interpolation=cv2.INTER_NEAREST).astype(bool)


def pad_to_square(image: Image, mask: Mask | None) -> tuple[Array, Mask]:
    """Pad an image to a square by repeating its border on both sides. Returns the square, and bool (side, side), True
    for pixels of the image that `mask` allows (None: all)."""
    height, width = image.shape[:2]
    side = max(height, width)
    top, left = (side - height) // 2, (side - width) // 2
    border = top, side - height - top, left, side - width - left
    allowed = np.ones((height, width), bool) if mask is None else mask
    square = cv2.copyMakeBorder(image, *border, cv2.BORDER_REPLICATE)
    return square, cv2.copyMakeBorder(allowed.astype(np.uint8), *border, cv2.BORDER_CONSTANT, value=0).astype(bool)


def compute_histograms(grey: Array, cell_px: int, bins: int, signed: bool, allowed: Mask | None = None) -> Singles:
    """Compute histograms of gradient orientation, one per cell (Dalal and Triggs 2005; thesis 6.2.2, steps 1 and 2):
    the square root of the image over its maximum, central differences, and the gradient magnitude, split between the
    two nearest of `bins` orientations over 360 degrees (`signed`) or 180. `grey` is float32 or uint8 (H, W), 0 to 255,
    with sides that are multiples of `cell_px`. Pixels where `allowed`, bool (H, W), is False are ignored (None: none).
    Returns float32 (H/cell_px, W/cell_px, bins), sums of magnitude, all >= 0."""
    rows, cols = grey.shape[0] // cell_px, grey.shape[1] // cell_px
    vote = _sum_octants if signed and bins == 8 else _sum_angles
    mirrored = cv2.copyMakeBorder(grey, 1, 1, 1, 1, cv2.BORDER_REFLECT_101)  # no gradient across the image's border
    root = cv2.sqrt(mirrored.astype(np.float32, copy=False))
    cells = np.empty((rows, cols, bins), np.float32)
    step = max(1, _STRIP_ROWS // cell_px)
    for row in range(0, rows, step):
        top, bottom = row * cell_px, min(row + step, rows) * cell_px
        dx = cv2.subtract(root[top + 1 : bottom + 1, 2:], root[top + 1 : bottom + 1, :-2])
        dy = cv2.subtract(root[top + 2 : bottom + 2, 1:-1], root[top:bottom, 1:-1])
        if allowed is not None:
            dx *= allowed[top:bottom]
            dy *= allowed[top:bottom]
        cells[row : row + step] = vote(dx, dy, cell_px, bins, signed)
    cells /= np.sqrt(max(float(grey.max()), 1.0))
    return cells


def _sum_angles(dx: Array, dy: Array, cell_px: int, bins: int, signed: bool) -> Array:
    """Sum the gradients `dx` and `dy`, float32 (H, W), by cell and orientation: float (H/cell_px, W/cell_px, bins)."""
    magnitude, _ = _compute_magnitude(dx, dy)
    angle = np.arctan2(dy, dx)
    angle *= np.float32(bins / (2 * np.pi if signed else np.pi))  # in bins; integers are bin centres
    low = np.floor(angle)
    high_weight = angle - low
    low = low.astype(np.intp) % bins
    high = (low + 1) % bins

    rows, cols = dx.shape[0] // cell_px, dx.shape[1] // cell_px
    cell = np.add.outer(np.arange(dx.shape[0]) // cell_px * cols, np.arange(dx.shape[1]) // cell_px) * bins
    size = rows * cols * bins
    votes = np.bincount((cell + low).ravel(), (magnitude * (1 - high_weight)).ravel(), size)
    votes += np.bincount((cell + high).ravel(), (magnitude * high_weight).ravel(), size)
    return votes.reshape(rows, cols, bins)


def _sum_octants(dx: Array, dy: Array, cell_px: int, *_: object) -> Singles:
    """Compute the sums of `_sum_angles` for 8 orientations over 360 degrees, without angles, branches or scattering.

    A gradient of magnitude m is in a quadrant, at phi = -45..45 degrees from its diagonal, whose orientation gets m -
    |g|, where g = m phi / 45 degrees. The rest goes to the y axis if g > 0, to the x axis if g < 0. With v = sqrt(2) m
    sin(phi) and u = sqrt(2) m cos(phi), g = v (_P m + _R u) / (_Q m + u) to 2e-6 m. Each plane is summed over the cells
    unchanged, and multiplied by the sign of dx, dy or both. The orientations are sums and differences of these."""
    across, along = np.abs(dx), np.abs(dy)
    u = across + along
    g = np.subtract(along, across, out=along)
    m, scratch = _compute_magnitude(dx, dy, across)
    denominator = np.multiply(m, _Q, out=scratch)
    denominator += u
    denominator += 1e-20  # never 0
    u *= _R
    u += m * _P
    g *= u
    g /= denominator
    size_g = np.abs(g, out=u)
    diagonal = np.subtract(m, size_g, out=m)
    twice_y = np.add(size_g, g, out=denominator)
    twice_x = np.subtract(size_g, g, out=g)

    sign_x = np.bitwise_and(dx.view(np.uint32), _SIGN_BIT)
    sign_y = np.bitwise_and(dy.view(np.uint32), _SIGN_BIT)
    height, width = dx.shape
    sums = np.empty((8, height // cell_px, width), np.float32)
    flipped = size_g.view(np.uint32)

    def sum_plane(row: int, plane: Singles, flip: Array | None = None) -> None:
        if flip is not None:
            plane = np.bitwise_xor(plane.view(np.uint32), flip, out=flipped).view(np.float32)
        np.add.reduce(plane.reshape(-1, cell_px, width), axis=1, out=sums[row])

    sum_plane(0, twice_x)
    sum_plane(1, twice_x, sign_x)
    sum_plane(2, twice_y)
    sum_plane(3, twice_y, sign_y)
    sum_plane(4, diagonal)
    sum_plane(5, diagonal, sign_x)
    sum_plane(6, diagonal, sign_y)
    sum_plane(7, diagonal, sign_x ^ sign_y)
    cell_sums = np.add.reduce(sums.reshape(8, 1, -1, cell_px), axis=3)
    votes = np.add.reduce(cell_sums * _ORIENTATIONS[:, :, None], axis=0)
    return np.asarray(np.maximum(votes, 0, out=votes).T.reshape(height // cell_px, width // cell_px, 8))


def _compute_magnitude(dx: Array, dy: Array, out: Array | None = None) -> tuple[Array, Array]:
    """Return the magnitude of each gradient (in `out`, unless it is None), and a scratch array of the same shape."""
    squares, scratch = np.multiply(dx, dx, out=out), dy * dy
    squares += scratch
    return cv2.sqrt(squares, squares), scratch


def normalise_blocks(cells: Singles) -> Singles:
    """Return blocks of 2x2 cells, stride one cell, of Euclidean length 1 (thesis 6.2.2, step 3): float32 (rows, cols,
    L) to (rows-1, cols-1, 4L): top left, top right, bottom left, bottom right. A block without gradient is zero."""
    blocks = np.concatenate([cells[:-1, :-1], cells[:-1, 1:], cells[1:, :-1], cells[1:, 1:]], axis=2)
    length = np.sqrt(np.add.reduce(blocks * blocks, axis=2))
    blocks /= np.maximum(length, 1e-6)[:, :, None]
    return blocks


def normalise_rows(rows: Singles) -> Singles:
    """Scale each row of (N, D) to length 1; a zero row stays zero."""
    return np.asarray(rows / np.maximum(np.sqrt(np.einsum("ij,ij->i", rows, rows)), 1e-6)[:, None])


@lru_cache
def make_slow_patterns(bins: int) -> Singles:
    """Return the low-frequency ("slow") patterns of a block of 2x2 cells of `bins` orientations: float32 (4 * bins,
    patterns), one per column, orthonormal. A pattern is a wave over the cells (mean, left against right, top against
    bottom, diagonal against diagonal) times a wave over the orientations. Of the 32 patterns of 8 orientations, these
    are the 20 with the most power on the tuning sets; they yield the same recall."""
    frequency = _list_frequencies(bins)
    return np.vstack(
        [
            np.kron(np.array(cells) / 2, wave)
            for cells, frequencies in _PATTERN_WAVES
            for periods, wave in zip(frequency, make_waves(bins), strict=True)
            if frequencies is None or periods in frequencies
        ]
    ).T.astype(np.float32, order="C")


@lru_cache
def make_waves(bins: int) -> Singles:
    """Return the real Fourier series over `bins` orientations: float32 (bins, bins), one wave per row, each of length
    1. The constant comes first, then cosine and sine of each frequency (even `bins`: only cosine of the highest)."""
    angle = 2 * np.pi * np.arange(bins) / bins
    frequency, row = _list_frequencies(bins), np.arange(bins)
    series = np.cos(frequency[:, None] * angle - np.pi / 2 * (row[:, None] % 2 == 0) * (row[:, None] > 0))
    return np.asarray((series / np.linalg.norm(series, axis=1, keepdims=True)).astype(np.float32))


def _list_frequencies(bins: int) -> Ints:
    """Return the frequency of each row of `make_waves`, in periods per full circle of orientations: int (bins,)."""
    return (np.arange(bins) + 1) // 2
