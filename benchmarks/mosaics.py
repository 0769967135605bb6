"""Mosaics of real aerial pictures: those of a set laid over each other by its mosaic_positions.csv, and their place on
Earth."""

from dataclasses import dataclass
from pathlib import Path

import base
import cv2
import numpy as np
import rasterio
from rasterio.warp import transform

from edgevpr.frames.images import read_image
from edgevpr.frames.positions import read_positions

_FIT_ROUNDS = 10


@dataclass(frozen=True, slots=True)
class MosaicLayout:
    """Pictures on the canvas of a mosaic: `middle` (2,) of each in its pixels, `scale` and `turn` (radians) by name."""

    middle: dict[str, np.ndarray]
    scale: dict[str, float]
    turn: dict[str, float]
    size: tuple[int, int]

    def compute_transform(self, name: str, image: np.ndarray) -> np.ndarray:
        """Return where a picture lies: from its pixels to those of the canvas, (2, 3)."""
        cos, sin = self.scale[name] * np.cos(self.turn[name]), self.scale[name] * np.sin(self.turn[name])
        turned, middle = np.array([[cos, -sin], [sin, cos]]), (np.array(image.shape[1::-1]) - 1) / 2
        return np.column_stack([turned, self.middle[name] - turned @ middle])


def read_layout(folder: Path) -> MosaicLayout:
    """Read the largest component of a set's mosaic, scaled so that a picture keeps about its resolution."""
    rows = base.read_csv(folder / "mosaic_positions.csv")
    components = [row["component"] for row in rows]
    rows = [row for row in rows if row["component"] == max(set(components), key=components.count)]
    per_px = 1 / np.median([float(row["scale"]) for row in rows])
    scale = {row["file"]: float(row["scale"]) * per_px for row in rows}
    middle = {row["file"]: np.array([float(row["x_px"]), float(row["y_px"])]) * per_px for row in rows}
    room = 500 * max(scale.values())
    low, high = np.min(list(middle.values()), axis=0) - room, np.max(list(middle.values()), axis=0) + room
    turn = {row["file"]: float(np.radians(float(row["rotation_deg"]))) for row in rows}
    width, height = (high - low).astype(int).tolist()
    return MosaicLayout({name: point - low for name, point in middle.items()}, scale, turn, (width, height))


@dataclass(frozen=True, slots=True)
class Ground:
    """Where the canvas of a mosaic lies on the Earth: `affine` leads from its columns and rows (of the corners of
    pixels) to metres of `crs`."""

    crs: str
    affine: rasterio.Affine

    def to_lat_lon(self, pixel: np.ndarray) -> tuple[float, float]:
        """Return where a point of the canvas (2,) is, (lat_deg, lon_deg)."""
        east, north = self.affine @ tuple(pixel + 0.5)
        (lon,), (lat,) = transform(self.crs, "EPSG:4326", [east], [north])
        return lat, lon


def make_mosaic(folder: Path, layout: MosaicLayout, part: str) -> tuple[np.ndarray, np.ndarray]:
    """Lay the pictures of a `part` of a set (ref, query) over each other: uint8 (H, W, 3) BGR, and bool (H, W), True
    where there is any."""
    width, height = layout.size
    canvas, best = np.zeros((height, width, 3), np.uint8), np.zeros((height, width), np.float32)
    for name in sorted(layout.middle):
        if not (folder / part / name).is_file():
            continue
        image = read_image(folder / part / name)
        high, wide = image.shape[:2]
        matrix = layout.compute_transform(name, image)
        y, x = np.mgrid[:high, :wide]
        inward = np.minimum(np.minimum(x, wide - 1 - x) / wide, np.minimum(y, high - 1 - y) / high) + 1e-3
        weight = cv2.warpAffine(inward.astype(np.float32), matrix, layout.size)
        nearer = weight > best
        canvas[nearer] = np.maximum(cv2.warpAffine(image, matrix, layout.size)[nearer], 1)
        best[nearer] = weight[nearer]
    return canvas, best > 0


def fit_ground(folder: Path, layout: MosaicLayout) -> Ground:
    """Fit where a mosaic lies to the tags of its pictures."""
    tags = {name: tag.position for name, tag in read_positions(folder / "positions.csv").items() if tag.position}
    tagged = [name for name in layout.middle if name in tags]
    lat_deg, lon_deg = ([getattr(tags[name], key) for name in tagged] for key in ("lat_deg", "lon_deg"))
    crs = f"EPSG:{32600 + int((np.mean(lon_deg) + 180) // 6) + 1}"  # UTM of the northern half
    east_m, north_m = transform("EPSG:4326", crs, lon_deg, lat_deg)
    pixels = np.array([complex(*layout.middle[name] * (1, -1)) for name in tagged])
    scale, offset = _fit_similarity(pixels, np.array(east_m) + 1j * np.array(north_m))
    return Ground(crs, rasterio.Affine(scale.real, scale.imag, offset.real, scale.imag, -scale.real, offset.imag))


def write_tif(path: Path, ground: Ground, canvas: np.ndarray, covered: np.ndarray) -> None:
    """Write a mosaic as a geo-referenced GeoTIFF."""
    height, width = covered.shape
    bands = np.dstack([canvas[..., ::-1], 255 * covered.astype(np.uint8)]).transpose(2, 0, 1)
    layout = {"driver": "GTiff", "width": width, "height": height, "count": 4, "dtype": "uint8", "crs": ground.crs}
    with rasterio.open(
        path, "w", transform=ground.affine, tiled=True, compress="deflate", photometric="RGB", alpha="yes", **layout
    ) as out:
        out.write(bands)


def _fit_similarity(pixels: np.ndarray, metres: np.ndarray) -> tuple[complex, complex]:
    """Fit metres = scale pixels + offset; tags that are far off are left out."""
    is_inlier = np.ones(len(pixels), bool)
    for _ in range(_FIT_ROUNDS):
        (scale, offset), *_ = np.linalg.lstsq(np.stack([pixels, np.ones(len(pixels))], 1)[is_inlier], metres[is_inlier])
        off = abs(scale * pixels + offset - metres)
        is_inlier = off < 2.5 * np.median(off)
    return complex(scale), complex(offset)
