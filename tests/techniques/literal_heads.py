"""The heads, step by step from their papers: float64, nothing clever. The golden standard of the heads."""

import math

import numpy as np


def normalise_rows(vectors):
    """Each row at length 1."""
    return vectors / np.sqrt((vectors**2).sum(axis=-1, keepdims=True))


def pyramid(features, levels):
    """He et al. 2014: bin i of n covers floor(i a / n) to ceil((i + 1) a / n)."""

    def cover(i, n, a):
        return slice(math.floor(i * a / n), math.ceil((i + 1) * a / n))

    _, height, width = features.shape
    bins = [(n, row, column) for n in levels for row in range(n) for column in range(n)]
    covered = (features[:, cover(row, n, height), cover(column, n, width)] for n, row, column in bins)
    return np.concatenate([each.max(axis=(1, 2)) for each in covered])


def project_vector(vector, row, signs, length):
    """The whole matrix, value by value: row j is the Gaussian vector moved on by j, each column with its sign."""
    size = len(vector)
    matrix = np.array([[row[(i - j) % size] * signs[i] for i in range(size)] for j in range(length)])
    return matrix @ vector.astype(float) / math.sqrt(length)


def rmac_regions(height, width):
    """Tolias et al. 2016, 3.2: squares of side 2 min / (l + 1), l on the short side, l + m - 1 on the long one."""
    short, long = min(height, width), max(height, width)
    best, m = math.inf, 1
    if long > short:
        for candidate in range(2, 8):
            step = (long - short) / (candidate - 1)
            overlap = (short - step) * short / (short * short)
            if abs(overlap - 0.4) < best:
                best, m = abs(overlap - 0.4), candidate
    found = []
    for scale in range(1, 4):
        side = math.floor(2 * short / (scale + 1))
        rows, columns = (scale, scale + m - 1) if height <= width else (scale + m - 1, scale)
        for i in range(rows):
            for j in range(columns):
                top = math.floor(i * (height - side) / (rows - 1)) if rows > 1 else 0
                left = math.floor(j * (width - side) / (columns - 1)) if columns > 1 else 0
                found.append((top, left, side))
    return found


def rmac_vectors(features, regions):
    """The largest of each channel in each region, to the power of one half."""
    squares = (features[:, top : top + side, left : left + side] for top, left, side in regions)
    largest = np.array([square.max(axis=(1, 2)) for square in squares], float)
    return normalise_rows(np.sign(largest) * np.sqrt(abs(largest)))


def vlad(local, words, soft_sharpness=None):
    """Equation 1 of NetVLAD, with the nearest word (None) or with equation 2."""
    sums = np.zeros(words.shape)
    for x in local.astype(float):
        distances = ((x - words) ** 2).sum(axis=1)
        weights = np.arange(len(words)) == distances.argmin()
        if soft_sharpness is not None:
            powers = np.exp(-soft_sharpness * distances)
            weights = powers / powers.sum()
        for k, weight in enumerate(weights):
            sums[k] += weight * (x - words[k])
    return sums


def intra_normalised(sums):
    """Each word's sum at length 1, and then all of them together."""
    return normalise_rows(np.concatenate([normalise_rows(row) if any(row) else row for row in sums]))


def regions(features, count):
    """Fill each region from its first pixel; then the `count` of largest mean: [(channel, set of (y, x), mean)]."""
    found = []
    for channel, plane in enumerate(features):
        left = {(y, x) for y, x in zip(*np.nonzero(plane > 0), strict=True)}
        while left:
            waiting, inside = [left.pop()], set()
            while waiting:
                y, x = waiting.pop()
                inside.add((y, x))
                for near in [(y + dy, x + dx) for dy in (-1, 0, 1) for dx in (-1, 0, 1)]:
                    if near in left:
                        left.remove(near)
                        waiting.append(near)
            found.append((channel, inside, sum(float(plane[y, x]) for y, x in inside) / len(inside)))
    return sorted(found, key=lambda region: -region[2])[:count]


def sum_box(features, inside):
    """The sum of each channel in the box around a region."""
    ys, xs = [y for y, _ in inside], [x for _, x in inside]
    box = features[:, min(ys) : max(ys) + 1, min(xs) : max(xs) + 1]
    return normalise_rows(box.astype(float).sum(axis=(1, 2)))


def mutual_score(query, place):
    """The sum of what those pairs have in common of which each is the other's best, over the larger number."""
    likeness = query @ place.T
    mutual = [max(likeness[i, j], 0.0) for i, j in enumerate(likeness.argmax(axis=1)) if likeness[:, j].argmax() == i]
    return sum(mutual) / max(len(query), len(place))


def bag_of_words(local, words):
    """Which words are the nearest of some vector."""
    present = np.zeros(len(words))
    for x in local.astype(float):
        present[((x - words) ** 2).sum(axis=1).argmin()] = 1
    return normalise_rows(present)
