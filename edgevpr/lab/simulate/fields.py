"""Fields: one function for each kind of field, from noise over the field to its colour and its relief."""

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

from edgevpr.lab.simulate.brush import BASE_CM, Canvas, bgr_mix, noise, smooth_step
from edgevpr.lab.simulate.layout import longest_side

GRASS, LUSH, DRY, STRAW = (60, 118, 106), (44, 96, 74), (96, 144, 150), (118, 172, 196)
SOIL, MUD = (78, 100, 126), (92, 130, 156)


@dataclass(frozen=True, slots=True)
class Plot:
    """The pixels of one field, float32 (H, W): noise with bumps of 22 m (`patches`) and of 2.4 m (`tufts`), and the
    metres across its rows."""

    patches: np.ndarray
    tufts: np.ndarray
    across_m: np.ndarray


Look = tuple[np.ndarray, np.ndarray]  # colour (H, W, 3) BGR, relief (H, W) cm


def _ploughed(plot: Plot) -> Look:
    furrow = np.sin(plot.across_m * (2 * np.pi / 1.2) + 0.5 * plot.tufts)
    return bgr_mix(
        SOIL, MUD, smooth_step(plot.patches + 0.7 * plot.tufts + 0.25 * furrow, -2, 2.4)
    ), 2 * furrow + 2 * plot.tufts


def _cereal(plot: Plot) -> Look:
    wheels = smooth_step(np.abs(np.abs(plot.across_m % 15 - 7.5) - 0.9), 0.45, 0.15)
    laid = smooth_step(plot.patches + 0.5 * plot.tufts, 1.2, 1.7)
    drilled = np.sin(plot.across_m * (2 * np.pi / 0.9))
    share = 0.6 * wheels + 0.2 * smooth_step(plot.tufts - 0.6 * plot.patches + 0.4 * drilled, -1.5, 2.5) + 0.2 * laid
    return bgr_mix(STRAW, SOIL, share), 50 - 35 * wheels - 12 * laid + 3 * plot.tufts


def _row_crop(plot: Plot) -> Look:
    plants = smooth_step(np.sin(plot.across_m * (2 * np.pi / 1.8)) + 0.6 * plot.tufts, -0.9, 0.7)
    plants = plants * smooth_step(plot.patches + 0.4 * plot.tufts, 1.9, 1.3)
    return bgr_mix(SOIL, LUSH, 0.9 * plants), 20 * plants + 2 * plot.tufts


def _meadow(plot: Plot) -> Look:
    swath = smooth_step(np.sin(plot.across_m * (2 * np.pi / 6.5)), -0.5, 0.5)
    heap = smooth_step(np.abs(plot.across_m % 6.5 - 3.2) + 0.15 * plot.tufts, 0.8, 0.3)
    share = 0.15 + 0.3 * swath + 0.12 * plot.patches + 0.2 * plot.tufts + 0.2 * heap
    return bgr_mix(GRASS, DRY, share), 8 * heap + 2 * plot.tufts


def _pasture(plot: Plot) -> Look:
    worn = smooth_step(plot.patches + 0.4 * plot.tufts, 0.4, 2.4)
    wet = smooth_step(-plot.patches, 0.3, 1.7)
    rushes = smooth_step(plot.tufts + 0.9 * plot.patches, 1.4, 2.8)
    # Cattle walk one behind the other: narrow paths wind along the lines of equal noise.
    path = smooth_step(np.abs(plot.patches + 0.02 * plot.across_m % 2 - 0.9), 0.05, 0.02)
    colour = bgr_mix(GRASS, DRY, 0.35 + 0.3 * worn - 0.3 * wet + 0.2 * plot.tufts + 0.45 * path)
    return colour * (1 - 0.3 * rushes[..., None]), 2 * plot.tufts + 10 * rushes


def _forest_floor(plot: Plot) -> Look:
    return 0.75 * bgr_mix(LUSH, SOIL, 0.35 + 0.2 * plot.tufts), 10 * plot.tufts


@dataclass(frozen=True, slots=True)
class _Kind:
    """A kind of field: how often it is found, how it looks, and the trees in it (distance, scatter and radius in
    metres)."""

    weight: float
    look: Callable[[Plot], Look]
    trees_m: tuple[float, float, float] | None = None


_KINDS = (
    _Kind(7, _pasture, (31, 40, 2.6)),
    _Kind(4, _meadow, (60, 60, 2.8)),
    _Kind(4, _ploughed),
    _Kind(5, _cereal),
    _Kind(4, _row_crop),
    _Kind(2.5, _forest_floor, (4.1, 1.4, 2.8)),
    _Kind(0.8, _pasture, (6.5, 0.25, 1.7)),  # an orchard
)


def paint_field(rng: np.random.Generator, canvas: Canvas, outline_m: np.ndarray) -> np.ndarray:
    """Paint a field of some kind; return the trees that stand in it, (N, 4) metres: east, north, radius, top."""
    weights = np.array([kind.weight for kind in _KINDS])
    kind = _KINDS[rng.choice(len(_KINDS), p=weights / weights.sum())]
    side = longest_side(outline_m[:: max(1, len(outline_m) // 10)])
    turn_rad = np.arctan2(side[1], side[0]) + rng.normal(0, 0.06)
    along = np.array([np.cos(turn_rad), np.sin(turn_rad)])
    box = canvas.box(outline_m)
    if canvas.height_cm[box].size:
        cover = canvas.polygon(box, outline_m)
        east_m, north_m = canvas.grid_m(box)
        patches = noise(rng, cover.shape, 22 / canvas.metres_per_pixel)
        tufts = noise(rng, cover.shape, 2.4 / canvas.metres_per_pixel)
        across_m = -along[1] * east_m + along[0] * north_m + 0.4 * patches
        colour, relief_cm = kind.look(Plot(patches, tufts, across_m))
        canvas.paint(box, cover, colour * rng.uniform(0.85, 1.12) * rng.normal(1, 0.025, 3))
        canvas.height_cm[box] = np.where(cover > 0.5, np.clip(BASE_CM + relief_cm, 0, None), canvas.height_cm[box])
    return _trees(rng, outline_m, along, *kind.trees_m) if kind.trees_m else np.empty((0, 4))


def _trees(rng, outline_m: np.ndarray, along: np.ndarray, spacing_m: float, scatter_m: float, radius_m: float):
    reach_m = np.arange(-110, 110, spacing_m)
    u, v = (axis.reshape(-1, 1) for axis in np.meshgrid(reach_m, reach_m))
    points_m = outline_m.mean(axis=0) + u * along + v * np.array([-along[1], along[0]])
    points_m = points_m + rng.normal(0, scatter_m, points_m.shape)
    outline = outline_m.astype(np.float32)
    inside = [cv2.pointPolygonTest(outline, (float(x), float(y)), True) > 2.5 for x, y in points_m]
    points_m = points_m[np.array(inside, bool)]
    radius = radius_m * rng.uniform(0.6, 1.35, (len(points_m), 1))
    return np.hstack((points_m, radius, radius * rng.uniform(1.6, 2.6, radius.shape)))
