"""Oriented gradient histograms over cells and blocks: the common ground of `hog` and `cohog`."""

import cv2
import numpy as np


def grey_square(image: np.ndarray, side_px: int) -> np.ndarray:
    """Return a uint8 image, (H, W) grey or (H, W, 3) BGR, as uint8 grey of (side_px, side_px)."""
    grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    if grey.shape == (side_px, side_px):
        return grey
    return cv2.resize(grey, (side_px, side_px), interpolation=cv2.INTER_LINEAR)


def mask_square(mask: np.ndarray | None, side_px: int) -> np.ndarray | None:
    """Return a bool mask (H, W) as bool (side_px, side_px), nearest neighbour; None stays None (all allowed)."""
    if mask is None:
        return None
    return cv2.resize(mask.astype(np.uint8), (side_px, side_px), interpolation=cv2.INTER_NEAREST).astype(bool)


def oriented_cells(
    grey: np.ndarray, cell_px: int, bins: int, signed: bool, allowed: np.ndarray | None = None
) -> np.ndarray:
    """Histograms of gradient orientation, one a cell (Dalal and Triggs 2005; thesis 6.2.2, steps 1 and 2).

    The square root of the image over its maximum, central differences, gradient magnitude, and a linear vote into
    the two nearest of `bins` orientations over 360 degrees (`signed`) or 180. `grey` is uint8 (H, W) with sides that
    are multiples of `cell_px`; pixels where the bool (H, W) `allowed` is False do not vote. Returns float32
    (H/cell_px, W/cell_px, bins), sums of magnitude, all >= 0.
    """
    # The root is taken in a table of 256 entries: the image has no other values.
    root = np.sqrt(np.arange(256, dtype=np.float32) / max(int(grey.max()), 1))[grey]
    dx = cv2.Sobel(root, cv2.CV_32F, 1, 0, ksize=1)
    dy = cv2.Sobel(root, cv2.CV_32F, 0, 1, ksize=1)
    magnitude = cv2.magnitude(dx, dy)
    if allowed is not None:
        magnitude *= allowed
    turn = 2 * np.pi if signed else np.pi
    at = np.arctan2(dy, dx)
    at *= np.float32(bins / turn)  # in bins; whole numbers are the centres of the orientations
    low = np.floor(at)
    to_high = at - low
    low = low.astype(np.intp) % bins
    high = (low + 1) % bins

    rows, cols = grey.shape[0] // cell_px, grey.shape[1] // cell_px
    cell = np.add.outer(np.arange(grey.shape[0]) // cell_px * cols, np.arange(grey.shape[1]) // cell_px) * bins
    size = rows * cols * bins
    votes = np.bincount((cell + low).ravel(), (magnitude * (1 - to_high)).ravel(), size)
    votes += np.bincount((cell + high).ravel(), (magnitude * to_high).ravel(), size)
    return votes.astype(np.float32).reshape(rows, cols, bins)


def normalised_blocks(cells: np.ndarray) -> np.ndarray:
    """Blocks of 2x2 cells, stride one cell, each of Euclidean length 1 (thesis 6.2.2, step 3).

    `cells` is float32 (rows, cols, L); returns float32 (rows-1, cols-1, 4L) in the order top left, top right, bottom
    left, bottom right. A block without any gradient is all zeros.
    """
    blocks = np.concatenate([cells[:-1, :-1], cells[:-1, 1:], cells[1:, :-1], cells[1:, 1:]], axis=2)
    length = np.sqrt(np.einsum("ijk,ijk->ij", blocks, blocks))
    blocks /= np.maximum(length, 1e-6)[:, :, None]
    return blocks
