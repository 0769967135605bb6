"""Georeferenced pictures as grids of pixels: `GeoRaster`, a file that GDAL reads, and `TileFolder`, map tiles.

Other modules import rasterio (GDAL and PROJ) from here, where a clear error is raised if it is not installed.
"""

import logging
import math
import os
import warnings
from pathlib import Path

import cv2
import numpy as np

from edgevpr.core.arrays import Bools, Bytes, Image
from edgevpr.core.errors import ImageError, SourceError
from edgevpr.frames.images import resized

# Size of GDAL's cache in MB, read when it is first used. The default is a twentieth of the RAM.
os.environ.setdefault("GDAL_CACHEMAX", "64")

try:
    import rasterio as rasterio
    from rasterio._err import CPLE_BaseError as CPLE_BaseError
    from rasterio.crs import CRS as CRS
    from rasterio.enums import ColorInterp, Resampling
    from rasterio.errors import NotGeoreferencedWarning
    from rasterio.errors import RasterioError as RasterioError
    from rasterio.features import geometry_mask as geometry_mask
    from rasterio.warp import transform as transform
    from rasterio.windows import Window
except ModuleNotFoundError as error:
    raise SourceError(
        f"An orthophoto is read with rasterio, and {error.name} is not installed: pip install 'edgevpr[maps]'."
    ) from error

logging.getLogger("rasterio").setLevel(logging.CRITICAL)  # edgevpr reports each fault once, in its own words

_DTYPES = ("uint8", "uint16")
_COLOURS = (ColorInterp.blue, ColorInterp.green, ColorInterp.red)
# Values of 16 bits are scaled to 8 bits; these percentiles, of sample windows all over the file, become 0 and 255.
_PERCENTILES = (2, 98)
_WINDOWS, _WINDOW_PX = 12, 64
_ENDS = (".png", ".jpg", ".jpeg", ".webp")  # of tiles
_HALF_WORLD_M = math.pi * 6_378_137.0  # of Web Mercator

Pixel = tuple[int, int]  # column and row


class GeoRaster:
    """An open georeferenced picture file. `crs` is its coordinate system. `transform` converts column and row (whole
    numbers at the corners of pixels) to coordinates of `crs`. `width` and `height` are in pixels."""

    def __init__(self, path: Path) -> None:
        """Open a file. Raises SourceError for one that is no picture or has no georeference."""
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", NotGeoreferencedWarning)
                self._data = rasterio.open(path)
        except (RasterioError, OSError) as error:
            raise SourceError(
                f"{path} cannot be opened as an orthophoto: give a GeoTIFF, VRT or MBTiles file, or a folder of tiles "
                "(z/x/y.png or .jpg)."
            ) from error
        self._path = path
        self.crs, self.transform = self._data.crs, self._data.transform
        self.width, self.height = self._data.width, self._data.height
        try:
            self._bands = self._colour_bands()
            self._tone = self._find_tone() if self._data.dtypes[self._bands[0] - 1] == "uint16" else None
        except BaseException:
            self.close()
            raise

    def _colour_bands(self) -> list[int]:
        """Return the numbers (from 1) of the bands blue, green and red, or of the grey band. Raises SourceError."""
        kinds, dtypes = self._data.colorinterp, self._data.dtypes
        colours = [kinds.index(colour) + 1 for colour in _COLOURS if colour in kinds]
        others = [number for number, kind in enumerate(kinds, start=1) if kind != ColorInterp.alpha]
        if len(colours) < 3:
            colours = others[2::-1] if len(others) >= 3 else others[:1]
        fault = None
        if not self.crs or self.transform.is_identity:
            fault = "it has no geo-reference (coordinate system and position)"
        elif ColorInterp.palette in kinds:
            fault = "it holds numbers of a palette (`gdal_translate -expand rgb` makes colours of them)"
        elif not colours or any(dtypes[band - 1] not in _DTYPES for band in colours):
            fault = f"it holds {dtypes[0]} numbers, such as heights, and no picture of 8 or 16 bits"
        if fault:
            raise SourceError(f"{self._path} is no orthophoto: {fault}.")
        return colours

    def _find_tone(self) -> Bytes:
        """Make the lookup table, uint8 (65536,), by which `read` converts 16-bit values to 8 bits."""
        values = []
        for top in np.linspace(0, max(0, self.height - _WINDOW_PX), _WINDOWS).astype(int):
            for left in np.linspace(0, max(0, self.width - _WINDOW_PX), _WINDOWS).astype(int):
                window = Window(left, top, min(_WINDOW_PX, self.width), min(_WINDOW_PX, self.height))
                bands, valid = self._read(window, (window.height, window.width))
                values.append(bands[:, valid].ravel())
        seen = np.concatenate(values)
        low, high = np.percentile(seen, _PERCENTILES) if len(seen) else (0, 65535)
        return np.clip((np.arange(65536) - low) * (255 / max(high - low, 1)), 0, 255).round().astype(np.uint8)

    def read(self, low: Pixel, high: Pixel, shrink: int) -> tuple[Image, Bools]:
        """Read the window from (column, row) `low` to `high` (not included), reduced by the factor `shrink`: each pixel
        of the result is the mean of `shrink` x `shrink` pixels. The window's sides must be multiples of `shrink`.

        Returns the picture, uint8 (H, W, 3) BGR, and bool (H, W), True where there is data. Raises ImageError for a
        damaged window.
        """
        width, height = high[0] - low[0], high[1] - low[1]
        shape = height // shrink, width // shrink
        bands, valid = self._read(Window(*low, width, height), shape)
        if self._tone is not None:
            bands = self._tone[bands]
        return np.ascontiguousarray(np.broadcast_to(bands.transpose(1, 2, 0), (*shape, 3))), valid

    def _read(self, window: Window, shape: tuple[int, int]) -> tuple[Image, Bools]:
        try:
            bands = self._data.read(
                self._bands, window=window, out_shape=(len(self._bands), *shape), resampling=Resampling.average
            )
            return bands, self._data.dataset_mask(window=window, out_shape=shape) > 127
        except RasterioError as error:
            raise ImageError(
                f"{self._path}: the part from column {window.col_off} and row {window.row_off} on cannot be read "
                f"({error}): copy the file again."
            ) from error

    def close(self) -> None:
        """Close the file."""
        self._data.close()


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
