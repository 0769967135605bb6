"""Cuts square pictures of the ground out of an orthophoto, with sides in metres and true north up."""

from collections.abc import Sequence
from pathlib import Path
from typing import TypeVar

import cv2
import numpy as np

from edgevpr.core.arrays import Bools, Doubles, Image
from edgevpr.core.errors import SourceError
from edgevpr.core.geodesy import wrap_deg
from edgevpr.core.types import Position
from edgevpr.frames.images import resize
from edgevpr.mapmaking.georaster import (
    CRS,
    HALF_WORLD_M,
    WGS84,
    CPLE_BaseError,
    GeoRaster,
    RasterioError,
    make_local_crs,
    rasterio,
    transform,
)

_EDGE_POINTS = 25  # per edge, because a straight edge of the file is a curve in another coordinate system
_MAX_HALVINGS = 8  # of the resolution; eight reduce a tile of 256 pixels to one

Coordinate = TypeVar("Coordinate", float, Doubles)


class Orthophoto:
    """An open orthophoto. `name` is used in messages, and `short_name` in the names of the pictures cut from it.
    `extent_deg` is its bounding box (south, west, north, east), `middle` the position of its centre, and `resolution_m`
    the size of a pixel on the ground there, in metres."""

    def __init__(self, source: str | Path) -> None:
        """Open a GeoTIFF, VRT, MBTiles or other file that GDAL reads. Raises SourceError."""
        path = Path(source)
        if not path.exists():
            raise SourceError(
                f"{source} does not exist: check the path (`gdal_translate` can save a tile server as a file)."
            )
        if path.is_dir():
            raise SourceError(
                f"{source} is a folder, but must be a file. GDAL can make one from a folder of tiles "
                "(docs/how-to/map-from-an-orthophoto.md)."
            )
        self.name, self.short_name = str(path), path.name
        self._raster = GeoRaster(path)
        is_mercator = self._raster.crs == CRS.from_epsg(3857)
        self._wrap = 360 if self._raster.crs.is_geographic else 2 * HALF_WORLD_M if is_mercator else 0
        try:
            columns, rows = np.array([[self._raster.width / 2], [self._raster.height / 2]])
            (lon_deg,), (lat_deg,) = self._to_crs(columns, rows, WGS84)
            self.middle = Position(lat_deg, wrap_deg(lon_deg))
            lons_deg, lats_deg = self.compute_outline(WGS84)
        except (CPLE_BaseError, RasterioError):
            lats_deg = lons_deg = np.array([np.nan])
        if not np.isfinite((lats_deg, lons_deg)).all():
            self.close()
            raise SourceError(
                f"{self.name}: its coordinate system ({self._raster.crs.to_string()[:60]}) cannot be converted to "
                "latitude and longitude: export the orthophoto in another one, such as UTM or EPSG:4326."
            )
        lons_deg = self.middle.lon_deg + wrap_deg(lons_deg - self.middle.lon_deg)
        self.extent_deg = (lats_deg.min(), lons_deg.min(), lats_deg.max(), lons_deg.max())
        metre_px = self._to_pixels(self.middle, np.array([[0, 0], [1, 0], [0, 1]]))
        self.resolution_m = float(1 / np.sqrt(abs(np.linalg.det(metre_px[1:] - metre_px[0]))))

    def compute_outline(self, crs: CRS) -> tuple[Doubles, Doubles]:
        """Return points along the edges of the file, x and y in the coordinate system `crs`, float64 (N,) each."""
        along, zero = np.linspace(0, 1, _EDGE_POINTS), np.zeros(_EDGE_POINTS)
        columns = np.concatenate((along, along, zero, zero + 1)) * self._raster.width
        rows = np.concatenate((zero, zero + 1, along, along)) * self._raster.height
        return self._to_crs(columns, rows, crs)

    def _to_crs(self, columns: Doubles, rows: Doubles, crs: CRS) -> tuple[Doubles, Doubles]:
        """Convert the pixels at `columns` and `rows`, float (N,) each, to x and y in the coordinate system `crs`,
        float64 (N,) each."""
        x, y = transform(self._raster.crs, crs, *_apply_affine(self._raster.transform, columns, rows))
        return np.array(x), np.array(y)

    def _to_pixels(self, origin: Position, points_m: Doubles) -> Doubles:
        """Convert points (N, 2), metres (east, north) from `origin`, to pixels (column, row), float64 (N, 2). Pixel
        corners have integer coordinates."""
        return np.column_stack(self._crs_to_pixels(*transform(make_local_crs(origin), self._raster.crs, *points_m.T)))

    def _crs_to_pixels(self, x: Sequence[float], y: Sequence[float]) -> tuple[Doubles, Doubles]:
        """Convert points from the coordinate system of the file to pixels: columns and rows, float64 (N,) each."""
        raster, across = self._raster, np.array(x)
        if self._wrap:  # the longitudes of a file may run from 0 to 360 degrees, or cross the date line
            middle, _ = _apply_affine(raster.transform, raster.width / 2, raster.height / 2)
            across += self._wrap * np.round((middle - across) / self._wrap)
        return _apply_affine(~raster.transform, across, np.array(y))

    def cut(self, centre: Position, footprint_m: float, side_px: int) -> tuple[Image, Bools]:
        """Cut out a square of ground around `centre`, true north up, with sides of `footprint_m`.

        Returns the picture, uint8 (side_px, side_px, 3) BGR, and bool (side_px, side_px), True where there is data.
        Pixels without data get the mean colour of the others. Raises ImageError if this part of the file is damaged.
        """
        half_m = footprint_m / 2
        corners = self._to_pixels(centre, half_m * np.array([[-1, 1], [1, 1], [1, -1], [-1, -1]]))
        if not np.isfinite(corners).all():
            return _make_blank(side_px)
        source_px = np.hypot(*(corners[1] - corners[0]))
        # The file is reduced by this power of two before it is warped.
        shrink = 1 << min(int(np.log2(max(source_px / side_px, 1))), _MAX_HALVINGS)
        size = np.array([self._raster.width, self._raster.height])
        low = np.clip(corners.min(axis=0) - 2 * shrink, 0, size).astype(int) // shrink * shrink
        high = np.clip(corners.max(axis=0) + 3 * shrink, 0, size).astype(int) // shrink * shrink
        if (high <= low).any():
            return _make_blank(side_px)
        ground, valid = self._raster.read(tuple(low.tolist()), tuple(high.tolist()), shrink)
        # Warp to twice the size and average, so that no pixel of the file is skipped.
        large_px = 2 * side_px
        target = np.array([[0, 0], [large_px, 0], [large_px, large_px], [0, large_px]])
        view = cv2.getPerspectiveTransform(
            ((corners - low) / shrink - 0.5).astype(np.float32), (target - 0.5).astype(np.float32)
        )
        large = (large_px, large_px)
        warped = cv2.warpPerspective(ground, view, large, borderMode=cv2.BORDER_REPLICATE)
        picture = resize(warped, (side_px, side_px))  # type: ignore[arg-type]  # uint8
        warped = cv2.warpPerspective(255 * valid.astype(np.uint8), view, large)
        # Use only pure data pixels: those at the edge are mixed with black and would outline the data.
        has_data = resize(warped, (side_px, side_px)) >= 250  # type: ignore[arg-type]  # uint8
        if has_data.any():
            picture[~has_data] = picture[has_data].mean(axis=0)
        return picture, has_data

    def close(self) -> None:
        """Close the file."""
        self._raster.close()


def _apply_affine(affine: rasterio.Affine, x: Coordinate, y: Coordinate) -> tuple[Coordinate, Coordinate]:
    """Apply an affine transform to x and y (scalars or arrays). Affine's own operator differs between its releases."""
    return affine.a * x + affine.b * y + affine.c, affine.d * x + affine.e * y + affine.f


def _make_blank(side_px: int) -> tuple[Image, Bools]:
    return np.zeros((side_px, side_px, 3), np.uint8), np.zeros((side_px, side_px), bool)
