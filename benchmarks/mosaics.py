"""Mosaics of real aerial pictures: the pictures of a set, laid out by its mosaic_positions.csv, and the position of the
mosaic on Earth."""

from dataclasses import dataclass
from pathlib import Path

import base
import cv2
import numpy as np
import rasterio
from rasterio.warp import transform

from edgevpr.core.geodesy import fit_similarity
from edgevpr.core.types import Position
from edgevpr.frames.images import read_image
from edgevpr.frames.positions import read_positions

_FIT_ROUNDS = 10


@dataclass(frozen=True, slots=True)
class MosaicLayout:
    """Where each picture, by its name, lies on a canvas of `size` (width, height): its `middle` (2,) in pixels of the
    canvas, its `scale`, and its rotation `turn` in radians."""

    middle: dict[str, np.ndarray]
    scale: dict[str, float]
    turn: dict[str, float]
    size: tuple[int, int]

    def compute_transform(self, name: str, image: np.ndarray) -> np.ndarray:
        """Return the affine transform (2, 3) from the pixels of a picture to those of the canvas."""
        cos, sin = self.scale[name] * np.cos(self.turn[name]), self.scale[name] * np.sin(self.turn[name])
        linear, middle = np.array([[cos, -sin], [sin, cos]]), (np.array(image.shape[1::-1]) - 1) / 2
        return np.column_stack([linear, self.middle[name] - linear @ middle])


def read_layout(folder: Path) -> MosaicLayout:
    """Read the largest connected component of a set's mosaic, scaled so that pictures about keep their resolution."""
    rows = base.read_csv(folder / "mosaic_positions.csv")
    components = [row["component"] for row in rows]
    rows = [row for row in rows if row["component"] == max(set(components), key=components.count)]
    canvas_scale = 1 / np.median([float(row["scale"]) for row in rows])
    scale = {row["file"]: float(row["scale"]) * canvas_scale for row in rows}
    middle = {row["file"]: np.array([float(row["x_px"]), float(row["y_px"])]) * canvas_scale for row in rows}
    margin = 500 * max(scale.values())
    low, high = np.min(list(middle.values()), axis=0) - margin, np.max(list(middle.values()), axis=0) + margin
    turn = {row["file"]: float(np.radians(float(row["rotation_deg"]))) for row in rows}
    width, height = (high - low).astype(int).tolist()
    return MosaicLayout({name: point - low for name, point in middle.items()}, scale, turn, (width, height))


@dataclass(frozen=True, slots=True)
class Ground:
    """The georeference of a mosaic: `affine` maps its columns and rows (corners of pixels) to metres of `crs`."""

    crs: str
    affine: rasterio.Affine

    def to_position(self, pixel: np.ndarray) -> Position:
        """Return the position of a point (2,) of the canvas."""
        east, north = self.affine @ tuple(pixel + 0.5)
        (lon,), (lat,) = transform(self.crs, "EPSG:4326", [east], [north])
        return Position(lat, lon)


def make_mosaic(folder: Path, layout: MosaicLayout, part: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the mosaic of a `part` of a set (ref or query), uint8 (H, W, 3) BGR, and a mask, bool (H, W), True where a
    picture covers it. Where pictures overlap, a pixel is of the picture whose edge is farthest from it."""
    width, height = layout.size
    canvas, best = np.zeros((height, width, 3), np.uint8), np.zeros((height, width), np.float32)
    for name in sorted(layout.middle):
        if not (folder / part / name).is_file():
            continue
        image = read_image(folder / part / name)
        rows, columns = image.shape[:2]
        matrix = layout.compute_transform(name, image)
        y, x = np.mgrid[:rows, :columns]
        edge_share = np.minimum(np.minimum(x, columns - 1 - x) / columns, np.minimum(y, rows - 1 - y) / rows) + 1e-3
        weight = cv2.warpAffine(edge_share.astype(np.float32), matrix, layout.size)
        is_better = weight > best
        canvas[is_better] = np.maximum(cv2.warpAffine(image, matrix, layout.size)[is_better], 1)
        best[is_better] = weight[is_better]
    return canvas, best > 0


def fit_ground(folder: Path, layout: MosaicLayout) -> Ground:
    """Fit the georeference of a mosaic to the GPS tags of its pictures, without outliers."""
    tags = {name: tag.position for name, tag in read_positions(folder / "positions.csv").items() if tag.position}
    tagged = [name for name in layout.middle if name in tags]
    lat_deg, lon_deg = ([getattr(tags[name], key) for name in tagged] for key in ("lat_deg", "lon_deg"))
    crs = f"EPSG:{32600 + int((np.mean(lon_deg) + 180) // 6) + 1}"  # UTM zone, northern hemisphere
    east_m, north_m = transform("EPSG:4326", crs, lon_deg, lat_deg)
    pixels = np.array([complex(*layout.middle[name] * (1, -1)) for name in tagged])
    metres = np.array(east_m) + 1j * np.array(north_m)
    is_inlier = np.ones(len(pixels), bool)
    for _ in range(_FIT_ROUNDS):
        scale, offset = fit_similarity(pixels[is_inlier], metres[is_inlier])
        residual_m = abs(scale * pixels + offset - metres)
        is_inlier = residual_m < 2.5 * np.median(residual_m)
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
