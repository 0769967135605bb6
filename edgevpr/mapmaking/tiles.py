"""Map tiles: squares of the Web Mercator projection, each with a zoom and the numbers x and y."""

import math
from pathlib import Path

import cv2
import numpy as np

from edgevpr.core.arrays import Bools, Image
from edgevpr.core.errors import SourceError
from edgevpr.frames.images import resized
from edgevpr.mapmaking.georaster import CRS, Pixel, rasterio

_ENDS = (".png", ".jpg", ".jpeg", ".webp")  # of tiles
_HALF_WORLD_M = math.pi * 6_378_137.0  # of Web Mercator


class TileFolder:
    """Map tiles of a folder (zoom/x/y.png, Web Mercator), of its highest zoom. The fields are those of `GeoRaster`."""

    def __init__(self, folder: Path) -> None:
        """List the tiles. Raises SourceError for a folder that holds none."""
        zoom = max((int(path.name) for path in folder.iterdir() if path.name.isdecimal() and path.is_dir()), default=0)
        self._tiles = {
            (int(path.parent.name), int(path.stem)): path
            for path in folder.glob(f"{zoom}/*/*")
            if path.suffix.lower() in _ENDS and path.stem.isdecimal() and path.parent.name.isdecimal()
        }
        first = next((tile for path in self._tiles.values() if (tile := _decoded(path)) is not None), None)
        if first is None or first.shape[0] != first.shape[1] or first.shape[0] & first.shape[0] - 1:
            raise SourceError(
                f"{folder} holds no map tiles (z/x/y.png or .jpg, square, of 256 or 512 pixels; the highest zoom "
                "counts): give the folder above the zooms, or a file."
            )
        columns, rows = zip(*self._tiles, strict=True)
        self._side_px, self._left, self._top = len(first), min(columns), min(rows)
        self.width = (max(columns) + 1 - self._left) * self._side_px
        self.height = (max(rows) + 1 - self._top) * self._side_px
        self.crs = CRS.from_epsg(3857)
        tile_m = 2 * _HALF_WORLD_M / 2**zoom
        west_m, north_m = self._left * tile_m - _HALF_WORLD_M, _HALF_WORLD_M - self._top * tile_m
        pixel_m = tile_m / self._side_px
        self.transform = rasterio.Affine(pixel_m, 0, west_m, 0, -pixel_m, north_m)

    def read(self, low: Pixel, high: Pixel, shrink: int) -> tuple[Image, Bools]:
        """Read a window as `GeoRaster.read` does. There is no data where a tile is missing or damaged."""
        (left, top), (right, bottom) = low, high
        side = self._side_px
        bgra = np.zeros(((bottom - top) // shrink, (right - left) // shrink, 4), np.uint8)
        for row in range(top // side, -(-bottom // side)):
            for column in range(left // side, -(-right // side)):
                path = self._tiles.get((self._left + column, self._top + row))
                tile = _decoded(path) if path else None
                if tile is not None:
                    tile = resized(tile, (side // shrink, side // shrink))
                    at_row, at_column = (row * side - top) // shrink, (column * side - left) // shrink
                    inside = bgra[max(at_row, 0) : at_row + len(tile), max(at_column, 0) : at_column + len(tile)]
                    part = tile[max(-at_row, 0) :, max(-at_column, 0) :]
                    inside[:] = part[: inside.shape[0], : inside.shape[1]]
        return bgra[..., :3], bgra[..., 3] > 127

    def close(self) -> None:
        """Do nothing: no file is held open between tiles."""


def _decoded(path: Path) -> Image | None:
    """Read a tile, uint8 (H, W, 4) BGR and alpha; None if it is damaged."""
    tile = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if tile is None or tile.dtype != np.uint8:
        return None
    if tile.ndim == 2:
        tile = cv2.cvtColor(tile, cv2.COLOR_GRAY2BGRA)
    elif tile.shape[2] == 3:
        tile = cv2.cvtColor(tile, cv2.COLOR_BGR2BGRA)
    return np.asarray(tile, np.uint8)
