"""An orthophoto: squares of ground are cut out of it, in metres on the ground and with true north up."""

from pathlib import Path
from typing import Protocol, TypeVar

import cv2
import numpy as np

from edgevpr.core.arrays import Bools, Doubles, Image
from edgevpr.core.errors import SourceError
from edgevpr.core.types import Position
from edgevpr.frames.images import resized
from edgevpr.mapmaking.rasters import CRS, CPLE_BaseError, GeoRaster, RasterioError, TileFolder, rasterio, transform

Pixel = tuple[int, int]  # column and row
Coordinate = TypeVar("Coordinate", float, Doubles)
WGS84 = CRS.from_epsg(4326)
_EDGE_POINTS = 25  # a straight edge of the file is a curve elsewhere
_MOST_HALVINGS = 8  # to a pixel of a tile of 256


class Raster(Protocol):
    """A grid of pixels: see `georaster.GeoRaster`."""

    crs: CRS
    transform: rasterio.Affine
    width: int
    height: int

    def read(self, low: Pixel, high: Pixel, shrink: int) -> tuple[Image, Bools]: ...

    def close(self) -> None: ...


def local_crs(at: Position) -> CRS:
    """Return the plane that touches the Earth at a point: metres east and true north of it, the right distance and
    direction of each point as seen from there."""
    return CRS.from_proj4(f"+proj=aeqd +lat_0={at.lat_deg:.10f} +lon_0={at.lon_deg:.10f} +datum=WGS84 +units=m")


class Orthophoto:
    """An open orthophoto. `extent_deg` is (south, west, north, east), `middle` the middle of the file,
    `resolution_m` the ground under a pixel there."""

    def __init__(self, path: str | Path) -> None:
        """Open a GeoTIFF, VRT, MBTiles or other file that GDAL reads, or a folder of tiles. Raises SourceError."""
        self.path = Path(path)
        if not self.path.exists():
            raise SourceError(f"There is no orthophoto {path}: check the name.")
        self._raster: Raster = TileFolder(self.path) if self.path.is_dir() else GeoRaster(self.path)
        raster = self._raster
        try:
            self.middle = self._middle()
            lon_deg, lat_deg = self.outline(WGS84)
        except (CPLE_BaseError, RasterioError):
            lat_deg = lon_deg = np.array([np.nan])
        if not np.isfinite((lat_deg, lon_deg)).all():
            self.close()
            raise SourceError(
                f"{path}: its coordinate system ({raster.crs.to_string()[:60]}) cannot be brought to latitude and "
                "longitude: export it with another, such as UTM or EPSG:4326."
            )
        lon_deg = self.middle.lon_deg + (lon_deg - self.middle.lon_deg + 180) % 360 - 180
        self.extent_deg = (lat_deg.min(), lon_deg.min(), lat_deg.max(), lon_deg.max())
        metre_px = self._pixels(self.middle, np.array([[0, 0], [1, 0], [0, 1]]))
        self.resolution_m = float(1 / np.sqrt(abs(np.linalg.det(metre_px[1:] - metre_px[0]))))

    def _middle(self) -> Position:
        x, y = _through(self._raster.transform, self._raster.width / 2, self._raster.height / 2)
        (lon_deg,), (lat_deg,) = transform(self._raster.crs, WGS84, [x], [y])
        return Position(lat_deg, (lon_deg + 180) % 360 - 180)

    def outline(self, crs: CRS) -> tuple[Doubles, Doubles]:
        """Return points along the edge of the file in a coordinate system: x and y, float64 (N,)."""
        along, zero = np.linspace(0, 1, _EDGE_POINTS), np.zeros(_EDGE_POINTS)
        columns = np.concatenate((along, along, zero, zero + 1)) * self._raster.width
        rows = np.concatenate((zero, zero + 1, along, along)) * self._raster.height
        x, y = _through(self._raster.transform, columns, rows)
        to_x, to_y = transform(self._raster.crs, crs, x, y)
        return np.array(to_x), np.array(to_y)

    def _pixels(self, at: Position, points_m: Doubles) -> Doubles:
        """Return columns and rows (of the corners of pixels), float64 (N, 2), of points (N, 2) in metres east and north
        of `at`."""
        raster = self._raster
        x, y = (np.array(each) for each in transform(local_crs(at), raster.crs, *points_m.T))
        if raster.crs.is_geographic:  # a file may count from 0 to 360 degrees, or over the date line
            middle, _ = _through(raster.transform, raster.width / 2, raster.height / 2)
            x += 360 * np.round((middle - x) / 360)
        return np.column_stack(_through(~raster.transform, x, y))

    def cut(self, at: Position, footprint_m: float, side_px: int) -> tuple[Image, Bools]:
        """Cut a square of ground with its middle at `at` and true north up, `footprint_m` wide.

        Returns uint8 (side_px, side_px, 3) BGR, and bool of the same shape, True where there is data. Pixels without
        data have the mean colour of the others. Raises ImageError for a damaged part of the file.
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
        # Drawn twice as large and averaged, so that no pixel of the file is passed over.
        large_px = 2 * side_px
        drawn = np.array([[0, 0], [large_px, 0], [large_px, large_px], [0, large_px]])
        view = cv2.getPerspectiveTransform(
            ((corners - low) / shrink - 0.5).astype(np.float32), (drawn - 0.5).astype(np.float32)
        )
        large = (large_px, large_px)
        warped = cv2.warpPerspective(ground, view, large, borderMode=cv2.BORDER_REPLICATE)
        picture = resized(warped, (side_px, side_px))  # type: ignore[arg-type]  # uint8
        warped = cv2.warpPerspective(255 * valid.astype(np.uint8), view, large)
        # Wholly known pixels only: one at the edge is mixed with black, and would draw a line around the data.
        seen = resized(warped, (side_px, side_px)) >= 250  # type: ignore[arg-type]  # uint8
        if seen.any():
            picture[~seen] = picture[seen].mean(axis=0)
        return picture, seen

    def close(self) -> None:
        """Close the file."""
        self._raster.close()


def _through(way: rasterio.Affine, x: Coordinate, y: Coordinate) -> tuple[Coordinate, Coordinate]:
    """Send points (scalars or arrays) through an affine map; its own operator for that differs between releases."""
    return way.a * x + way.b * y + way.c, way.d * x + way.e * y + way.f


def _nothing(side_px: int) -> tuple[Image, Bools]:
    return np.zeros((side_px, side_px, 3), np.uint8), np.zeros((side_px, side_px), bool)
