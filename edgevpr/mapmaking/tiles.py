"""A folder of map tiles, z/x/y.png or .jpg in Web Mercator, as ground stations and web maps keep them."""

import math
from pathlib import Path

import numpy as np

from edgevpr.core.errors import SourceError
from edgevpr.frames.opencv import cv2
from edgevpr.mapmaking.gdal import CRS, rasterio

_ENDS = (".png", ".jpg", ".jpeg", ".webp")
_HALF_WORLD_M = math.pi * 6_378_137.0  # of Web Mercator


class TileFolder:
    """The tiles of the highest zoom of a folder; fields as of `georaster.GeoRaster`."""

    def __init__(self, folder: Path) -> None:
        """List the tiles. Raises SourceError for a folder that holds none."""
        zooms = [path for path in folder.iterdir() if path.name.isdecimal() and path.is_dir()]
        self._tiles: dict[tuple[int, int], Path] = {}
        for path in max(zooms, key=lambda path: int(path.name)).glob("*/*") if zooms else ():
            if path.suffix.lower() in _ENDS and path.stem.isdecimal() and path.parent.name.isdecimal():
                self._tiles[int(path.parent.name), int(path.stem)] = path
        if not self._tiles:
            raise SourceError(
                f"{folder} holds no map tiles (z/x/y.png or .jpg, the highest zoom counts): give the folder above the "
                "zooms, or a file."
            )
        decoded = (cv2.imread(str(path), cv2.IMREAD_UNCHANGED) for path in self._tiles.values())
        first = next((tile for tile in decoded if tile is not None), None)
        if first is None or first.shape[0] != first.shape[1] or first.shape[0] & first.shape[0] - 1:
            raise SourceError(
                f"{folder} holds pictures that are no tiles of a map, which are square, of 256 or 512 pixels: copy the "
                "tiles again."
            )
        zoom, self._side_px = max(int(path.name) for path in zooms), len(first)
        columns, rows = zip(*self._tiles, strict=True)
        self._left, self._top = min(columns), min(rows)
        self.width = (max(columns) + 1 - self._left) * self._side_px
        self.height = (max(rows) + 1 - self._top) * self._side_px
        self.crs = CRS.from_epsg(3857)
        tile_m = 2 * _HALF_WORLD_M / 2**zoom
        west_m, north_m = self._left * tile_m - _HALF_WORLD_M, _HALF_WORLD_M - self._top * tile_m
        pixel_m = tile_m / self._side_px
        self.transform = rasterio.Affine(pixel_m, 0, west_m, 0, -pixel_m, north_m)

    def read(self, left: int, top: int, right: int, bottom: int, shrink: int) -> tuple[np.ndarray, np.ndarray]:
        """Read a window as `GeoRaster.read` does. A tile that is missing or damaged is a hole without data."""
        side = self._side_px
        bgra = np.zeros(((bottom - top) // shrink, (right - left) // shrink, 4), np.uint8)
        for row in range(top // side, -(-bottom // side)):
            for column in range(left // side, -(-right // side)):
                tile = self._tile(column, row, side // shrink)
                if tile is not None:
                    at_row, at_column = (row * side - top) // shrink, (column * side - left) // shrink
                    inside = bgra[max(at_row, 0) : at_row + len(tile), max(at_column, 0) : at_column + len(tile)]
                    part = tile[max(-at_row, 0) :, max(-at_column, 0) :]
                    inside[:] = part[: inside.shape[0], : inside.shape[1]]
        return bgra[..., :3], bgra[..., 3] > 127

    def _tile(self, column: int, row: int, side_px: int) -> np.ndarray | None:
        """Read a tile, uint8 (side_px, side_px, 4) BGR and alpha; None where there is none."""
        path = self._tiles.get((self._left + column, self._top + row))
        picture = cv2.imread(str(path), cv2.IMREAD_UNCHANGED) if path else None
        if picture is None or picture.dtype != np.uint8:
            return None
        if picture.ndim == 2:
            picture = cv2.cvtColor(picture, cv2.COLOR_GRAY2BGRA)
        elif picture.shape[2] == 3:
            picture = cv2.cvtColor(picture, cv2.COLOR_BGR2BGRA)
        return cv2.resize(picture, (side_px, side_px), interpolation=cv2.INTER_AREA)

    def close(self) -> None:
        """Do nothing: no file is held open between tiles."""
