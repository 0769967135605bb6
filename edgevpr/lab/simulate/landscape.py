"""Generates farmland seen from above, from a seed, as a substitute for a real site; `camera` photographs it.

The land is divided into fields along bent lines (points are (N, 2): east, north in metres). Each field is painted as
one kind, such as meadow; then a river, a road, farms and trees, (N, 4) metres: east, north, radius, top."""

from collections.abc import Callable, Iterable

import cv2
import numpy as np

from edgevpr.core.arrays import Array, Doubles, Singles
from edgevpr.lab.simulate.brush import (
    BASE_CM,
    CORNERS,
    LineBender,
    Scene,
    cut_parcels,
    find_longest_side,
    make_crown,
    make_noise,
    make_winding,
    mix_colours,
    paint_building,
    paint_tree,
    rotate_axes,
    smooth_step,
)

# Colours under even white light, BGR.
_GRAVEL = (160, 178, 190)
_ASPHALT = (120, 122, 122)
_WATER = (50, 56, 46)
_STONE = (150, 154, 156)
_ROOFS = ((62, 78, 142), (58, 68, 104), (112, 104, 98), (190, 186, 180), (150, 148, 132), (88, 104, 150))
# Offset from the yard's centre along and across the road, length, width (metres), ridge direction in quarter turns.
_BUILDINGS = ((-9, 8, 17, 8.5, 0), (8, 9, 12, 7, 0), (10, -6, 18, 8, 1), (-8, -8, 11, 7.5, 0), (-16, -1, 5, 4, 0))
_LEAVES = np.array([(42, 84, 62), (36, 72, 50), (50, 100, 84), (60, 106, 98), (46, 76, 68)], float)
_GRASS = (60, 118, 106)
_LUSH = (44, 96, 74)
_DRY = (96, 144, 150)
_STRAW = (118, 172, 196)
_SOIL = (78, 100, 126)
_MUD = (92, 130, 156)


def make_scene(seed: int, width_m: float, depth_m: float, metres_per_pixel: float = 0.16) -> Scene:
    """Generate a scene: fields, hedges, woods, a river, a road, lanes and farms. The same seed gives the same scene."""
    rng = np.random.default_rng(seed)
    shape = round(depth_m / metres_per_pixel), round(width_m / metres_per_pixel)
    canvas = Scene(np.full((*shape, 3), _GRASS, np.uint8), np.full(shape, BASE_CM, np.uint16), metres_per_pixel)
    river_m = make_winding(rng, (width_m * 0.55, depth_m * 1.1), (width_m * 0.45, -depth_m * 0.1), 30)
    road_m = make_winding(rng, (-width_m * 0.1, depth_m * 0.42), (width_m * 1.1, depth_m * 0.60), 14)
    bend = LineBender(rng, width_m, depth_m, amplitude_m=2.5)
    fields, cuts = cut_parcels(rng, width_m, depth_m, field_m2=7500)
    trees = [_paint_field(rng, canvas, bend(field_m, closed=True)) for field_m in fields]
    trees += [_paint_border(rng, canvas, bend(cut_m, closed=False), level) for level, cut_m in cuts]
    trees.append(_paint_river(rng, canvas, river_m))
    _paint_road(rng, canvas, road_m)
    yards_m = _paint_farms(rng, canvas, road_m, river_m)
    _vary_brightness(rng, canvas)
    _paint_trees(rng, canvas, np.concatenate(trees), clearances_m=((road_m, 4.0), (river_m, 7.0), (yards_m, 19.0)))
    return canvas


