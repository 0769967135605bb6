"""Small geo-referenced pictures for tests: bright marks on dark ground, at known places."""

import math
import warnings
from pathlib import Path

import numpy as np

from edgevpr.core.types import Position

HOME = Position(50.0, 11.9)  # at the edge of UTM zone 32: grid north is 2.2 degrees off true north
MARKS_M = ((0.0, 0.0), (25.0, 0.0), (0.0, 30.0), (-28.0, -22.0))  # east and north of HOME
_SEMI_MAJOR_M = 6_378_137.0
_ECCENTRICITY2 = 0.00669437999014


def ground_m(lat_deg, lon_deg) -> tuple[np.ndarray, np.ndarray]:
    """Metres east and north of HOME, by the radii of the ellipsoid there: right to millimetres at 100 m."""
    sine, cosine = math.sin(math.radians(HOME.lat_deg)), math.cos(math.radians(HOME.lat_deg))
    across_m = _SEMI_MAJOR_M / math.sqrt(1 - _ECCENTRICITY2 * sine**2)
    along_m = across_m * (1 - _ECCENTRICITY2) / (1 - _ECCENTRICITY2 * sine**2)
    east_m = np.radians(np.subtract(lon_deg, HOME.lon_deg)) * across_m * cosine
    return east_m, np.radians(np.subtract(lat_deg, HOME.lat_deg)) * along_m


def write_mission(path: Path, waypoints) -> Path:
    """Write waypoints (MAV_FRAME, lat_deg, lon_deg, alt_m) as a file of Mission Planner."""
    rows = [
        f"{at}\t0\t{frame}\t16\t0\t0\t0\t0\t{lat}\t{lon}\t{alt}\t1"
        for at, (frame, lat, lon, alt) in enumerate(waypoints)
    ]
    path.write_text("\n".join(["QGC WPL 110", *rows]))
    return path


def draw_marks(east_m: np.ndarray, north_m: np.ndarray) -> np.ndarray:
    """Brightness of the ground, float64: 60, and 210 in the middle of each mark."""
    bright = np.full(np.shape(east_m), 60.0)
    for east, north in MARKS_M:
        bright += 150 * np.exp(-((east_m - east) ** 2 + (north_m - north) ** 2) / (2 * 1.5**2))
    return bright


def grid(crs: str, pixel_m: float, side_px: int, rotation_deg: float = 0.0):
    """The geo-reference of a square picture around HOME, and where its pixels are: metres east and north."""
    from rasterio import Affine
    from rasterio.warp import transform

    (x, x_north), (y, y_north) = transform("EPSG:4326", crs, [HOME.lon_deg] * 2, [HOME.lat_deg, HOME.lat_deg + 1e-3])
    metres = ground_m(HOME.lat_deg + 1e-3, HOME.lon_deg)[1]
    pixel = pixel_m * math.hypot(x_north - x, y_north - y) / metres
    across, along = pixel * math.cos(math.radians(rotation_deg)), pixel * math.sin(math.radians(rotation_deg))
    half = side_px / 2
    to_crs = Affine(across, along, x - half * (across + along), along, -across, y - half * (along - across))
    columns, rows = np.meshgrid(np.arange(side_px) + 0.5, np.arange(side_px) + 0.5)
    x = to_crs.a * columns + to_crs.b * rows + to_crs.c
    y = to_crs.d * columns + to_crs.e * rows + to_crs.f
    lon_deg, lat_deg = transform(crs, "EPSG:4326", x.ravel(), y.ravel())
    east_m, north_m = ground_m(lat_deg, lon_deg)
    return to_crs, east_m.reshape(columns.shape), north_m.reshape(columns.shape)


def write_raster(path: Path, bands: np.ndarray, crs: str | None, to_crs, **profile) -> Path:
    """Write bands (N, H, W) as a GeoTIFF."""
    import rasterio

    shape = {"count": len(bands), "height": bands.shape[1], "width": bands.shape[2], "dtype": bands.dtype}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a file without a geo-reference
        with rasterio.open(path, "w", driver="GTiff", crs=crs, transform=to_crs, **shape, **profile) as out:
            out.write(bands)
    return path


def write_marked_raster(
    path: Path, crs: str = "EPSG:32632", pixel_m: float = 0.25, side_px: int = 640, rotation_deg: float = 0.0
) -> Path:
    """Write the marks as a picture of three bands, whose red is brighter than its blue."""
    to_crs, east_m, north_m = grid(crs, pixel_m, side_px, rotation_deg)
    bright = draw_marks(east_m, north_m)
    return write_raster(path, np.stack((bright, 0.9 * bright, 0.8 * bright)).astype(np.uint8), crs, to_crs)


def write_textured_raster(path: Path, side_px: int = 640, pixel_m: float = 0.5) -> Path:
    """Write ground with texture at all scales, in UTM."""
    from pictures import draw_texture

    to_crs, _, _ = grid("EPSG:32632", pixel_m, side_px)
    rng = np.random.default_rng(3)
    ground = draw_texture(5, side_px, side_px).astype(float)
    ground[: side_px // 3, : side_px // 3] = draw_texture(6, side_px // 3, side_px // 3)
    ground = np.clip(ground * 0.7 + 40 * rng.random(ground.shape), 1, 255).astype(np.uint8)
    return write_raster(path, ground[None], "EPSG:32632", to_crs)
