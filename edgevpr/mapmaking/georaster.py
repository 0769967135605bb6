"""Reads a georeferenced raster with GDAL.

Other modules import rasterio (GDAL and PROJ) from here, because this module raises a clear error if it is missing.
"""

import logging
import math
import os
import warnings
from pathlib import Path

import numpy as np

from edgevpr.core.arrays import Bools, Image
from edgevpr.core.errors import ImageError, SourceError
from edgevpr.core.types import Position

# GDAL's block cache in MB; GDAL reads this on first use. Its default is 5 % of the RAM.
os.environ.setdefault("GDAL_CACHEMAX", "64")

try:
    import rasterio as rasterio
    from rasterio._err import CPLE_BaseError as CPLE_BaseError
    from rasterio.crs import CRS as CRS
    from rasterio.enums import ColorInterp, Resampling
    from rasterio.errors import NotGeoreferencedWarning
    from rasterio.errors import RasterioError as RasterioError
    from rasterio.warp import transform as transform
    from rasterio.windows import Window
except ModuleNotFoundError as error:
    raise SourceError(
        f"Orthophotos require rasterio, and {error.name} is not installed: run `pip install rasterio scipy shapely`."
    ) from error

logging.getLogger("rasterio").setLevel(logging.CRITICAL)  # edgevpr reports each fault once, in its own words

_COLOURS = (ColorInterp.blue, ColorInterp.green, ColorInterp.red)
WGS84 = CRS.from_epsg(4326)
HALF_WORLD_M = math.pi * 6_378_137.0  # half the width of the Web Mercator map

Pixel = tuple[int, int]  # column and row


class GeoRaster:
    """An open georeferenced raster. `crs` is its coordinate system. `transform` converts column and row (pixel corners
    have integer coordinates) to coordinates of `crs`. `width` and `height` are in pixels. `name` is used in messages.
    """

    def __init__(self, path: Path) -> None:
        """Open a file. Raises SourceError if it is not a picture or is not georeferenced."""
        self.name = str(path)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", NotGeoreferencedWarning)
                self._data = rasterio.open(path)
        except (RasterioError, OSError) as error:
            raise SourceError(
                f"{self.name} cannot be opened as an orthophoto: use a GeoTIFF, VRT or MBTiles file."
            ) from error
        self.crs, self.transform = self._data.crs, self._data.transform
        self.width, self.height = self._data.width, self._data.height
        self._bands = self._find_colour_bands()

    def _find_colour_bands(self) -> list[int]:
        """Return the band numbers (from 1) of blue, green and red, or of grey. Closes an unusable file and raises
        SourceError."""
        interpretations, dtypes = self._data.colorinterp, self._data.dtypes
        colours = [interpretations.index(colour) + 1 for colour in _COLOURS if colour in interpretations]
        others = [number for number, kind in enumerate(interpretations, start=1) if kind != ColorInterp.alpha]
        if len(colours) < 3:
            colours = others[2::-1] if len(others) >= 3 else others[:1]
        fault = None
        if not self.crs or self.transform.is_identity:
            fault = "it has no georeference (coordinate system and position)"
        elif ColorInterp.palette in interpretations:
            fault = "its colours are palette indices (convert it with `gdal_translate -expand rgb`)"
        elif not colours or any(dtypes[band - 1] != "uint8" for band in colours):
            fault = (
                f"it contains {dtypes[0]} values, such as heights, not an 8-bit picture (convert a 16-bit picture "
                "with `gdal_translate -ot Byte -scale`)"
            )
        if fault:
            self.close()
            raise SourceError(f"{self.name} is not a usable orthophoto: {fault}.")
        return colours

    def read(self, low: Pixel, high: Pixel, shrink: int) -> tuple[Image, Bools]:
        """Read the window from (column, row) `low` to `high` (exclusive), reduced by the factor `shrink`: each pixel of
        the result is the mean of `shrink` x `shrink` pixels. The window's sides must be multiples of `shrink`.

        Returns the picture, uint8 (H, W, 3) BGR, and bool (H, W), True where there is data. Raises ImageError if the
        window is damaged.
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
                f"{self.name} cannot be read at column {low[0]}, row {low[1]} ({error}): copy the file again."
            ) from error
        return np.ascontiguousarray(np.broadcast_to(bands.transpose(1, 2, 0), (*shape, 3))), valid

    def close(self) -> None:
        """Close the file."""
        self._data.close()


def make_local_crs(origin: Position) -> CRS:
    """Return the azimuthal equidistant projection around `origin`: metres east and true north of that point. Distances
    and directions from that point are exact."""
    lat_deg, lon_deg = origin.lat_deg, origin.lon_deg
    return CRS.from_proj4(f"+proj=aeqd +lat_0={lat_deg:.10f} +lon_0={lon_deg:.10f} +datum=WGS84 +units=m")
