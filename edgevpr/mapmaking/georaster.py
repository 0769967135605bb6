"""A georeferenced picture file, read with GDAL.

Other modules import rasterio (GDAL and PROJ) from here, where a clear error is raised if it is not installed.
"""

import logging
import math
import os
import re
import warnings
from pathlib import Path

import numpy as np

from edgevpr.core.arrays import Bools, Image
from edgevpr.core.errors import ImageError, SourceError
from edgevpr.core.types import Position

# Size of GDAL's cache in MB, read when it is first used. The default is a twentieth of the RAM.
os.environ.setdefault("GDAL_CACHEMAX", "64")
os.environ.setdefault("GDAL_MAX_CONNECTIONS", "2")  # to a server of tiles, out of politeness

try:
    import rasterio as rasterio
    import rasterio.shutil
    from rasterio._err import CPLE_BaseError as CPLE_BaseError
    from rasterio.crs import CRS as CRS
    from rasterio.enums import ColorInterp, Resampling
    from rasterio.errors import NotGeoreferencedWarning
    from rasterio.errors import RasterioError as RasterioError
    from rasterio.io import MemoryFile as MemoryFile
    from rasterio.warp import transform as transform
    from rasterio.warp import transform_bounds
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
_STATUS = re.compile(r"HTTP (?:status|error) code ?: ([1-9]\d\d)")

_ALIGNED_PX = 256

Pixel = tuple[int, int]  # column and row
Extent = tuple[float, float, float, float]


class GeoRaster:
    """An open georeferenced picture file. `crs` is its coordinate system. `transform` converts column and row (whole
    numbers at the corners of pixels) to coordinates of `crs`. `width` and `height` are in pixels. `name` names it in
    messages, and `short_name` the pictures cut from it; `host` gives it (None: it is a file)."""

    def __init__(self, source: str | Path, host: str | None = None, extent_deg: Extent | None = None) -> None:
        """Open a file, or the description of what is at `host`, of which only `extent_deg` (south, west, north, east)
        is used. Raises SourceError for one that is no picture or has no georeference."""
        self.name, self.short_name, self.host = host or str(source), host or Path(source).name, host
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", NotGeoreferencedWarning)
                self._data = rasterio.open(source)
        except (RasterioError, OSError) as error:
            raise SourceError(
                f"{self.name} cannot be opened as an orthophoto: give a GeoTIFF, VRT, MBTiles or PMTiles file, the "
                "tile cache of QGroundControl or Mission Planner, a folder of tiles (z/x/y.png), or an address."
            ) from (None if host else error)
        self.crs, self.transform = self._data.crs, self._data.transform
        self.width, self.height = self._data.width, self._data.height
        self._bands = self._colour_bands()
        self._first = (0, 0)
        if extent_deg:
            self._narrow(extent_deg)

    def _narrow(self, extent_deg: Extent) -> None:
        """Use only the window of `extent_deg`. Raises SourceError if nothing is there."""
        south, west, north, east = extent_deg
        wanted = self._data.window(*transform_bounds(WGS84, self.crs, west, south, east, north))
        size = np.array([self.width, self.height])
        low = np.clip([wanted.col_off, wanted.row_off], 0, size).astype(int)
        high = np.clip([wanted.col_off + wanted.width, wanted.row_off + wanted.height], 0, size).astype(int)
        low = low // _ALIGNED_PX * _ALIGNED_PX  # the coarser versions begin a pixel there
        if (high <= low).any():
            self.close()
            raise SourceError(f"{self.name} has nothing of the area: check the address and the area.")
        (column, row), (self.width, self.height) = low.tolist(), (high - low).tolist()
        self._first = column, row
        at = self.transform
        x, y = at.c + at.a * column + at.b * row, at.f + at.d * column + at.e * row
        self.transform = rasterio.Affine(at.a, at.b, x, at.d, at.e, y)

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
            raise SourceError(f"{self.name} is no orthophoto: {fault}.")
        return colours

    def read(self, low: Pixel, high: Pixel, shrink: int) -> tuple[Image, Bools]:
        """Read the window from (column, row) `low` to `high` (not included), reduced by the factor `shrink`: each pixel
        of the result is the mean of `shrink` x `shrink` pixels. The window's sides must be multiples of `shrink`.

        Returns the picture, uint8 (H, W, 3) BGR, and bool (H, W), True where there is data. Raises ImageError for a
        damaged window, and SourceError if a host does not give it.
        """
        width, height = high[0] - low[0], high[1] - low[1]
        shape, window = (
            (height // shrink, width // shrink),
            Window(low[0] + self._first[0], low[1] + self._first[1], width, height),
        )
        try:
            bands = self._data.read(
                self._bands, window=window, out_shape=(len(self._bands), *shape), resampling=Resampling.average
            )
            valid = self._data.dataset_mask(window=window, out_shape=shape) > 127
        except RasterioError as error:
            if self.host:
                raise refusal(self.host, status_in(error)) from None
            raise ImageError(
                f"{self.name}: the part from column {low[0]} and row {low[1]} on cannot be read ({error}): copy the "
                "file again."
            ) from error
        return np.ascontiguousarray(np.broadcast_to(bands.transpose(1, 2, 0), (*shape, 3))), valid

    def close(self) -> None:
        """Close the file."""
        self._data.close()


def local_crs(at: Position) -> CRS:
    """Return the coordinate system of the plane that touches the Earth at `at`: metres east and true north of that
    point. Distances and directions from that point are exact."""
    return CRS.from_proj4(f"+proj=aeqd +lat_0={at.lat_deg:.10f} +lon_0={at.lon_deg:.10f} +datum=WGS84 +units=m")


def status_in(error: BaseException) -> int | None:
    """Return the HTTP status in an error of GDAL; None: there was no answer, or GDAL says nothing of it."""
    found = _STATUS.search(f"{error} {error.__cause__}")
    return int(found[1]) if found else None


def refusal(host: str, status: int | None) -> SourceError:
    """Return the error for an answer of `host` with an HTTP status; None: there was no answer."""
    kept = "Tiles fetched so far are kept."
    if not status:
        return SourceError(f"{host} cannot be reached: check the address and the network. {kept}")
    if status in (401, 403):
        what = "refuses: check the key in the address, and your right to fetch its tiles"
    elif status == 429:
        what = "asks for a pause: wait as long as its terms say"
    else:
        what = "cannot give a tile: check the address, or wait"
    return SourceError(f"{host} {what}, and run this again (HTTP {status}). {kept}")
