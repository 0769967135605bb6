"""An orthophoto, from which pictures of squares of ground are cut: sides in metres on the ground, true north at the
top. `cuttings` makes the frames of a map from them.

Other modules import rasterio (GDAL and PROJ) from here, where a clear error is raised if it is not installed.
"""

import logging
import math
import os
import warnings
from pathlib import Path
from typing import TypeVar

import cv2
import numpy as np

from edgevpr.core.arrays import Bools, Doubles, Image
from edgevpr.core.errors import ImageError, SourceError
from edgevpr.core.geodesy import shorter_deg
from edgevpr.core.types import Position
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
        f"An orthophoto is read with rasterio, and {error.name} is not installed: run `pip install rasterio scipy`."
    ) from error

logging.getLogger("rasterio").setLevel(logging.CRITICAL)  # edgevpr reports each fault once, in its own words

_COLOURS = (ColorInterp.blue, ColorInterp.green, ColorInterp.red)
_ENDS = (".png", ".jpg", ".jpeg", ".webp")  # of tiles
_HALF_WORLD_M = math.pi * 6_378_137.0  # of Web Mercator
WGS84 = CRS.from_epsg(4326)
_EDGE_POINTS = 25  # per edge: a straight edge of the file is a curve in another coordinate system
_MOST_HALVINGS = 8  # of the resolution: then a tile of 256 pixels is one pixel

