"""Chapter 6 of the thesis, step by step: float64, nothing clever. The golden standard of the techniques."""

import math
from collections import Counter

import cv2
import numpy as np


def grey_square(image, side):
    grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    return cv2.resize(grey.astype(np.float64), (side, side), interpolation=cv2.INTER_LINEAR)


def levels(grey):
    return np.floor(grey + 0.5).astype(np.uint8)


def disc(image, x, y, radius):
    """Intensities of the valid pixels within `radius` of (x, y)."""
    top, left = max(0, y - radius), max(0, x - radius)
    square = image[top : y + radius + 1, left : x + radius + 1]
    rows, columns = np.indices(square.shape)
    return square[(columns + left - x) ** 2 + (rows + top - y) ** 2 <= radius**2].tolist()


def filled_bins(image, radius=5):
    """Algorithm "Computing Entropy Map", section 6.2.1."""
    height, width = image.shape
    return np.array([[math.log2(len(set(disc(image, x, y, radius)))) / 8 for x in range(width)] for y in range(height)])


def shannon(image, radius=5):
    """Shannon entropy of each disc of a 100x100 copy, scaled back to the image's size."""
    small = cv2.resize(image, (100, 100), interpolation=cv2.INTER_LINEAR_EXACT)
    entropy = np.zeros(small.shape)
    for y in range(100):
        for x in range(100):
            intensities = disc(small, x, y, radius)
            shares = [items / len(intensities) for items in Counter(intensities).values()]
            entropy[y, x] = -sum(p * math.log2(p) for p in shares) / 8
    return cv2.resize(entropy, image.shape[::-1], interpolation=cv2.INTER_LINEAR)


def cell_histograms(image, cell, bins, signed):
    """Steps 1 and 2 of section 6.2.2: gradient map, then one histogram a region."""
    height, width = image.shape
    root = [[math.sqrt(image[y, x] / image.max()) for x in range(width)] for y in range(height)]
    turn = 2 * math.pi if signed else math.pi
    cells = np.zeros((height // cell, width // cell, bins))
    for y in range(height):
        for x in range(width):
            # At the border the image is mirrored about its outermost pixels: the difference there is 0.
            dx = root[y][x + 1] - root[y][x - 1] if 0 < x < width - 1 else 0.0
            dy = root[y + 1][x] - root[y - 1][x] if 0 < y < height - 1 else 0.0
            magnitude = math.hypot(dx, dy)
            at = (math.atan2(dy, dx) % turn) / turn * bins
            low = math.floor(at)
            cells[y // cell, x // cell, low % bins] += magnitude * (1 - (at - low))
            cells[y // cell, x // cell, (low + 1) % bins] += magnitude * (at - low)
    return cells


def blocks(cells):
    """Step 3 of section 6.2.2: blocks of 2x2 regions, stride one region, L2-normalised."""
    rows, cols, _ = cells.shape
    out = []
    for row in range(rows - 1):
        for col in range(cols - 1):
            vector = cells[row : row + 2, col : col + 2].ravel()
            # OpenCV enlarges a flat region on ARM to 90.000003 here and there: that is no gradient.
            length = math.sqrt(sum(value * value for value in vector))
            out.append([value / length if length > 1e-5 else 0.0 for value in vector])
    return np.array(out)


def good_blocks(entropy, cell, threshold):
    """Mean entropy of every block of 2x2 regions, stride one region, against GT."""
    rows, cols = entropy.shape[0] // cell, entropy.shape[1] // cell
    return np.array(
        [
            entropy[row * cell : (row + 2) * cell, col * cell : (col + 2) * cell].mean() >= threshold
            for row in range(rows - 1)
            for col in range(cols - 1)
        ]
    )


def regional_match(query_blocks, good, reference_blocks):
    """Section 6.2.3: C = A B^T, row-wise maximum D, arithmetic mean of D."""
    return (query_blocks[good] @ reference_blocks.T).max(axis=1).mean() if good.any() else 0.0