def _paint_border(rng: np.random.Generator, canvas: Scene, line_m: Doubles, level: int) -> Doubles:
    """Paint the border between two fields and return its trees. Cuts of level 0 and 1 (see `cut_parcels`) are lanes."""
    box = canvas.box(line_m, 5.0)
    if canvas.height_cm[box].size == 0:
        return np.empty((0, 4))
    distance_m = canvas.distance_m(box, line_m)
    verge = smooth_step(distance_m + 0.4 * make_noise(rng, distance_m.shape, 25, 2), 3.4, 1.8)
    canvas.paint(box, verge * 0.8, _DRY if rng.random() < 0.5 else _LUSH)
    canvas.height_cm[box] = np.where(verge > 0.5, BASE_CM, canvas.height_cm[box])
    kind = "lane" if level <= 1 else rng.choice(["hedge", "wall", "strip"], p=[0.6, 0.15, 0.25])
    if kind == "lane":
        canvas.paint(box, smooth_step(distance_m, 1.9, 1.4), _MUD)
        canvas.paint(box, smooth_step(np.abs(distance_m - 0.85), 0.5, 0.2), _GRAVEL)
    if kind == "wall":
        wall = smooth_step(distance_m, 0.6, 0.4)
        canvas.paint(box, wall, _STONE)
        canvas.height_cm[box] = np.where(wall > 0.5, BASE_CM + 130, canvas.height_cm[box])
    if kind == "strip" or (kind in ("lane", "wall") and rng.random() < 0.6):
        return _make_trees(rng, line_m, step_m=26, spread_m=1.5 if kind == "strip" else 4.5, radius_m=2.6)
    if kind == "hedge":
        shrubs = _make_trees(rng, line_m, step_m=1.3, spread_m=0.35, radius_m=1.25)
        gaps = np.sin(np.arange(len(shrubs)) * rng.uniform(0.05, 0.2) + rng.uniform(0, 6)) > -0.85
        return np.concatenate((shrubs[gaps], _make_trees(rng, line_m, step_m=22, spread_m=0.8, radius_m=2.9)))
    return np.empty((0, 4))


def _make_trees(rng: np.random.Generator, line_m: Doubles, step_m: float, spread_m: float, radius_m: float) -> Doubles:
    """Return trees with radii of about `radius_m`, about every `step_m` along a line and about `spread_m` from it."""
    length_m = np.concatenate(([0], np.cumsum(np.hypot(*np.diff(line_m, axis=0).T))))
    tree_m = np.arange(rng.uniform(0, step_m), length_m[-1], step_m)
    tree_m += rng.normal(0, step_m * 0.25, len(tree_m))
    points = np.column_stack([np.interp(tree_m, length_m, line_m[:, axis]) for axis in (0, 1)])
    points += rng.normal(0, spread_m, points.shape)
    return _grow_trees(rng, points, radius_m, (1.4, 2.2))


def _paint_river(rng: np.random.Generator, canvas: Scene, line_m: Doubles) -> Doubles:
    box = canvas.box(line_m, 24.0)
    shape = canvas.height_cm[box].shape
    coarse = make_noise(rng, shape, 40 / canvas.metres_per_pixel, 2)
    fine = make_noise(rng, shape, 5 / canvas.metres_per_pixel)
    distance_m = canvas.distance_m(box, line_m) + 1.3 * coarse + 0.5 * fine
    canvas.paint(box, 0.85 * smooth_step(distance_m, 15, 9), _LUSH)
    canvas.paint(box, smooth_step(distance_m, 7.2, 6.2) * smooth_step(fine, -3, 1), _GRAVEL)
    bars = smooth_step(coarse + 0.3 * fine, 1.2, 1.5) * smooth_step(distance_m, 1.0, 2.5)
    water = smooth_step(distance_m, 5.6, 5.0) * (1 - bars)
    canvas.paint(box, water, _WATER)
    canvas.paint(box, water * (0.15 * smooth_step(distance_m, 2, 5.5) + 0.08 * smooth_step(fine, 0, 2)), _STONE)
    bank = smooth_step(distance_m, 12.5, 9)
    level_cm = BASE_CM + bank * 12 * fine - 170 * smooth_step(distance_m, 8.5, 5.5)
    canvas.height_cm[box] = np.where(bank > 0, np.clip(level_cm, 0, None), canvas.height_cm[box])
    across = np.gradient(line_m, axis=0)[:, ::-1] * (-1, 1) / np.hypot(*np.gradient(line_m, axis=0).T)[:, None]
    return np.concatenate([_make_trees(rng, line_m + side * 11 * across, 8.0, 2.5, 2.6) for side in (-1, 1)])


