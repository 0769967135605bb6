"""Brushes that paint a scene (noise, roofs, tree crowns), and the lines along which `landscape` paints: winding lines,
and lines that divide land into fields. Points are (N, 2): east, north in metres."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from edgevpr.core.arrays import Array, Doubles, Floats, Image, Singles

Box = tuple[slice, slice]  # rows, columns
_GRID_M = 8.0
BASE_CM = 300  # height of open ground; high enough that river beds and furrows stay above zero
CORNERS = ((1, 1), (1, -1), (-1, -1), (-1, 1))  # the corners of a rectangle


@dataclass(frozen=True, slots=True)
class Scene:
    """Ground before lighting: `albedo`, uint8 (H, W, 3) BGR, and `height_cm`, uint16 (H, W), above a common datum, both
    painted in place. North is up, and the south-west corner is the point 0 m east, 0 m north. A *box* is a rectangle of
    pixels, as slices of rows and columns."""

    albedo: Image
    height_cm: NDArray[np.uint16]
    metres_per_pixel: float

    @property
    def shape(self) -> tuple[int, int]:
        return self.height_cm.shape[0], self.height_cm.shape[1]

    def pixels(self, points_m: ArrayLike) -> Floats:
        """Convert (N, 2) east, north in metres to float32 (N, 2) column, row."""
        east_m, north_m = np.asarray(points_m, np.float32).T
        return np.column_stack((east_m, self.shape[0] * self.metres_per_pixel - north_m)) / self.metres_per_pixel

    def box(self, points_m: ArrayLike, margin_m: float = 0.0) -> Box:
        """Return the bounding box of points plus `margin_m` on each side, clipped to the scene."""
        margin = margin_m / self.metres_per_pixel
        low, high = self.pixels(points_m).min(axis=0) - margin, self.pixels(points_m).max(axis=0) + margin
        (left, top), (right, bottom) = np.maximum(low, 0).astype(int), np.maximum(np.ceil(high), 0).astype(int)
        return slice(top, max(top, min(bottom, self.shape[0]))), slice(left, max(left, min(right, self.shape[1])))

    def grid_m(self, box: Box) -> tuple[Floats, Floats]:
        """Return the east (1, W) and north (H, 1) coordinates of the pixels in a box, float32 in metres."""
        rows, columns = (np.arange(part.start, part.stop, dtype=np.float32) + 0.5 for part in box)
        return columns[None] * self.metres_per_pixel, ((self.shape[0] - rows) * self.metres_per_pixel)[:, None]

    def polygon(self, box: Box, points_m: ArrayLike) -> Floats:
        """Return the fraction of each pixel of a box that a polygon covers, float32 (H, W), with antialiased edges."""
        cover = np.zeros_like(self.height_cm[box], np.uint8)
        corners = (self.pixels(points_m) - (box[1].start, box[0].start)) * 16
        cv2.fillPoly(cover, [corners.round().astype(np.int32)], 255, cv2.LINE_AA, 4)
        return cover.astype(np.float32) / 255

    def distance_m(self, box: Box, line_m: ArrayLike) -> Floats:
        """Return the distance of each pixel in a box from a polyline, float32 (H, W) in metres."""
        background_mask = np.full_like(self.height_cm[box], 255, np.uint8)
        points = self.pixels(line_m) - (box[1].start, box[0].start)
        cv2.polylines(background_mask, [points.round().astype(np.int32)], False, 0)
        return cv2.distanceTransform(background_mask, cv2.DIST_L2, 5) * self.metres_per_pixel

    def paint(self, box: Box, cover: Array, colour: ArrayLike) -> None:
        """Paint a colour, (3,) or (H, W, 3) BGR, over a box with the opacity `cover`, (H, W), 0..1."""
        is_painted = cover > 0
        old = self.albedo[box][is_painted].astype(np.float32)
        new = np.asarray(colour, np.float32)
        new = new[is_painted] if new.ndim == 3 else new
        self.albedo[box][is_painted] = np.clip(old + cover[is_painted][:, None] * (new - old), 0, 255)


def make_noise(rng: np.random.Generator, shape: tuple[int, int], first_px: float, octaves: int = 3) -> Singles:
    """Make smooth noise, float32 of `shape`, with mean 0 and standard deviation 1. The first of `octaves` octaves has
    bumps `first_px` wide, and each further one bumps half as wide."""
    total = np.zeros(shape, np.float32)
    for octave in range(octaves):
        step = max(first_px / 2**octave, 1.0)
        coarse = rng.standard_normal((int(shape[0] / step) + 3, int(shape[1] / step) + 3), np.float32)
        # Crop from a larger picture, so that the bumps have the same size in a box of any size.
        size = (round(coarse.shape[1] * step), round(coarse.shape[0] * step))
        total += cv2.resize(coarse / 1.6**octave, size, interpolation=cv2.INTER_CUBIC)[: shape[0], : shape[1]]
    total -= total.mean()
    total /= max(float(total.std()), 1e-6)
    return total


def mix_colours(low: tuple[int, int, int], high: tuple[int, int, int], weight: Array) -> Array:
    """Blend two colours by `weight` (H, W), 0 for `low` and 1 for `high`: float32 (H, W, 3)."""
    first, last = np.asarray(low, np.float32), np.asarray(high, np.float32)
    return np.asarray(first + weight[..., None] * (last - first))


def smooth_step(values: Array, low: float, high: float) -> Array:
    """Return 0 below `low`, 1 above `high`, a linear ramp between. With low > high: 1 below `high`, 0 above `low`."""
    return np.clip((values - low) / (high - low), 0, 1)


def paint_building(
    canvas: Scene, centre_m: Doubles, length_m: float, width_m: float, turn_rad: float, wall_m: float, colour: Doubles
) -> None:
    """Paint a building with walls `wall_m` high and a gable roof, its ridge `turn_rad` anticlockwise from east."""
    along, across = rotate_axes(turn_rad)
    corners = [centre_m + a * along * length_m / 2 + b * across * width_m / 2 for a, b in CORNERS]
    box = canvas.box(corners, 1.0)
    cover = canvas.polygon(box, corners)
    east_m, north_m = canvas.grid_m(box)
    u_m = (east_m - centre_m[0]) * along[0] + (north_m - centre_m[1]) * along[1]
    v_m = np.abs((east_m - centre_m[0]) * across[0] + (north_m - centre_m[1]) * across[1])
    sheets = 1 + 0.06 * np.sin(u_m * (2 * np.pi / 1.1)) - 0.10 * (v_m < 0.25)
    canvas.paint(box, cover, np.asarray(colour) * sheets[..., None])
    gable_cm = BASE_CM + 100 * (wall_m + 0.45 * np.clip(width_m / 2 - v_m, 0, None))
    canvas.height_cm[box] = np.where(cover > 0.5, gable_cm, canvas.height_cm[box])


def make_crown(rng: np.random.Generator, radius_px: int) -> Singles:
    """Make the dome of one tree, float32 (D, D), D = 2 `radius_px` + 1: 0..1.2, and 0 outside its ragged outline."""
    axis = np.arange(-radius_px, radius_px + 1, dtype=np.float32) / radius_px
    lumps = make_noise(rng, (len(axis), len(axis)), max(radius_px * 0.7, 2.0), 2)
    leaves = make_noise(rng, (len(axis), len(axis)), 2.5, 2)
    dome = 1 - (axis[None] ** 2 + axis[:, None] ** 2) * (1.2 + 0.2 * lumps + 0.12 * leaves)
    return np.asarray(np.sqrt(np.clip(dome, 0, 1)) * np.clip(1 + 0.08 * lumps + 0.06 * leaves, 0, 1.2))


def paint_tree(canvas: Scene, dome: Singles, centre_m: tuple[float, float], top_m: float, colour: Doubles) -> None:
    """Paint one tree with a `dome` from `make_crown`, `top_m` metres high. Higher crowns hide the lower ones."""
    radius = len(dome) // 2
    column, row = canvas.pixels([centre_m])[0].astype(int)
    if not (radius <= column < canvas.shape[1] - radius and radius <= row < canvas.shape[0] - radius):
        return
    box = slice(row - radius, row + radius + 1), slice(column - radius, column + radius + 1)
    top_cm = BASE_CM + 100 * top_m * (0.35 + 0.65 * dome)
    visible = (dome > 0.05) & (top_cm > canvas.height_cm[box])
    canvas.height_cm[box][visible] = top_cm[visible]
    canvas.albedo[box][visible] = np.clip(np.asarray(colour) * (0.55 + 0.5 * dome[visible][:, None]), 0, 255)


def rotate_axes(turn_rad: float) -> tuple[Doubles, Doubles]:
    """Return two unit vectors (2,): in the direction `turn_rad`, anticlockwise from east, and to its left."""
    return np.array([np.cos(turn_rad), np.sin(turn_rad)]), np.array([-np.sin(turn_rad), np.cos(turn_rad)])


def make_winding(
    rng: np.random.Generator, start: tuple[float, float], end: tuple[float, float], swing_m: float
) -> Doubles:
    """Make a line of 200 points from near `start` to near `end` that swings by about `swing_m` metres to each side."""
    start_m, end_m = np.asarray(start), np.asarray(end)
    along = (end_m - start_m) / np.linalg.norm(end_m - start_m)
    t = np.linspace(0, 1, 200)[:, None]
    swing = sum(swing_m / wave * np.sin(2 * np.pi * (wave * t + rng.random())) for wave in (0.9, 1.8, 3.2))
    return np.asarray(start_m + t * (end_m - start_m) + swing * np.array([-along[1], along[0]]))


def cut_parcels(
    rng: np.random.Generator, width_m: float, depth_m: float, field_m2: float
) -> tuple[list[Doubles], list[tuple[int, Doubles]]]:
    """Cut the land along straight lines until each piece has about `field_m2` square metres. Returns the pieces, convex
    polygons (N, 2), and the cuts, each as a level and its two ends (2, 2). A cut of level 0 crosses the whole land, one
    of level 1 half of it, one of level 2 a quarter, and so on."""
    fields, cuts = [], []
    pending = [(0, np.array([(-20, -20), (width_m + 20, -20), (width_m + 20, depth_m + 20), (-20, depth_m + 20)]))]
    while pending:
        level, piece = pending.pop()
        x, y = piece.T
        area_m2 = abs(float(np.dot(x, np.roll(y, -1)) - np.dot(np.roll(x, -1), y))) / 2
        if area_m2 < field_m2 * rng.uniform(0.7, 1.8):
            fields.append(piece)
            continue
        side = find_longest_side(piece)
        angle = np.arctan2(side[1], side[0]) + np.pi / 2 + rng.normal(0, 0.16)
        point = piece.mean(axis=0) + rng.uniform(-0.2, 0.2) * side
        halves, line = _cut(piece, point, rotate_axes(angle)[1])
        cuts.append((level, line))
        pending += [(level + 1, half) for half in halves]
    return fields, cuts


def find_longest_side(polygon: Doubles) -> Doubles:
    """Return the longest side of a polygon (N, 2) as a vector (2,)."""
    sides = np.roll(polygon, -1, axis=0) - polygon
    return np.asarray(sides[np.argmax(np.hypot(*sides.T))])


class LineBender:
    """Bends straight lines by about `amplitude_m` metres. Nearby points move together."""

    def __init__(self, rng: np.random.Generator, width_m: float, depth_m: float, amplitude_m: float) -> None:
        shape = int(depth_m / _GRID_M) + 8, int(width_m / _GRID_M) + 8
        self._shift_m = amplitude_m * np.stack([make_noise(rng, shape, 7, 1), make_noise(rng, shape, 7, 1)], axis=-1)

    def __call__(self, points_m: Doubles, closed: bool) -> Doubles:
        """Return the bent line point the points, as a chain of short segments; `closed` joins its ends."""
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
        return np.asarray(line_m + upper * (1 - di) + lower * di)


def _cut(piece: Doubles, point: Doubles, normal: Doubles) -> tuple[list[Doubles], Doubles]:
    """Cut a convex polygon at `point`, perpendicular to `normal`; return the halves and the ends of the cut (2, 2)."""
    side = (piece - point) @ normal
    halves: tuple[list[Doubles], list[Doubles]] = ([], [])
    line: list[Doubles] = []
    for start, end, s, t in zip(piece, np.roll(piece, -1, axis=0), side, np.roll(side, -1), strict=True):
        halves[int(s < 0)].append(start)
        if (s < 0) != (t < 0):
            crossing = start + (end - start) * s / (s - t)
            line.append(crossing)
            for half in halves:
                half.append(crossing)
    return [np.array(half) for half in halves], np.array(line)