Coordinate = TypeVar("Coordinate", float, Doubles)
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
        self._bands = self._colour_bands()

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
        elif not colours or any(dtypes[band - 1] != "uint8" for band in colours):
            fault = (
                f"it holds {dtypes[0]} numbers, such as heights, and no picture of 8 bits (of a picture of 16 bits, "
                "`gdal_translate -ot Byte -scale` makes one)"
            )
        if fault:
            self.close()
            raise SourceError(f"{self._path} is no orthophoto: {fault}.")
        return colours

    def read(self, low: Pixel, high: Pixel, shrink: int) -> tuple[Image, Bools]:
        """Read the window from (column, row) `low` to `high` (not included), reduced by the factor `shrink`: each pixel
        of the result is the mean of `shrink` x `shrink` pixels. The window's sides must be multiples of `shrink`.

        Returns the picture, uint8 (H, W, 3) BGR, and bool (H, W), True where there is data. Raises ImageError for a
        damaged window.
        """
        width, height = high[0] - low[0], high[1] - low[1]
        shape, window = (height // shrink, width // shrink), Window(*low, width, height)
        try:
            bands = self._data.read(
                self._bands, window=window, out_shape=(len(self._bands), *shape), resampling=Resampling.average
            )
            valid = self._data.dataset_mask(window=window, out_shape=shape) > 127
        except RasterioError as error:
            raise ImageError(
                f"{self._path}: the part from column {low[0]} and row {low[1]} on cannot be read ({error}): copy the "
                "file again."
            ) from error
        return np.ascontiguousarray(np.broadcast_to(bands.transpose(1, 2, 0), (*shape, 3))), valid

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


def local_crs(at: Position) -> CRS:
    """Return the coordinate system of the plane that touches the Earth at `at`: metres east and true north of that
    point. Distances and directions from that point are exact."""
    return CRS.from_proj4(f"+proj=aeqd +lat_0={at.lat_deg:.10f} +lon_0={at.lon_deg:.10f} +datum=WGS84 +units=m")


class Orthophoto:
    """An open orthophoto. `extent_deg` is its bounding box (south, west, north, east), `middle` its middle, and
    `resolution_m` the length in metres of a pixel on the ground in the middle."""

    def __init__(self, path: str | Path) -> None:
        """Open a GeoTIFF, VRT, MBTiles or other file that GDAL reads, or a folder of map tiles. Raises SourceError."""
        self.path = Path(path)
        if not self.path.exists():
            raise SourceError(f"There is no orthophoto {path}: check the name.")
        self._raster = TileFolder(self.path) if self.path.is_dir() else GeoRaster(self.path)
        try:
            columns, rows = np.array([[self._raster.width / 2], [self._raster.height / 2]])
            (lon_deg,), (lat_deg,) = self._through(columns, rows, WGS84)
            self.middle = Position(lat_deg, shorter_deg(lon_deg))
            lons_deg, lats_deg = self.outline(WGS84)
        except (CPLE_BaseError, RasterioError):
            lats_deg = lons_deg = np.array([np.nan])
        if not np.isfinite((lats_deg, lons_deg)).all():
            self.close()
            raise SourceError(
                f"{path}: its coordinate system ({self._raster.crs.to_string()[:60]}) cannot be brought to latitude "
                "and longitude: export it with another, such as UTM or EPSG:4326."
            )
        lons_deg = self.middle.lon_deg + (lons_deg - self.middle.lon_deg + 180) % 360 - 180
        self.extent_deg = (lats_deg.min(), lons_deg.min(), lats_deg.max(), lons_deg.max())
        metre_px = self._pixels(self.middle, np.array([[0, 0], [1, 0], [0, 1]]))
        self.resolution_m = float(1 / np.sqrt(abs(np.linalg.det(metre_px[1:] - metre_px[0]))))

    def outline(self, crs: CRS) -> tuple[Doubles, Doubles]:
        """Return points along the edges of the file, x and y in the coordinate system `crs`, float64 (N,) each."""
        along, zero = np.linspace(0, 1, _EDGE_POINTS), np.zeros(_EDGE_POINTS)
        columns = np.concatenate((along, along, zero, zero + 1)) * self._raster.width
        rows = np.concatenate((zero, zero + 1, along, along)) * self._raster.height
        return self._through(columns, rows, crs)

    def _through(self, columns: Doubles, rows: Doubles, crs: CRS) -> tuple[Doubles, Doubles]:
        """Convert the pixels at `columns` and `rows`, float (N,) each, to x and y in the coordinate system `crs`,
        float64 (N,) each."""
        x, y = transform(self._raster.crs, crs, *_moved(self._raster.transform, columns, rows))
        return np.array(x), np.array(y)

    def _pixels(self, at: Position, points_m: Doubles) -> Doubles:
        """Convert points (N, 2), in metres (east, north) of `at`, to pixels (column, row), float64 (N, 2). Whole
        numbers are the corners of pixels."""
        raster = self._raster
        x, y = (np.array(each) for each in transform(local_crs(at), raster.crs, *points_m.T))
        if raster.crs.is_geographic:  # a file may have longitudes from 0 to 360 degrees, or cross the date line
            middle, _ = _moved(raster.transform, raster.width / 2, raster.height / 2)
            x += 360 * np.round((middle - x) / 360)
        return np.column_stack(_moved(~raster.transform, x, y))

    def cut(self, at: Position, footprint_m: float, side_px: int) -> tuple[Image, Bools]:
        """Cut out the square of ground with its middle at `at`, true north up, and sides of `footprint_m`.

        Returns the picture, uint8 (side_px, side_px, 3) BGR, and bool (side_px, side_px), True where there is data.
        Pixels without data have the mean colour of the others. Raises ImageError for a damaged part of the file.
        """
        half_m = footprint_m / 2
        corners = self._pixels(at, half_m * np.array([[-1, 1], [1, 1], [1, -1], [-1, -1]]))
        if not np.isfinite(corners).all():
            return _nothing(side_px)
        across_px = np.hypot(*(corners[1] - corners[0]))
        shrink = 1 << min(int(np.log2(max(across_px / side_px, 1))), _MOST_HALVINGS)
        size = np.array([self._raster.width, self._raster.height])
        low = np.clip(corners.min(axis=0) - 2 * shrink, 0, size).astype(int) // shrink * shrink
        high = np.clip(corners.max(axis=0) + 3 * shrink, 0, size).astype(int) // shrink * shrink
        if (high <= low).any():
            return _nothing(side_px)
        ground, valid = self._raster.read(tuple(low.tolist()), tuple(high.tolist()), shrink)
        # Warped to twice the size and averaged, so that no pixel of the file is skipped.
        large_px = 2 * side_px
        drawn = np.array([[0, 0], [large_px, 0], [large_px, large_px], [0, large_px]])
        view = cv2.getPerspectiveTransform(
            ((corners - low) / shrink - 0.5).astype(np.float32), (drawn - 0.5).astype(np.float32)
        )
        large = (large_px, large_px)
        warped = cv2.warpPerspective(ground, view, large, borderMode=cv2.BORDER_REPLICATE)
        picture = resized(warped, (side_px, side_px))  # type: ignore[arg-type]  # uint8
        warped = cv2.warpPerspective(255 * valid.astype(np.uint8), view, large)
        # Only pixels that are wholly data: one at the edge is mixed with black, and would form a line around the data.
        seen = resized(warped, (side_px, side_px)) >= 250  # type: ignore[arg-type]  # uint8
        if seen.any():
            picture[~seen] = picture[seen].mean(axis=0)
        return picture, seen

    def close(self) -> None:
        """Close the file."""
        self._raster.close()


def _moved(way: rasterio.Affine, x: Coordinate, y: Coordinate) -> tuple[Coordinate, Coordinate]:
    """Apply the affine map `way` to x and y (scalars or arrays). Its own operator differs between releases."""
    return way.a * x + way.b * y + way.c, way.d * x + way.e * y + way.f


def _nothing(side_px: int) -> tuple[Image, Bools]:
    return np.zeros((side_px, side_px, 3), np.uint8), np.zeros((side_px, side_px), bool)
