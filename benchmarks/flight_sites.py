"""Ground for flights.py: mosaics of real aerial pictures, maps of the pictures ref/, and room to fly over query/.

Both mosaics of a set are laid in one frame, its mosaic_positions.csv, so that map and flight share a position on the
Earth and no picture. Metres are east and north of the middle of a mosaic.
"""

import csv
from dataclasses import dataclass
from pathlib import Path

import base
import cv2
import numpy as np
import rasterio
from mosaics import Ground, ground_of, laid, make_mosaic, write_tif

from edgevpr.core.geodesy import move_position, offset_m, offset_position
from edgevpr.core.types import Position
from edgevpr.lab.simulate.camera import Camera, CameraPose, Light
from edgevpr.lab.simulate.overflight import photograph_ground
from edgevpr.mapmaking.orthophoto import Orthophoto

# Sets without positions, or too few of them: metres of a pixel and a place on the Earth are assumed.
_ASSUMED = {
    "kite_ochota": Ground("EPSG:32634", rasterio.Affine(0.3, 0, 498_000, 0, -0.3, 5_784_000)),
    "aerial_copr": Ground("EPSG:32630", rasterio.Affine(0.1, 0, 500_000, 0, -0.1, 6_400_000)),
}
_WIDE_PX = 640  # every picture of the sets, on the canvas at scale 1
_GRID_PX = 480
# A picture turned anyhow has ground where of a square, so wide as a share of its longest side, so much has ground.
_OF_SIDE, _HAS_GROUND = 0.95, 0.93
_SIDES, _LEAST_SIDE = np.linspace(0.5, 1.5, 11), 0.8  # footprints: those tried, and that of a point to fly over
_NEAR_ROOM = 0.35  # footprints: farther from any ground to fly over, a place is no part of the way
ROWS, _ROWS_OF, _COPIES = "rows", "aerial_copr", 4
_ROWS_WIDE_M, _ROWS_FOOTPRINT_M = 60.0, 48.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Grid:
    """Values (G, G) of the ground around the origin of a site, north up, `metres_per_px` apart."""

    values: np.ndarray
    metres_per_px: float

    def at(self, points_m: np.ndarray) -> np.ndarray:
        """Return the values at points (N, 2)."""
        column, row = (points_m * (1, -1) / self.metres_per_px + len(self.values) / 2).astype(int).T
        last = len(self.values) - 1
        return self.values[row.clip(0, last), column.clip(0, last)]

    def points(self) -> np.ndarray:
        """Return where the values are true, (N, 2) in metres."""
        row, column = np.nonzero(self.values)
        half = len(self.values) / 2
        return np.column_stack([column + 0.5 - half, half - row - 0.5]) * self.metres_per_px


@dataclass(frozen=True, slots=True, kw_only=True)
class Site:
    """A map and the ground that is flown over. `origin` is (lat_deg, lon_deg). `way` (N, 2) is the mapped way, a point
    for each place in their order, as far as there is ground to fly over, and `footprints_m` (N,) the ground under
    pictures there. `widest_m`: the longest side of a picture that has ground there; `room`: where that is wide enough
    to fly over; `covered`: the share of a picture there that the map shows."""

    name: str
    place_map: Path
    flown: Path
    origin: tuple[float, float]
    footprint_m: float
    way: np.ndarray
    footprints_m: np.ndarray
    widest_m: Grid
    room: Grid
    covered: Grid

    def position(self, at_m: np.ndarray) -> Position:
        """Return the position of a point (2,)."""
        return Position(*offset_position(*self.origin, *at_m.tolist()))

    def offset(self, position: Position) -> np.ndarray:
        """Return the metres (2,) of a position."""
        return np.array(offset_m(*self.origin, position.lat_deg, position.lon_deg))

    def snapped(self, points_m: np.ndarray) -> np.ndarray:
        """Return the nearest points with room to points (N, 2)."""
        return _snapped(self.room, points_m)


def prepare(name: str, data: Path, work: Path) -> Site:
    """Write the mosaics of a site, and build and refine its map by the command that a user has."""
    folder = work / name
    folder.mkdir()
    if name == ROWS:
        return _rows(data / _ROWS_OF, folder)
    of = data / name
    on = laid(of)
    ground = _ASSUMED.get(name) or ground_of(of, on)
    for part in ("ref", "query"):
        write_tif(folder / f"{part}.tif", ground, *make_mosaic(of, on, part))
    places = [each for each in sorted(on.middle) if (of / "ref" / each).is_file()]
    positions = {each: ground.position(on.middle[each]) for each in places}
    metre_px = abs(ground.affine.determinant) ** 0.5
    footprints_m = np.array([on.scale[each] * metre_px * _WIDE_PX for each in places])
    return _site(name, folder, of / "ref", positions, footprints_m)


