"""Map tiles: squares of the Web Mercator projection, each with a zoom and the numbers x and y.

A `TileStore` gives them as files (see `tilestores`), and `TileRaster` joins those of one zoom to one picture."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from edgevpr.core.arrays import Bools, Image, Ints, LatLon
from edgevpr.core.errors import SourceError, UsageError
from edgevpr.core.geodesy import EARTH_RADIUS_M, compute_extent
from edgevpr.frames.images import resized
from edgevpr.mapmaking.georaster import CRS, HALF_WORLD_M, Pixel, rasterio

TILE_PX = 256  # the usual side
_ACROSS_PX = 640  # of a footprint, in tiles as fine as a technique can use
_COARSER = 2  # zooms below that which still do
_NEARLY_ALL = 0.9  # of the ground that is covered best: a finer zoom, in which holes were never looked at, has less
_SPREAD = (0.5, 0.1, 0.3, 0.7, 0.9)
_KEPT = 64  # decoded tiles: neighbouring places share most
_FINEST, _MOST_LAT_DEG = 24, 85.0

Box = tuple[float, float, float, float]  # left, top, right and bottom, as shares of the world


@dataclass(frozen=True, slots=True)
class Ground:
    """Ground to cut pictures from. `extent_deg`: south, west, north, east, with a margin; east is above 180 if it
    crosses the antimeridian. `footprint_m`: ground along a side of a picture."""

    extent_deg: tuple[float, float, float, float]
    footprint_m: float

    @property
    def zoom(self) -> int:
        """The zoom at which tiles of 256 pixels are as fine as a technique can use."""
        south, _, north, _ = self.extent_deg
        world_px = 2 * HALF_WORLD_M * math.cos(math.radians((south + north) / 2)) / self.footprint_m * _ACROSS_PX
        return min(max(math.ceil(math.log2(world_px / TILE_PX)), 0), _FINEST)


@dataclass(frozen=True, slots=True, kw_only=True)
class Level:
    """The tiles of one zoom: their number, the least x and y, the greatest plus 1, and x and y of some that are most
    likely there. x counts on beyond the antimeridian."""

    count: int
    left: int
    top: int
    right: int
    bottom: int
    some: Sequence[Pixel]


class TileStore:
    """Tiles of several zooms. `name` names the store in messages, and `short_name` the pictures cut from it."""

    name: str
    short_name: str

    def levels(self, ground: Ground | None) -> dict[int, Level]:
        """Return the tiles that touch `ground` (None: all), by zoom."""
        raise NotImplementedError

    def get(self, zoom: int, x: int, y: int) -> bytes | None:
        """Return a tile, as a PNG, JPEG or WebP file; None: there is none."""
        raise NotImplementedError

    def close(self) -> None:
        """Close the file, if one is held open."""


def ground_of(points: Sequence[LatLon], footprint_m: float) -> Ground:
    """Return the ground around `points` (lat, lon), with a margin that suits a path and the pictures along it."""
    footprint_m = min(max(1.0, footprint_m), HALF_WORLD_M)  # what is wrong with another, `make_lattice` says
    south, west, north, east = compute_extent(points)
    north_deg = math.degrees(2 * footprint_m / EARTH_RADIUS_M)
    east_deg = north_deg / math.cos(math.radians(min(max(abs(south), abs(north)), _MOST_LAT_DEG)))
    return Ground((south - north_deg, west - east_deg, north + north_deg, east + east_deg), footprint_m)


def bounding_box(ground: Ground | None) -> Box:
    """Return the box of `ground` in the projection of tiles; None: the world."""
    if ground is None:
        return 0.0, 0.0, 1.0, 1.0
    south, west, north, east = ground.extent_deg
    top, bottom = (
        0.5 - math.asinh(math.tan(math.radians(min(max(lat_deg, -_MOST_LAT_DEG), _MOST_LAT_DEG)))) / (2 * math.pi)
        for lat_deg in (north, south)
    )
    return west / 360 + 0.5, top, east / 360 + 0.5, bottom


def full_level(zoom: int, box: Box) -> Level:
    """Return the level of a zoom that has all tiles that touch `box`; `some` are spread over it, from the middle."""
    across = 1 << zoom
    left, top = math.floor(box[0] * across), math.floor(box[1] * across)
    right, bottom = max(math.ceil(box[2] * across), left + 1), max(math.ceil(box[3] * across), top + 1)
    some = [(int(left + u * (right - left)), int(top + v * (bottom - top))) for u in _SPREAD for v in _SPREAD]
    count = (right - left) * (bottom - top)
    return Level(count=count, left=left, top=top, right=right, bottom=bottom, some=some)


def list_zoom_levels(tiles: Ints, box: Box) -> dict[int, Level]:
    """Return the levels of those of `tiles` (N, 3), each (zoom, x, y), that touch `box`."""
    zooms, x, y = tiles.T
    across = 1 << zooms
    x = x + across * (x + 1 <= box[0] * across)  # west of the box: it may be in it a turn around the Earth further on
    inside = (x + 1 > box[0] * across) & (x < box[2] * across) & (y + 1 > box[1] * across) & (y < box[3] * across)
    levels = {}
    for zoom in np.unique(zooms[inside]).tolist():
        at = np.column_stack((x, y))[inside & (zooms == zoom)]
        (left, top), (right, bottom) = at.min(axis=0).tolist(), (at.max(axis=0) + 1).tolist()
        some = [(int(column), int(row)) for column, row in at]
        levels[zoom] = Level(count=len(at), left=left, top=top, right=right, bottom=bottom, some=some)
    return levels


class TileRaster:
    """The tiles of one zoom as one picture: of the `ground` that is wanted (None: all) that which covers it well and is
    fine, else the highest. The fields are those of `GeoRaster`; `tile_px` is the side of a tile."""

    def __init__(self, store: TileStore, ground: Ground | None) -> None:
        """Choose the zoom. Raises SourceError if there is no tile, and UsageError for tiles all around the Earth."""
        self.store, self.name, self.short_name = store, store.name, store.short_name
        levels = store.levels(ground)
        self.zoom = _best(levels, ground) if levels else 0
        self._tile = lru_cache(_KEPT)(self._decoded)
        some = levels[self.zoom].some if levels else ()
        first = next((tile for at in some if (tile := self._tile(*at)) is not None), None)
        if first is None or first.shape[0] != first.shape[1] or first.shape[0] & first.shape[0] - 1:
            self.close()
            raise SourceError(
                f"{store.name} holds no map tiles{' of the area' if ground else ''} (PNG, JPEG or WebP, square, of 256 "
                "or 512 pixels): give another, or of a folder the one above the zooms (z/x/y.png)."
            )
        level, side_px = levels[self.zoom], len(first)
        if ground is None and level.right - level.left > max(2**self.zoom / 2, 2):
            self.close()
            raise UsageError(f"{store.name} has tiles on both sides of the Earth: give --area.")
        self.tile_px, self._left, self._top = side_px, level.left, level.top
        self.width, self.height = (level.right - level.left) * side_px, (level.bottom - level.top) * side_px
        self.crs = CRS.from_epsg(3857)
        tile_m = 2 * HALF_WORLD_M / 2**self.zoom
        west_m, north_m = level.left * tile_m - HALF_WORLD_M, HALF_WORLD_M - level.top * tile_m
        self.transform = rasterio.Affine(tile_m / side_px, 0, west_m, 0, -tile_m / side_px, north_m)

    def _decoded(self, x: int, y: int) -> Image | None:
        """Return a tile, uint8 (H, W, 4) BGR and alpha; None if there is none, or it is damaged."""
        data = self.store.get(self.zoom, x % 2**self.zoom, y)
        tile = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED) if data else None
        if tile is None or tile.dtype != np.uint8:
            return None
        if tile.ndim == 2:
            tile = cv2.cvtColor(tile, cv2.COLOR_GRAY2BGRA)
        elif tile.shape[2] == 3:
            tile = cv2.cvtColor(tile, cv2.COLOR_BGR2BGRA)
        return np.asarray(tile, np.uint8)

    def read(self, low: Pixel, high: Pixel, shrink: int) -> tuple[Image, Bools]:
        """Read a window as `GeoRaster.read` does. There is no data where a tile is missing or damaged."""
        (left, top), (right, bottom) = low, high
        side = self.tile_px
        bgra = np.zeros(((bottom - top) // shrink, (right - left) // shrink, 4), np.uint8)
        for row in range(top // side, -(-bottom // side)):
            for column in range(left // side, -(-right // side)):
                tile = self._tile(*self.tile_at(column, row))
                if tile is not None:
                    tile = resized(tile, (side // shrink, side // shrink))
                    at_row, at_column = (row * side - top) // shrink, (column * side - left) // shrink
                    inside = bgra[max(at_row, 0) : at_row + len(tile), max(at_column, 0) : at_column + len(tile)]
                    part = tile[max(-at_row, 0) :, max(-at_column, 0) :]
                    inside[:] = part[: inside.shape[0], : inside.shape[1]]
        return bgra[..., :3], bgra[..., 3] > 127

    def tile_at(self, column: int, row: int) -> Pixel:
        """Return x and y of a tile that is counted from the north-west one."""
        return self._left + column, self._top + row

    def close(self) -> None:
        """Close the store."""
        self.store.close()


def _best(levels: dict[int, Level], ground: Ground | None) -> int:
    if ground is None:
        return max(levels)
    covered = {zoom: level.count / 4**zoom for zoom, level in levels.items() if zoom >= ground.zoom - _COARSER}
    most = max(covered.values(), default=0)
    return max((zoom for zoom, share in covered.items() if share >= _NEARLY_ALL * most), default=max(levels))
