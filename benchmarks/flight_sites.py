"""Sites for flights.py: a map of the pictures ref/ of a set, and the mosaic of its pictures query/ to fly over.

Both mosaics of a set have the frame of its mosaic_positions.csv, so that map and flight share positions on the Earth
and no picture. Metres are east and north of the middle of a mosaic.
"""

from dataclasses import dataclass
from pathlib import Path

import base
import cv2
import numpy as np
import rasterio
from mosaics import Ground, fit_ground, make_mosaic, read_layout, write_tif

from edgevpr.core.geodesy import move_position, offset_between_m
from edgevpr.core.types import Position
from edgevpr.frames.positions import GeoTag, write_positions
from edgevpr.lab.simulate.camera import Camera, CameraPose, Light
from edgevpr.lab.simulate.overflight import photograph_ground
from edgevpr.mapmaking.orthophoto import Orthophoto

# Sets with too few positions: their pixel size and their position on the Earth are assumed.
_ASSUMED_GROUNDS = {
    "kite_ochota": Ground("EPSG:32634", rasterio.Affine(0.3, 0, 498_000, 0, -0.3, 5_784_000)),
    "aerial_copr": Ground("EPSG:32630", rasterio.Affine(0.1, 0, 500_000, 0, -0.1, 6_400_000)),
}
_IMAGE_WIDTH_PX = 640  # of every picture of the sets, in a mosaic at scale 1
_GRID_PX = 480
# A picture of any heading is covered if a square of this share of its longest side has this share of ground.
_SQUARE_SIDE_SHARE = 0.95
_MIN_GROUND_SHARE = 0.93
_FOOTPRINT_FACTORS = np.linspace(0.5, 1.5, 11)  # sizes of a picture to try, of the site's footprint
_MIN_FOOTPRINT_FACTOR = 0.8  # of the smallest picture that a flyable point must allow
_MAX_FLYABLE_DISTANCE = 0.35  # footprints: a place farther from flyable ground is passed by (see `_find_route`)
ROWS_SITE = "rows"
_ROWS_SET = "aerial_copr"
_ROWS_COPIES = 4
_ROWS_WIDTH_M = 60.0  # of one copy
_ROWS_FOOTPRINT_M = 48.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Grid:
    """Values (G, G) on a grid around the origin of a site, north up, `metres_per_px` apart."""

    values: np.ndarray
    metres_per_px: float

    def sample(self, points_m: np.ndarray) -> np.ndarray:
        """Return the values at points (N, 2)."""
        column, row = (points_m * (1, -1) / self.metres_per_px + len(self.values) / 2).astype(int).T
        last = len(self.values) - 1
        return self.values[row.clip(0, last), column.clip(0, last)]

    def list_points_m(self) -> np.ndarray:
        """Return the points, (N, 2) in metres, at which the values are true."""
        row, column = np.nonzero(self.values)
        half = len(self.values) / 2
        return np.column_stack([column + 0.5 - half, half - row - 0.5]) * self.metres_per_px

    def snap(self, points_m: np.ndarray) -> np.ndarray:
        """Return for each of the points (N, 2) the nearest one at which the values are true."""
        candidates_m = self.list_points_m()
        return np.array([candidates_m[np.argmin(((candidates_m - point_m) ** 2).sum(axis=1))] for point_m in points_m])


@dataclass(frozen=True, slots=True, kw_only=True)
class Site:
    """A map, and the mosaic `query_mosaic` to fly over, with its middle (`origin`). `route_m` (N, 2): the places of
    the mapped route, over flyable ground; `footprints_m` (N,): the longest sides of their pictures on the ground. Grids
    by the centre of a picture: `max_footprint_m`: its largest footprint with ground in the mosaic; `flyable`: whether
    that is large enough; `covered`: the share of a picture there that the map shows."""

    name: str
    place_map: Path
    query_mosaic: Path
    origin: Position
    footprint_m: float
    route_m: np.ndarray
    footprints_m: np.ndarray
    max_footprint_m: Grid
    flyable: Grid
    covered: Grid


def prepare_site(name: str, data: Path, work: Path) -> Site:
    """Write the mosaics of a site, and build its map by `edgevpr map build`, which also refines it."""
    folder = work / name
    folder.mkdir()
    if name == ROWS_SITE:
        return _prepare_rows_site(data / _ROWS_SET, folder)
    set_folder = data / name
    layout = read_layout(set_folder)
    ground = _ASSUMED_GROUNDS.get(name) or fit_ground(set_folder, layout)
    for part in ("ref", "query"):
        write_tif(folder / f"{part}.tif", ground, *make_mosaic(set_folder, layout, part))
    places = [place for place in sorted(layout.middle) if (set_folder / "ref" / place).is_file()]
    positions = {place: ground.to_position(layout.middle[place]) for place in places}
    metre_px = abs(ground.affine.determinant) ** 0.5
    footprints_m = np.array([layout.scale[place] * metre_px * _IMAGE_WIDTH_PX for place in places])
    return _build_site(name, folder, set_folder / "ref", positions, footprints_m)


