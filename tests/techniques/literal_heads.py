"""The heads, word by word from their papers: loops, float64, nothing clever. The golden standard of the heads."""

import math

import numpy as np


def pyramid(features, levels):
    """He et al. 2014: bin i of n covers floor(i a / n) to ceil((i + 1) a / n)."""
    channels, height, width = features.shape
    out = []
    for n in levels:
        for row in range(n):
            for column in range(n):
                for channel in range(channels):
                    largest = -math.inf
                    for y in range(math.floor(row * height / n), math.ceil((row + 1) * height / n)):
                        for x in range(math.floor(column * width / n), math.ceil((column + 1) * width / n)):
                            largest = max(largest, float(features[channel, y, x]))
                    out.append(largest)
    return np.array(out)


def projected(vector, row, signs, length):
    """The whole matrix, value by value: row j is the Gaussian vector moved on by j, each column with its sign."""
    size = len(vector)
    matrix = np.zeros((length, size))
    for j in range(length):
        for i in range(size):
            matrix[j, i] = row[(i - j) % size] * signs[i]
    return np.array([sum(matrix[j, i] * float(vector[i]) for i in range(size)) for j in range(length)]) / math.sqrt(
        length
    )


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
    out = []
    for top, left, side in regions:
        vector = []
        for plane in features:
            largest = max(float(plane[y, x]) for y in range(top, top + side) for x in range(left, left + side))
            vector.append(math.copysign(math.sqrt(abs(largest)), largest))
        length = math.sqrt(sum(value * value for value in vector))
        out.append([value / length for value in vector])
    return np.array(out)


def rmac_aggregate(vectors):
    total = [sum(column) for column in vectors.T]
    length = math.sqrt(sum(value * value for value in total))
    return np.array([value / length for value in total])


def vlad(local, words, soft_sharpness=None):
    """Equation 1 of NetVLAD, with the nearest word (None) or with equation 2."""
    sums = np.zeros(words.shape)
    for x in local:
        distances = [sum((float(a) - float(b)) ** 2 for a, b in zip(x, c, strict=True)) for c in words]
        if soft_sharpness is None:
            weights = [0.0] * len(words)
            weights[distances.index(min(distances))] = 1.0
        else:
            powers = [math.exp(-soft_sharpness * d) for d in distances]
            weights = [power / sum(powers) for power in powers]
        for k, weight in enumerate(weights):
            for d in range(len(x)):
                sums[k, d] += weight * (float(x[d]) - float(words[k, d]))
    return sums


def intra_normalised(sums):
    rows = [row / math.sqrt(sum(v * v for v in row)) if any(row) else row for row in sums]
    flat = np.concatenate(rows)
    return flat / math.sqrt(sum(v * v for v in flat))


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


def under_box(features, inside):
    ys, xs = [y for y, _ in inside], [x for _, x in inside]
    sums = [
        sum(float(plane[y, x]) for y in range(min(ys), max(ys) + 1) for x in range(min(xs), max(xs) + 1))
        for plane in features
    ]
    length = math.sqrt(sum(v * v for v in sums))
    return np.array([v / length for v in sums])


def mutual_score(query, place):
    total = 0.0
    for i in range(len(query)):
        forth = [sum(a * b for a, b in zip(query[i], other, strict=True)) for other in place]
        j = forth.index(max(forth))
        back = [sum(a * b for a, b in zip(place[j], other, strict=True)) for other in query]
        if back.index(max(back)) == i:
            total += max(forth[j], 0.0)
    return total / max(len(query), len(place))


def bag_of_words(local, words):
    present = [0] * len(words)
    for x in local:
        distances = [sum((float(a) - float(b)) ** 2 for a, b in zip(x, c, strict=True)) for c in words]
        present[distances.index(min(distances))] = 1
    length = math.sqrt(sum(present))
    return np.array([n / length for n in present])
