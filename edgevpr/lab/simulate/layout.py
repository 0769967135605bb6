"""Layout of a scene: winding lines, and land cut into fields. Points are (N, 2) east, north in metres."""

import numpy as np

from edgevpr.lab.simulate.brush import noise

_GRID_M = 8.0


def winding(rng: np.random.Generator, start_m, end_m, swing_m: float) -> np.ndarray:
    """Make a winding line of 200 points from near `start_m` to near `end_m`."""
    start_m, end_m = np.asarray(start_m), np.asarray(end_m)
    along = (end_m - start_m) / np.linalg.norm(end_m - start_m)
    t = np.linspace(0, 1, 200)[:, None]
    swing = sum(swing_m / wave * np.sin(2 * np.pi * (wave * t + rng.random())) for wave in (0.9, 1.8, 3.2))
    return start_m + t * (end_m - start_m) + swing * np.array([-along[1], along[0]])


def parcels(
    rng: np.random.Generator, width_m: float, depth_m: float, field_m2: float
) -> tuple[list[np.ndarray], list[tuple[int, np.ndarray]]]:
    """Cut the land by straight lines until every piece is about `field_m2`.

    Returns the pieces (convex polygons) and every cut as (level, its two ends): level 0 crosses all the land.
    """
    fields, cuts = [], []
    todo = [(0, np.array([(-20, -20), (width_m + 20, -20), (width_m + 20, depth_m + 20), (-20, depth_m + 20)]))]
    while todo:
        level, piece = todo.pop()
        if _area_m2(piece) < field_m2 * rng.uniform(0.7, 1.8):
            fields.append(piece)
            continue
        side = longest_side(piece)
        angle = np.arctan2(side[1], side[0]) + np.pi / 2 + rng.normal(0, 0.16)
        through = piece.mean(axis=0) + rng.uniform(-0.2, 0.2) * side
        halves, line = _cut(piece, through, np.array([np.cos(angle), np.sin(angle)]))
        cuts.append((level, line))
        todo += [(level + 1, half) for half in halves]
    return fields, cuts


def longest_side(polygon: np.ndarray) -> np.ndarray:
    """Return the longest side of a polygon as a vector."""
    sides = np.roll(polygon, -1, axis=0) - polygon
    return sides[np.argmax(np.hypot(*sides.T))]


class Bend:
    """Bends straight lines a little, everywhere in the same way, so that lines that touched still touch."""

    def __init__(self, rng: np.random.Generator, width_m: float, depth_m: float, by_m: float) -> None:
        shape = int(depth_m / _GRID_M) + 8, int(width_m / _GRID_M) + 8
        self._shift_m = by_m * np.stack([noise(rng, shape, 7, 1), noise(rng, shape, 7, 1)], axis=-1)

    def __call__(self, points_m: np.ndarray, closed: bool) -> np.ndarray:
        """Return the line through the points as a chain of short pieces, bent; `closed` joins its ends."""
        ends_m = np.roll(points_m, -1, axis=0) if closed else points_m[1:]
        chain = [
            np.linspace(a, b, max(2, int(np.hypot(*(b - a)) / 5)), endpoint=False)
            for a, b in zip(points_m, ends_m, strict=False)
        ]
        line_m = np.concatenate(chain if closed else [*chain, points_m[-1:]])
        column, row = np.clip(line_m / _GRID_M + 3, 0, np.array(self._shift_m.shape[1::-1]) - 1.001).T
        i, j, di, dj = row.astype(int), column.astype(int), (row % 1)[:, None], (column % 1)[:, None]
        shift = self._shift_m
        upper = shift[i, j] * (1 - dj) + shift[i, j + 1] * dj
        lower = shift[i + 1, j] * (1 - dj) + shift[i + 1, j + 1] * dj
        return line_m + upper * (1 - di) + lower * di


def _area_m2(polygon: np.ndarray) -> float:
    x, y = polygon.T
    return abs(float(np.dot(x, np.roll(y, -1)) - np.dot(np.roll(x, -1), y))) / 2


def _cut(piece: np.ndarray, through: np.ndarray, along: np.ndarray) -> tuple[list[np.ndarray], np.ndarray]:
    """Return both halves of a convex polygon, and the cut between them."""
    side = (piece - through) @ np.array([-along[1], along[0]])
    halves: tuple[list, list] = ([], [])
    line = []
    for here, there, s, t in zip(piece, np.roll(piece, -1, axis=0), side, np.roll(side, -1), strict=True):
        halves[int(s < 0)].append(here)
        if (s < 0) != (t < 0):
            crossing = here + (there - here) * s / (s - t)
            line.append(crossing)
            for half in halves:
                half.append(crossing)
    return [np.array(half) for half in halves], np.array(line)