def _rows(of: Path, folder: Path) -> Site:
    """Make ground on which one piece repeats itself four times, beside its mirror image, which is alone; and map it by
    a flight over what the pictures ref/ show."""
    on = laid(of)
    mosaics = {part: make_mosaic(of, on, part) for part in ("ref", "query")}
    top, left, high, wide = _largest_box(mosaics["ref"][1] & mosaics["query"][1])
    metre_px = _ROWS_WIDE_M / wide
    ground = Ground("EPSG:32630", rasterio.Affine(metre_px, 0, 520_000, 0, -metre_px, 6_400_000))
    for part, (canvas, _) in mosaics.items():
        piece = canvas[top : top + high, left : left + wide]
        canvas = np.hstack([piece[:, ::-1], *[piece] * _COPIES])
        write_tif(folder / f"{part}.tif", ground, canvas, np.ones(canvas.shape[:2], bool))
    photo, rng = Orthophoto(folder / "ref.tif"), np.random.default_rng(5)
    (folder / "images").mkdir()
    positions, step_m = {}, _ROWS_FOOTPRINT_M / 4
    half_m = np.array([_ROWS_WIDE_M * (_COPIES + 1), high * metre_px]) / 2 - _ROWS_FOOTPRINT_M / 2
    camera, light = Camera(), Light(sun_azimuth_deg=0, sun_elevation_deg=90)
    lanes = np.linspace(-half_m[1], half_m[1], 1 + round(2 * half_m[1] / (1.5 * step_m)))
    for lane, north_m in enumerate(lanes):
        east_m = np.arange(-half_m[0], half_m[0], step_m)
        for east in east_m if lane % 2 == 0 else east_m[::-1]:
            at = move_position(photo.middle, float(east), float(north_m))
            up_deg = 90.0 if lane % 2 == 0 else 270.0
            pose = CameraPose(east_m=0, north_m=0, height_m=_height_m(_ROWS_FOOTPRINT_M), heading_deg=up_deg)
            image = photograph_ground(photo, at, pose, camera, light, rng)
            if image is not None:
                file = f"{len(positions):04d}.jpg"
                cv2.imwrite(str(folder / "images" / file), image)
                positions[file] = at.lat_deg, at.lon_deg
    photo.close()
    return _site(ROWS, folder, folder / "images", positions, np.full(len(positions), _ROWS_FOOTPRINT_M))


def _site(name: str, folder: Path, images: Path, positions: dict, footprints_m: np.ndarray) -> Site:
    place_map, table = folder / "map.gpkg", folder / "positions.csv"
    with open(table, "w", newline="") as handle:
        csv.writer(handle).writerows([("file", "lat", "lon"), *((each, *at) for each, at in positions.items())])
    flags = ("--images", str(images), "--positions", str(table), "--technique", "cohog", "--camera", "nadir")
    base.edgevpr("map", "build", place_map, *flags)
    photos = {part: Orthophoto(folder / f"{part}.tif") for part in ("ref", "query")}
    middle = photos["ref"].middle
    origin, footprint_m = (middle.lat_deg, middle.lon_deg), float(np.median(footprints_m))
    south, west, north, east = photos["ref"].extent_deg
    wide_m = 2 * max(np.abs(offset_m(*origin, *corner)).max() for corner in ((south, west), (north, east)))
    valid = {part: photo.cut(middle, wide_m, _GRID_PX)[1] for part, photo in photos.items()}
    for photo in photos.values():
        photo.close()
    metre_px = wide_m / _GRID_PX
    widest_m = np.zeros((_GRID_PX, _GRID_PX))
    for side_m in _SIDES * footprint_m:
        widest_m[_share(valid["query"], _OF_SIDE * side_m / metre_px) >= _HAS_GROUND] = side_m
    room = Grid(values=widest_m >= _LEAST_SIDE * footprint_m, metres_per_px=metre_px)
    way, at = _way(np.array([offset_m(*origin, *each) for each in positions.values()]), room, footprint_m)
    return Site(
        name=name,
        place_map=place_map,
        flown=folder / "query.tif",
        origin=origin,
        footprint_m=footprint_m,
        way=way,
        footprints_m=footprints_m[at],
        widest_m=Grid(values=widest_m, metres_per_px=metre_px),
        room=room,
        covered=Grid(values=_share(valid["ref"], _OF_SIDE * footprint_m / metre_px), metres_per_px=metre_px),
    )


def _share(valid: np.ndarray, side_px: float) -> np.ndarray:
    """Return what share of a square around each point is True."""
    side = max(1, round(side_px))
    return cv2.blur(valid.astype(np.float32), (side, side), borderType=cv2.BORDER_CONSTANT)


def _way(places_m: np.ndarray, room: Grid, footprint_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the mapped way over ground that can be flown over, and the places on it (slices of them). A place without
    such ground near it is passed on the straight line between those before and after."""
    near = _snapped(room, places_m)
    kept = np.flatnonzero(np.hypot(*(near - places_m).T) < _NEAR_ROOM * footprint_m)
    at = np.arange(kept[0], kept[-1] + 1)
    line = np.column_stack([np.interp(at, kept, near[kept, axis]) for axis in (0, 1)])
    return _snapped(room, line), at


def _snapped(room: Grid, points_m: np.ndarray) -> np.ndarray:
    free = room.points()
    return np.array([free[np.argmin(((free - each) ** 2).sum(axis=1))] for each in points_m])


def _largest_box(covered: np.ndarray, step: int = 20) -> tuple[int, int, int, int]:
    """Return top, left, height and width of the largest box that is covered all over, in steps of some pixels."""
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


def _height_m(footprint_m: float) -> float:
    return footprint_m * Camera().focal_px / Camera().width