def _prepare_rows_site(set_folder: Path, folder: Path) -> Site:
    """Make ground that consists of the mirror image of one piece and of four copies of the piece, and map it by a
    simulated flight over the pictures ref/."""
    layout = read_layout(set_folder)
    mosaics = {part: make_mosaic(set_folder, layout, part) for part in ("ref", "query")}
    top, left, height, width = _find_largest_box(mosaics["ref"][1] & mosaics["query"][1])
    metre_px = _ROWS_WIDTH_M / width
    ground = Ground("EPSG:32630", rasterio.Affine(metre_px, 0, 520_000, 0, -metre_px, 6_400_000))
    for part, (canvas, _) in mosaics.items():
        piece = canvas[top : top + height, left : left + width]
        canvas = np.hstack([piece[:, ::-1], *[piece] * _ROWS_COPIES])
        write_tif(folder / f"{part}.tif", ground, canvas, np.ones(canvas.shape[:2], bool))
    photo, rng = Orthophoto(folder / "ref.tif"), np.random.default_rng(5)
    (folder / "images").mkdir()
    positions, step_m = {}, _ROWS_FOOTPRINT_M / 4
    half_m = np.array([_ROWS_WIDTH_M * (_ROWS_COPIES + 1), height * metre_px]) / 2 - _ROWS_FOOTPRINT_M / 2
    camera, light = Camera(), Light(sun_azimuth_deg=0, sun_elevation_deg=90)
    height_m = _ROWS_FOOTPRINT_M * camera.focal_px / camera.width
    lanes = np.linspace(-half_m[1], half_m[1], 1 + round(2 * half_m[1] / (1.5 * step_m)))
    for lane, north_m in enumerate(lanes):
        east_m = np.arange(-half_m[0], half_m[0], step_m)
        for east in east_m if lane % 2 == 0 else east_m[::-1]:
            position = move_position(photo.middle, float(east), float(north_m))
            heading_deg = 90.0 if lane % 2 == 0 else 270.0
            pose = CameraPose(east_m=0, north_m=0, height_m=height_m, heading_deg=heading_deg)
            image = photograph_ground(photo, position, pose, camera, light, rng)
            if image is not None:
                file = f"{len(positions):04d}.jpg"
                cv2.imwrite(str(folder / "images" / file), image)
                positions[file] = position
    photo.close()
    return _build_site(ROWS_SITE, folder, folder / "images", positions, np.full(len(positions), _ROWS_FOOTPRINT_M))


def _build_site(name: str, folder: Path, images: Path, positions: dict, footprints_m: np.ndarray) -> Site:
    """Build the map of images at `positions`, and find the ground that can be flown over."""
    place_map, table = folder / "map.gpkg", folder / "positions.csv"
    write_positions(table, {file: GeoTag(position=position) for file, position in positions.items()})
    flags = ("--images", str(images), "--positions", str(table), "--technique", "cohog", "--camera", "nadir")
    base.run_edgevpr("map", "build", place_map, *flags)
    photos = {part: Orthophoto(folder / f"{part}.tif") for part in ("ref", "query")}
    origin, footprint_m = photos["ref"].middle, float(np.median(footprints_m))
    south, west, north, east = photos["ref"].extent_deg
    corners = Position(south, west), Position(north, east)
    side_m = 2 * max(np.abs(offset_between_m(origin, corner)).max() for corner in corners)
    valid = {part: photo.cut(origin, side_m, _GRID_PX)[1] for part, photo in photos.items()}
    for photo in photos.values():
        photo.close()
    metre_px = side_m / _GRID_PX
    max_footprint_m = np.zeros((_GRID_PX, _GRID_PX))
    for picture_m in _FOOTPRINT_FACTORS * footprint_m:
        max_footprint_m[_measure_share(valid["query"], picture_m / metre_px) >= _MIN_GROUND_SHARE] = picture_m
    flyable = Grid(values=max_footprint_m >= _MIN_FOOTPRINT_FACTOR * footprint_m, metres_per_px=metre_px)
    places_m = np.array([offset_between_m(origin, position) for position in positions.values()])
    route_m, numbers = _find_route(places_m, flyable, footprint_m)
    return Site(
        name=name,
        place_map=place_map,
        query_mosaic=folder / "query.tif",
        origin=origin,
        footprint_m=footprint_m,
        route_m=route_m,
        footprints_m=footprints_m[numbers],
        max_footprint_m=Grid(values=max_footprint_m, metres_per_px=metre_px),
        flyable=flyable,
        covered=Grid(values=_measure_share(valid["ref"], footprint_m / metre_px), metres_per_px=metre_px),
    )


def _measure_share(valid: np.ndarray, side_px: float) -> np.ndarray:
    """Return the share of valid ground in the square of a picture of `side_px`, centred on each point."""
    side = max(1, round(_SQUARE_SIDE_SHARE * side_px))
    return cv2.blur(valid.astype(np.float32), (side, side), borderType=cv2.BORDER_CONSTANT)


def _find_route(places_m: np.ndarray, flyable: Grid, footprint_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the mapped route over flyable ground, (N, 2) in metres, and the consecutive numbers of its places. Places
    without such ground near them are replaced by points on the straight line between their neighbours."""
    nearest_m = flyable.snap(places_m)
    near = np.flatnonzero(np.hypot(*(nearest_m - places_m).T) < _MAX_FLYABLE_DISTANCE * footprint_m)
    numbers = np.arange(near[0], near[-1] + 1)
    line_m = np.column_stack([np.interp(numbers, near, nearest_m[near, axis]) for axis in (0, 1)])
    return flyable.snap(line_m), numbers


def _find_largest_box(covered: np.ndarray, step: int = 20) -> tuple[int, int, int, int]:
    """Return top, left, height and width of the largest box that is covered all over, in steps of `step` pixels."""
    rows, columns = (np.arange(0, length + 1, step) for length in covered.shape)
    total = cv2.integral(covered.astype(np.uint8))[np.ix_(rows, columns)]
    best = (0, 0, 0, 0)
    for high in range(1, len(rows)):
        for wide in range(1, len(columns)):
            if high * wide * step**2 <= best[2] * best[3]:
                continue
            inside = total[high:, wide:] - total[:-high, wide:] - total[high:, :-wide] + total[:-high, :-wide]
            full = np.argwhere(inside >= high * wide * step**2)
            if len(full):
                best = (*(full[0] * step).tolist(), high * step, wide * step)
    return best
