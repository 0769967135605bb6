"""Cuts square pictures of the ground out of an orthophoto, with sides in metres and true north up.

rasterio (GDAL and PROJ) reads the file. Other modules import `transform` from here, because this module raises a clear
error if rasterio is missing."""

import logging
import math
import os
import re
import warnings
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import cv2
import numpy as np

from edgevpr.core.arrays import Bools, Doubles, Image
from edgevpr.core.errors import ImageError, SourceError
from edgevpr.core.geodesy import D, wrap_deg
from edgevpr.core.types import Position
from edgevpr.frames.images import resize

# GDAL's block cache in MB; GDAL reads this on first use. Its default is 5 % of the RAM.
os.environ.setdefault("GDAL_CACHEMAX", "64")

try:
    import rasterio
    from rasterio._err import CPLE_BaseError
    from rasterio.crs import CRS
    from rasterio.enums import ColorInterp, Resampling
    from rasterio.errors import NotGeoreferencedWarning, RasterioError
    from rasterio.warp import transform as transform
    from rasterio.windows import Window
except ModuleNotFoundError as error:
    raise SourceError(
        f"Orthophotos require rasterio, and {error.name} is not installed: run `pip install rasterio scipy shapely`."
    ) from error

_log = logging.getLogger(__name__)
logging.getLogger("rasterio").setLevel(logging.CRITICAL)  # edgevpr reports each fault once, in its own words

_COLOURS = (ColorInterp.blue, ColorInterp.green, ColorInterp.red)
WGS84 = CRS.from_epsg(4326)
_WEB_MERCATOR = CRS.from_epsg(3857)
# In WKT. With the Earth's radius of WGS 84 or GRS 80, or with parameters to WGS 84, the name matters little.
_UNNAMED_DATUM = re.compile(
    r'DATUM\["[^"]*(unknown|not.specified)[^"]*",SPHEROID\["[^"]*",(?!6378137)[^]]*(?!\]*,TOWGS84)\]', re.IGNORECASE
)
_WEB_MERCATOR_M = 2 * math.pi * 6_378_137.0  # its width
_ALPHA_SAMPLE_PX = 512
_MAX_GREY_ALPHA = 0.2  # of the pixels; a mask is grey at the edges of its data at most
_EDGE_POINTS = 25  # per edge, because a straight edge of the file is a curve in another coordinate system
_MAX_HALVINGS = 8  # of the resolution; eight reduce a tile of 256 pixels to one