def _paint_road(rng: np.random.Generator, canvas: Scene, line_m: Doubles) -> None:
    box = canvas.box(line_m, 7.0)
    distance_m = canvas.distance_m(box, line_m)
    worn = make_noise(rng, distance_m.shape, 12 / canvas.metres_per_pixel)
    canvas.paint(box, 0.9 * smooth_step(distance_m + 0.3 * worn, 5.5, 4.2), _DRY)
    canvas.paint(box, smooth_step(distance_m, 2.95, 2.75), _ASPHALT)
    canvas.paint(box, 0.3 * smooth_step(distance_m, 2.95, 2.75) * smooth_step(worn, -1, 2), _STONE)
    canvas.paint(box, 0.3 * smooth_step(np.abs(distance_m - 1.3), 0.7, 0.2), (146, 148, 150))
    canvas.paint(box, 0.7 * smooth_step(np.abs(distance_m - 2.5), 0.14, 0.06), (215, 220, 222))
    canvas.height_cm[box] = np.where(distance_m < 4.2, BASE_CM + 20, canvas.height_cm[box])


def _paint_farms(rng: np.random.Generator, canvas: Scene, road_m: Doubles, river_m: Doubles) -> Doubles:
    """Paint farms beside the road, away from the river; return the centres of their yards, (N, 2) metres."""
    yards = []
    for index in range(18, len(road_m) - 18, 13):
        direction = road_m[index + 1] - road_m[index]
        turn_rad = float(np.arctan2(direction[1], direction[0])) + rng.normal(0, 0.12)
        along, across = rotate_axes(turn_rad)
        centre = road_m[index] + across * rng.choice([-1, 1]) * 24 + along * rng.normal(0, 4)
        if np.hypot(*(river_m - centre).T).min() > 42 and rng.random() < 0.7:
            _paint_farm(rng, canvas, centre, turn_rad)
            yards.append(centre)
    return np.array(yards).reshape(-1, 2)


def _paint_farm(rng: np.random.Generator, canvas: Scene, yard_centre: Doubles, turn_rad: float) -> None:
    """Paint a yard with ragged edges, buildings around it and vehicles on it."""
    along, across = rotate_axes(turn_rad)
    yard = np.array([yard_centre + a * along * 19 + b * across * 17 for a, b in CORNERS])
    box = canvas.box(yard, 4.0)
    cover = canvas.polygon(box, yard)
    ragged = smooth_step(cv2.GaussianBlur(cover, (0, 0), 8) + 0.16 * make_noise(rng, cover.shape, 30), 0.42, 0.58)
    canvas.paint(box, ragged, np.array(_GRAVEL if rng.random() < 0.6 else _MUD) * rng.uniform(0.8, 0.95))
    canvas.height_cm[box] = np.where(ragged > 0.3, BASE_CM, canvas.height_cm[box])
    for u_m, v_m, length_m, width_m, quarter_turns in _BUILDINGS:
        if rng.random() < 0.8:
            centre = yard_centre + (u_m + rng.normal(0, 1)) * along + (v_m + rng.normal(0, 1)) * across
            length_m, width_m = (np.array((length_m, width_m)) * rng.uniform(0.8, 1.25, 2)).tolist()
            colour = np.array(_ROOFS[rng.integers(len(_ROOFS))]) * rng.uniform(0.85, 1.1)
            ridge_rad = turn_rad + quarter_turns * np.pi / 2
            paint_building(canvas, centre, length_m, width_m, ridge_rad, rng.uniform(2.6, 5), colour)
    for _ in range(rng.integers(2, 7)):
        centre = yard_centre + rng.uniform(-14, 14) * along + rng.uniform(-2, 3) * across
        colour = rng.uniform(60, 225) * rng.uniform(0.6, 1.2, 3)
        ridge_rad = turn_rad + rng.integers(2) * np.pi / 2 + rng.normal(0, 0.2)
        paint_building(canvas, centre, 4.3, 1.9, ridge_rad, 1.4, colour)


