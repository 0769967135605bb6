"""A georeferenced picture, read with GDAL.

Other modules import rasterio (GDAL and PROJ) from here, where a clear error is raised if it is not installed.
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

# Size of GDAL's cache in MB, read when it is first used. The default is a twentieth of the RAM.
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
        f"An orthophoto is read with rasterio, and {error.name} is not installed: run `pip install rasterio scipy "
        "shapely`."
    ) from error

logging.getLogger("rasterio").setLevel(logging.CRITICAL)  # edgevpr reports each fault once, in its own words

_COLOURS = (ColorInterp.blue, ColorInterp.green, ColorInterp.red)
WGS84 = CRS.from_epsg(4326)
HALF_WORLD_M = math.pi * 6_378_137.0  # of Web Mercator

Pixel = tuple[int, int]  # column and row


class GeoRaster:
    """An open georeferenced picture. `crs` is its coordinate system. `transform` converts column and row (whole numbers
    at the corners of pixels) to coordinates of `crs`. `width` and `height` are in pixels. `name` names it in messages.
    """

    def __init__(self, source: str | Path, name: str) -> None:
        """Open what GDAL opens by the text `source`. Raises SourceError for what is no picture or has no
        georeference."""
        self.name = name
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", NotGeoreferencedWarning)
                self._data = rasterio.open(source)
        except (RasterioError, OSError) as error:
            raise SourceError(
                f"{name} cannot be opened as an orthophoto: give a GeoTIFF, VRT or MBTiles file, or a folder of tiles "
                "(z/x/y.png)."
            ) from error
        self.crs, self.transform = self._data.crs, self._data.transform
        self.width, self.height = self._data.width, self._data.height
        self._bands = self._find_colour_bands()

    def _find_colour_bands(self) -> list[int]:
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
            raise SourceError(f"{self.name} is no orthophoto: {fault}.")
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
                f"{self.name}: the part from column {low[0]} and row {low[1]} on cannot be read ({error}): copy the "
                "file again."
            ) from error
        return np.ascontiguousarray(np.broadcast_to(bands.transpose(1, 2, 0), (*shape, 3))), valid

    def close(self) -> None:
        """Close the file."""
        self._data.close()


def make_local_crs(at: Position) -> CRS:
    """Return the coordinate system of the plane that touches the Earth at `at`: metres east and true north of that
    point. Distances and directions from that point are exact."""
    return CRS.from_proj4(f"+proj=aeqd +lat_0={at.lat_deg:.10f} +lon_0={at.lon_deg:.10f} +datum=WGS84 +units=m")