class Orthophoto:
    """An open orthophoto. `name` is used in messages, and `short_name` in the names of the pictures cut from it.
    `extent_deg` is its bounding box (south, west, north, east), `middle` the position of its centre, and `resolution_m`
    the size of a pixel on the ground there, in metres."""

    def __init__(self, source: str | Path) -> None:
        """Open a GeoTIFF, VRT, MBTiles or other file that GDAL reads. Raises SourceError."""
        path = Path(source)
        if not path.exists():
            raise SourceError(f"{source} does not exist: check the path (`gdal_translate` can save a tile server).")
        if path.is_dir():
            raise SourceError(
                f"{source} is a folder, but must be a file. GDAL can make one from a folder of tiles "
                "(docs/how-to/map-from-an-orthophoto.md)."
            )
        self.name, self.short_name = str(path), path.name
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", NotGeoreferencedWarning)
                self._data = rasterio.open(path)
        except (RasterioError, OSError) as error:
            raise SourceError(
                f"{self.name} cannot be opened as an orthophoto: use a GeoTIFF, VRT or MBTiles file."
            ) from error
        self._bands = self._find_colour_bands()
        self._is_alpha_mask = self._check_alpha()
        self._locate()

    def _locate(self) -> None:
        """Compute where the orthophoto is. Closes it and raises SourceError if its coordinates cannot be converted."""
        crs = self._data.crs
        self._wrap = 360 if crs.is_geographic else _WEB_MERCATOR_M if crs == _WEB_MERCATOR else 0
        try:
            columns, rows = np.array([[self._data.width / 2], [self._data.height / 2]])
            (lon_deg,), (lat_deg,) = self._to_crs(columns, rows, WGS84)
            if abs(lat_deg) > 90 or (crs.is_geographic and abs(lon_deg) > 360):
                self.close()
                raise SourceError(
                    f"{self.name} says {crs.to_string()[:60]}, but its coordinates are not degrees: export it again in "
                    "the coordinate system that they belong to."
                )
            self.middle = Position(lat_deg, wrap_deg(lon_deg))
            lons_deg, lats_deg = self.compute_outline(WGS84)
        except (CPLE_BaseError, RasterioError):
            lats_deg = lons_deg = np.array([np.nan])
        if not np.isfinite((lats_deg, lons_deg)).all():
            self.close()
            raise SourceError(
                f"{self.name}: its coordinate system ({crs.to_string()[:60]}) cannot be converted to "
                "latitude and longitude: export the orthophoto in another one, such as UTM or EPSG:4326."
            )
        lons_deg = self.middle.lon_deg + wrap_deg(lons_deg - self.middle.lon_deg)
        self.extent_deg = (lats_deg.min(), lons_deg.min(), lats_deg.max(), lons_deg.max())
        metre_px = self._to_pixels(self.middle, np.array([[0, 0], [1, 0], [0, 1]]))
        self.resolution_m = float(1 / np.sqrt(abs(np.linalg.det(metre_px[1:] - metre_px[0]))))

    def _find_colour_bands(self) -> list[int]:
        """Return the band numbers (from 1) of blue, green and red, or grey. Raises SourceError for an unusable file."""
        interpretations, dtypes = self._data.colorinterp, self._data.dtypes
        colours = [interpretations.index(colour) + 1 for colour in _COLOURS if colour in interpretations]
        others = [number for number, kind in enumerate(interpretations, start=1) if kind != ColorInterp.alpha]
        if len(colours) < 3:
            colours = others[2::-1] if len(others) >= 3 else others[:1]
        fault = None
        if not self._data.crs or self._data.transform.is_identity:
            fault = "it has no georeference (coordinate system and position)"
        elif _UNNAMED_DATUM.search(self._data.crs.to_wkt()):
            fault = (
                "its coordinate system names no datum, so it could be off by 100 m or more (name it with `gdal_edit.py "
                "-a_srs EPSG:...`)"
            )
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

    def _check_alpha(self) -> bool:
        """Return False if the file's alpha band holds grey values, as near infrared that is labelled alpha does."""
        if ColorInterp.alpha not in self._data.colorinterp:
            return True
        shape = tuple(min(side, _ALPHA_SAMPLE_PX) for side in (self._data.height, self._data.width))
        with suppress(RasterioError):
            alpha = self._data.read(self._data.colorinterp.index(ColorInterp.alpha) + 1, out_shape=shape)
            if np.mean((alpha > 0) & (alpha < alpha.max())) > _MAX_GREY_ALPHA:
                text = "%s: its alpha band holds grey values, such as near infrared, and is not used; black has no data"
                _log.warning(text, self.name)
                return False
        return True

    def compute_outline(self, crs: CRS) -> tuple[Doubles, Doubles]:
        """Return points along the edges of the file, x and y in the coordinate system `crs`, float64 (N,) each."""
        along, zero = np.linspace(0, 1, _EDGE_POINTS), np.zeros(_EDGE_POINTS)
        columns = np.concatenate((along, along, zero, zero + 1)) * self._data.width
        rows = np.concatenate((zero, zero + 1, along, along)) * self._data.height
        return self._to_crs(columns, rows, crs)

    def _to_crs(self, columns: Doubles, rows: Doubles, crs: CRS) -> tuple[Doubles, Doubles]:
        """Convert the pixels at `columns` and `rows`, float (N,) each, to x and y in the coordinate system `crs`,
        float64 (N,) each."""
        x, y = transform(self._data.crs, crs, *_apply_affine(self._data.transform, columns, rows))
        return np.array(x), np.array(y)

    def _to_pixels(self, origin: Position, points_m: Doubles) -> Doubles:
        """Convert points (N, 2), metres (east, north) from `origin`, to pixels (column, row), float64 (N, 2). Pixel
        corners have integer coordinates."""
        return np.column_stack(self._crs_to_pixels(*transform(make_local_crs(origin), self._data.crs, *points_m.T)))

    def _crs_to_pixels(self, x: Sequence[float], y: Sequence[float]) -> tuple[Doubles, Doubles]:
        """Convert points from the coordinate system of the file to pixels: columns and rows, float64 (N,) each."""
        affine, across = self._data.transform, np.array(x)
        if self._wrap:  # the longitudes of a file may run from 0 to 360 degrees, or cross the date line
            middle, _ = _apply_affine(affine, self._data.width / 2, self._data.height / 2)
            across += self._wrap * np.round((middle - across) / self._wrap)
        return _apply_affine(~affine, across, np.array(y))

    def cut(self, centre: Position, footprint_m: float, side_px: int) -> tuple[Image, Bools]:
        """Cut out a square of ground around `centre`, true north up, with sides of `footprint_m`.

        Returns the picture, uint8 (side_px, side_px, 3) BGR, and bool (side_px, side_px), True where there is data.
        Pixels without data get the mean colour of the others. Raises ImageError if this part of the file is damaged."""
        corners = self._to_pixels(centre, footprint_m / 2 * np.array([[-1, 1], [1, 1], [1, -1], [-1, -1]]))
        if not np.isfinite(corners).all():
            return _make_blank(side_px)
        source_px = np.hypot(*(corners[1] - corners[0]))
        # The file is reduced by this power of two before it is warped.
        shrink = 1 << min(int(np.log2(max(source_px / side_px, 1))), _MAX_HALVINGS)
        size = np.array([self._data.width, self._data.height])
        low = np.clip(corners.min(axis=0) - 2 * shrink, 0, size).astype(int) // shrink * shrink
        high = np.clip(corners.max(axis=0) + 3 * shrink, 0, size).astype(int) // shrink * shrink
        if (high <= low).any():
            return _make_blank(side_px)
        ground, valid = self._read(low.tolist(), high.tolist(), shrink)
        # Warp to twice the size and average, so that no pixel of the file is skipped.
        large_px = 2 * side_px
        target = np.array([[0, 0], [large_px, 0], [large_px, large_px], [0, large_px]])
        cut_px, target_px = (corners - low) / shrink - 0.5, target - 0.5
        view = cv2.getPerspectiveTransform(cut_px.astype(np.float32), target_px.astype(np.float32))
        large = (large_px, large_px)
        warped = cv2.warpPerspective(ground, view, large, borderMode=cv2.BORDER_REPLICATE)
        picture = resize(warped, (side_px, side_px))  # type: ignore[arg-type]  # uint8
        warped = cv2.warpPerspective(255 * valid.astype(np.uint8), view, large)
        # Use only pure data pixels: those at the edge are mixed with black and would outline the data.
        has_data = resize(warped, (side_px, side_px)) >= 250  # type: ignore[arg-type]  # uint8
        if has_data.any():
            picture[~has_data] = picture[has_data].mean(axis=0)
        return picture, has_data

    def _read(self, low: Sequence[int], high: Sequence[int], shrink: int) -> tuple[Image, Bools]:
        """Read the window from (column, row) `low` to `high` (exclusive), reduced by the factor `shrink`: each pixel of
        the result is the mean of `shrink` x `shrink` pixels. The window's sides must be multiples of `shrink`.

        Returns the picture, uint8 (H, W, 3) BGR, and bool (H, W), True where there is data. Raises ImageError if the
        window is damaged."""
        width, height = high[0] - low[0], high[1] - low[1]
        shape, window = (height // shrink, width // shrink), Window(*low, width, height)
        try:
            out_shape = (len(self._bands), *shape)
            bands = self._data.read(self._bands, window=window, out_shape=out_shape, resampling=Resampling.average)
            if self._is_alpha_mask:
                valid = self._data.dataset_mask(window=window, out_shape=shape) > 127
            else:
                valid = np.any(bands, axis=0)
        except RasterioError as error:
            raise ImageError(
                f"{self.name} cannot be read at column {low[0]}, row {low[1]} ({error}): copy the file again."
            ) from error
        return np.ascontiguousarray(np.broadcast_to(bands.transpose(1, 2, 0), (*shape, 3))), valid

    def close(self) -> None:
        """Close the file."""
        self._data.close()


def _apply_affine(affine: rasterio.Affine, x: D, y: D) -> tuple[D, D]:
    """Apply an affine transform to x and y (scalars or arrays). Affine's own operator differs between its releases."""
    return affine.a * x + affine.b * y + affine.c, affine.d * x + affine.e * y + affine.f


def _make_blank(side_px: int) -> tuple[Image, Bools]:
    return np.zeros((side_px, side_px, 3), np.uint8), np.zeros((side_px, side_px), bool)


def make_local_crs(origin: Position) -> CRS:
    """Return the azimuthal equidistant projection around `origin`: metres east and true north of that point. Distances
    and directions from that point are exact."""
    lat_deg, lon_deg = origin.lat_deg, origin.lon_deg
    return CRS.from_proj4(f"+proj=aeqd +lat_0={lat_deg:.10f} +lon_0={lon_deg:.10f} +datum=WGS84 +units=m")