def _vary_brightness(rng: np.random.Generator, canvas: Scene) -> None:
    """Vary the brightness of the ground in patches of 60 m, 5 m and 1 m, because real ground is never uniform."""
    for contrast, bump_m in ((0.06, 60.0), (0.07, 5.0), (0.08, 1.0)):
        bump_px = max(bump_m / canvas.metres_per_pixel, 2.0)
        coarse = max(2, int(bump_px / 8))
        change = make_noise(rng, (canvas.shape[0] // coarse + 1, canvas.shape[1] // coarse + 1), bump_px / coarse, 3)
        change = np.clip(128 * (1 + contrast * change), 0, 255).astype(np.uint8)
        change = cv2.resize(change, canvas.shape[::-1], interpolation=cv2.INTER_LINEAR)
        for channel in range(3):
            canvas.albedo[..., channel] = cv2.multiply(canvas.albedo[..., channel], change, scale=1 / 128)


def _paint_trees(
    rng: np.random.Generator, canvas: Scene, trees: Doubles, clearances_m: Iterable[tuple[Doubles, float]]
) -> None:
    """Paint the trees that are further from each line of points in `clearances_m` than its clearance, in metres."""
    for line_m, clear_m in clearances_m:
        gap_m = np.hypot(*(trees[:, None, :2] - line_m[None]).T).T
        trees = trees[(gap_m > clear_m).all(axis=1)]
    domes: dict[int, list[Singles]] = {}
    for east_m, north_m, radius_m, top_m in trees:
        radius_px = max(2, round(radius_m / canvas.metres_per_pixel))
        if radius_px not in domes:
            domes[radius_px] = [make_crown(rng, radius_px) for _ in range(4)]
        colour = _LEAVES[rng.integers(len(_LEAVES))] * rng.uniform(0.8, 1.2)
        paint_tree(canvas, domes[radius_px][rng.integers(4)], (east_m, north_m), top_m, colour)


# Textures of fields. `patches` and `tufts`, float32 (H, W), are noise with bumps of 22 m and 2.4 m; `across_m` is the
# distance in metres across the rows of the field.
FieldTexture = tuple[Array, Array]  # colour (H, W, 3) BGR, relief (H, W) cm


def _texture_plough(patches: Singles, tufts: Singles, across_m: Array) -> FieldTexture:
    furrow = np.sin(across_m * (2 * np.pi / 1.2) + 0.5 * tufts)
    return mix_colours(_SOIL, _MUD, smooth_step(patches + 0.7 * tufts + 0.25 * furrow, -2, 2.4)), 2 * furrow + 2 * tufts


def _texture_cereal(patches: Singles, tufts: Singles, across_m: Array) -> FieldTexture:
    wheels = smooth_step(np.abs(np.abs(across_m % 15 - 7.5) - 0.9), 0.45, 0.15)
    lodged = smooth_step(patches + 0.5 * tufts, 1.2, 1.7)
    drilled = np.sin(across_m * (2 * np.pi / 0.9))
    weight = 0.6 * wheels + 0.2 * smooth_step(tufts - 0.6 * patches + 0.4 * drilled, -1.5, 2.5) + 0.2 * lodged
    return mix_colours(_STRAW, _SOIL, weight), 50 - 35 * wheels - 12 * lodged + 3 * tufts


def _texture_row_crop(patches: Singles, tufts: Singles, across_m: Array) -> FieldTexture:
    plants = smooth_step(np.sin(across_m * (2 * np.pi / 1.8)) + 0.6 * tufts, -0.9, 0.7)
    plants = plants * smooth_step(patches + 0.4 * tufts, 1.9, 1.3)
    return mix_colours(_SOIL, _LUSH, 0.9 * plants), 20 * plants + 2 * tufts


def _texture_meadow(patches: Singles, tufts: Singles, across_m: Array) -> FieldTexture:
    swath = smooth_step(np.sin(across_m * (2 * np.pi / 6.5)), -0.5, 0.5)
    heap = smooth_step(np.abs(across_m % 6.5 - 3.2) + 0.15 * tufts, 0.8, 0.3)
    weight = 0.15 + 0.3 * swath + 0.12 * patches + 0.2 * tufts + 0.2 * heap
    return mix_colours(_GRASS, _DRY, weight), 8 * heap + 2 * tufts


def _texture_pasture(patches: Singles, tufts: Singles, across_m: Array) -> FieldTexture:
    worn = smooth_step(patches + 0.4 * tufts, 0.4, 2.4)
    wet = smooth_step(-patches, 0.3, 1.7)
    rushes = smooth_step(tufts + 0.9 * patches, 1.4, 2.8)
    # Cattle walk in single file, so narrow paths wind along the contour lines of the noise.
    path = smooth_step(np.abs(patches + 0.02 * across_m % 2 - 0.9), 0.05, 0.02)
    colour = mix_colours(_GRASS, _DRY, 0.35 + 0.3 * worn - 0.3 * wet + 0.2 * tufts + 0.45 * path)
    return colour * (1 - 0.3 * rushes[..., None]), 2 * tufts + 10 * rushes


def _texture_forest_floor(patches: Singles, tufts: Singles, across_m: Array) -> FieldTexture:
    return 0.75 * mix_colours(_LUSH, _SOIL, 0.35 + 0.2 * tufts), 10 * tufts


# Kinds of fields: relative frequency, texture, and trees (spacing, scatter and radius in metres; None: no trees).
_FIELD_KINDS: tuple[
    tuple[float, Callable[[Singles, Singles, Array], FieldTexture], tuple[float, float, float] | None], ...
] = (
    (7, _texture_pasture, (31, 40, 2.6)),
    (4, _texture_meadow, (60, 60, 2.8)),
    (4, _texture_plough, None),
    (5, _texture_cereal, None),
    (4, _texture_row_crop, None),
    (2.5, _texture_forest_floor, (4.1, 1.4, 2.8)),
    (0.8, _texture_pasture, (6.5, 0.25, 1.7)),  # an orchard
)


def _paint_field(rng: np.random.Generator, canvas: Scene, outline_m: Doubles) -> Doubles:
    """Paint a field of a random kind inside its outline (N, 2); return its trees."""
    weights = np.array([weight for weight, _, _ in _FIELD_KINDS])
    _, make_texture, trees_m = _FIELD_KINDS[rng.choice(len(_FIELD_KINDS), p=weights / weights.sum())]
    side = find_longest_side(outline_m[:: max(1, len(outline_m) // 10)])
    turn_rad = np.arctan2(side[1], side[0]) + rng.normal(0, 0.06)
    along, _ = rotate_axes(turn_rad)
    box = canvas.box(outline_m)
    if canvas.height_cm[box].size:
        cover = canvas.polygon(box, outline_m)
        east_m, north_m = canvas.grid_m(box)
        patches = make_noise(rng, cover.shape, 22 / canvas.metres_per_pixel)
        tufts = make_noise(rng, cover.shape, 2.4 / canvas.metres_per_pixel)
        across_m = -along[1] * east_m + along[0] * north_m + 0.4 * patches
        colour, relief_cm = make_texture(patches, tufts, across_m)
        canvas.paint(box, cover, colour * rng.uniform(0.85, 1.12) * rng.normal(1, 0.025, 3))
        canvas.height_cm[box] = np.where(cover > 0.5, np.clip(BASE_CM + relief_cm, 0, None), canvas.height_cm[box])
    return _make_tree_rows(rng, outline_m, turn_rad, *trees_m) if trees_m else np.empty((0, 4))


def _make_tree_rows(
    rng: np.random.Generator, outline_m: Doubles, turn_rad: float, spacing_m: float, scatter_m: float, radius_m: float
) -> Doubles:
    """Return trees in rows along `turn_rad`, `spacing_m` apart, displaced at random by about `scatter_m`."""
    along, across = rotate_axes(turn_rad)
    reach_m = np.arange(-110, 110, spacing_m)
    u, v = (axis.reshape(-1, 1) for axis in np.meshgrid(reach_m, reach_m))
    points_m = outline_m.mean(axis=0) + u * along + v * across
    points_m = points_m + rng.normal(0, scatter_m, points_m.shape)
    outline = outline_m.astype(np.float32)
    inside = [cv2.pointPolygonTest(outline, (float(x), float(y)), True) > 2.5 for x, y in points_m]
    return _grow_trees(rng, points_m[np.array(inside, bool)], radius_m, (1.6, 2.6))


def _grow_trees(rng: np.random.Generator, points_m: Doubles, radius_m: float, aspects: tuple[float, float]) -> Doubles:
    radius = radius_m * rng.uniform(0.6, 1.35, len(points_m))
    return np.column_stack((points_m, radius, radius * rng.uniform(*aspects, len(points_m))))
