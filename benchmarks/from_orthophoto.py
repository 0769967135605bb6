"""Maps without a mapping flight, on real pictures: `python from_orthophoto.py`, part of `make results`.

The pictures ref/ of a set are laid over each other by mosaic_positions.csv, as one geo-referenced GeoTIFF. A map is cut
from it by `edgevpr map build --orthophoto`, and the set's queries are matched with it. The truth is where the same
mosaic has the query. So camera, day and light are nearly the flight's own, and only flown and mapped ground differ in
how they were made: a survey or satellite picture of another season is harder, and none is at hand.

Footprints were chosen to fit each set, as a user does who knows his camera and height. Writes from_orthophoto.json and
from_orthophoto.md into benchmarks/results/.
"""

import csv
import json
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import rasterio
import run_sets
from rasterio.warp import transform

from edgevpr.core.geodesy import distance_m
from edgevpr.core.text import markdown
from edgevpr.frames.images import read_image
from edgevpr.frames.positions import read_positions

CASES = (
    ("aerial_caliterra", 64.0, 16.0),
    ("aerial_garfield28", 140.0, 35.0),
    ("aerial_swindale", 120.0, 30.0),
)  # set, footprint and spacing in metres
_ROUNDS = 10


@dataclass(frozen=True, slots=True)
class Laid:
    """Pictures on the canvas of a mosaic: `middle` (2,) of each in its pixels, `scale` and `turn` (radians) by name."""

    middle: dict[str, np.ndarray]
    scale: dict[str, float]
    turn: dict[str, float]
    size: tuple[int, int]


def laid(folder: Path) -> Laid:
    """Read the largest component of a set's mosaic, scaled so that a picture keeps about its resolution."""
    with open(folder / "mosaic_positions.csv", newline="") as handle:
        rows = list(csv.DictReader(handle))
    components = [row["component"] for row in rows]
    of = max(set(components), key=components.count)
    rows = [row for row in rows if row["component"] == of]
    per_px = 1 / np.median([float(row["scale"]) for row in rows])
    scale = {row["file"]: float(row["scale"]) * per_px for row in rows}
    at = {row["file"]: np.array([float(row["x_px"]), float(row["y_px"])]) * per_px for row in rows}
    room = 500 * max(scale.values())
    low, high = np.min(list(at.values()), axis=0) - room, np.max(list(at.values()), axis=0) + room
    turn = {row["file"]: float(np.radians(float(row["rotation_deg"]))) for row in rows}
    width, height = (high - low).astype(int).tolist()
    return Laid({name: each - low for name, each in at.items()}, scale, turn, (width, height))


@dataclass(frozen=True, slots=True)
class Ground:
    """Where the canvas of a mosaic lies on the Earth: `affine` leads from its columns and rows (of the corners of
    pixels) to metres of `crs`."""

    crs: str
    affine: rasterio.Affine

    def position(self, pixel: np.ndarray) -> tuple[float, float]:
        """Return where a point of the canvas (2,) is, (lat_deg, lon_deg)."""
        east, north = self.affine @ tuple(pixel + 0.5)
        (lon,), (lat,) = transform(self.crs, "EPSG:4326", [east], [north])
        return lat, lon


def mosaic_of(folder: Path, on: Laid, part: str) -> tuple[np.ndarray, np.ndarray]:
    """Lay the pictures of a `part` of a set (ref, query) over each other: uint8 (H, W, 3) BGR, and bool (H, W), True
    where there is any."""
    width, height = on.size
    canvas, best = np.zeros((height, width, 3), np.uint8), np.zeros((height, width), np.float32)
    for name in sorted(on.middle):
        if not (folder / part / name).is_file():
            continue
        image = read_image(folder / part / name)
        high, wide = image.shape[:2]
        cos, sin = on.scale[name] * np.cos(on.turn[name]), on.scale[name] * np.sin(on.turn[name])
        turned = np.array([[cos, -sin], [sin, cos]])
        matrix = np.column_stack([turned, on.middle[name] - turned @ [(wide - 1) / 2, (high - 1) / 2]])
        y, x = np.mgrid[:high, :wide]
        inward = np.minimum(np.minimum(x, wide - 1 - x) / wide, np.minimum(y, high - 1 - y) / high) + 1e-3
        weight = cv2.warpAffine(inward.astype(np.float32), matrix, on.size)
        nearer = weight > best
        canvas[nearer] = np.maximum(cv2.warpAffine(image, matrix, on.size)[nearer], 1)
        best[nearer] = weight[nearer]
    return canvas, best > 0


def ground_of(folder: Path, on: Laid) -> Ground:
    """Fit where a mosaic lies to the tags of its pictures."""
    tags = {name: tag.position for name, tag in read_positions(folder / "positions.csv").items() if tag.position}
    tagged = [name for name in on.middle if name in tags]
    lat_deg, lon_deg = ([getattr(tags[name], key) for name in tagged] for key in ("lat_deg", "lon_deg"))
    crs = f"EPSG:{32600 + int((np.mean(lon_deg) + 180) // 6) + 1}"  # UTM of the northern half
    east_m, north_m = transform("EPSG:4326", crs, lon_deg, lat_deg)
    scale, offset = _similarity(
        np.array([complex(*on.middle[name] * (1, -1)) for name in tagged]), np.array(east_m) + 1j * np.array(north_m)
    )
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


def write_mosaic(folder: Path, on: Laid, path: Path) -> dict[str, tuple[float, float]]:
    """Write the mosaic of a set's map pictures; return where its queries are, (lat_deg, lon_deg) by name."""
    ground = ground_of(folder, on)
    write_tif(path, ground, *mosaic_of(folder, on, "ref"))
    return {name: ground.position(at) for name, at in on.middle.items() if (folder / "query" / name).is_file()}


def _similarity(pixels: np.ndarray, metres: np.ndarray) -> tuple[complex, complex]:
    """Fit metres = scale pixels + offset; tags that are far off are left out."""
    kept = np.ones(len(pixels), bool)
    for _ in range(_ROUNDS):
        (scale, offset), *_ = np.linalg.lstsq(np.stack([pixels, np.ones(len(pixels))], 1)[kept], metres[kept])
        off = abs(scale * pixels + offset - metres)
        kept = off < 2.5 * np.median(off)
    return complex(scale), complex(offset)


def measure(folder: Path, footprint_m: float, spacing_m: float, work: Path) -> dict:
    """Cut a map of a set's mosaic, and match its queries."""
    tif, path = work / f"{folder.name}.tif", work / f"{folder.name}.gpkg"
    truth = write_mosaic(folder, laid(folder), tif)
    flags = ("--footprint-m", f"{footprint_m:g}", "--spacing-m", f"{spacing_m:g}", "--json")
    built = run_sets.edgevpr("map", "build", str(path), "--orthophoto", str(tif), *flags)
    matches = run_sets.edgevpr("match", str(path), "--images", str(folder / "query"), "--json")
    right = wrong = 0
    errors_m = []
    known = [match for match in matches if match["query"] in truth and match["position"]]
    for match in known:
        here = truth[match["query"]]
        place, where = match["position"], match["located"]
        right += bool(distance_m(*here, place["lat_deg"], place["lon_deg"]) < footprint_m / 2)
        if match["accepted"]:
            errors_m.append(float(distance_m(*here, where["lat_deg"], where["lon_deg"])))
            wrong += errors_m[-1] > footprint_m / 4
    return {
        "set": folder.name,
        "use": "tune" if folder.name in run_sets.TUNED_ON else "report",
        "footprint_m": footprint_m,
        "spacing_m": spacing_m,
        "places": built["places"],
        "queries": len(known),
        "right": right,
        "accepted": len(errors_m),
        "accepted_wrong": wrong,
        "error": run_sets.spread(errors_m),
    }


def main() -> int:
    data = run_sets.REPOSITORY.parent / "shared" / "data"
    rows = []
    with tempfile.TemporaryDirectory(prefix="edgevpr-orthophoto-") as work:
        for name, footprint_m, spacing_m in CASES:
            (folder,) = run_sets.find_sets(data, [name])
            rows.append(measure(folder, footprint_m, spacing_m, Path(work)))
            print(json.dumps(rows[-1]), flush=True)
    made = run_sets.made_by()
    (run_sets.RESULTS / "from_orthophoto.json").write_text(json.dumps({**made, "sets": rows}, indent=1) + "\n")
    table = [
        [
            row["set"],
            row["use"],
            f"{row['footprint_m']:g} / {row['spacing_m']:g}",
            *(str(row[key]) for key in ("places", "queries", "right", "accepted", "accepted_wrong")),
            f"{row['error']['median_m']} / {row['error']['p90_m']}",
        ]
        for row in rows
    ]
    head = ("set", "use", "footprint / spacing m", "places", "queries", "right", "accepted", "wrong", "fix error m")
    text = __doc__.partition("\n\n")[2].partition("Footprints were")[0].strip()
    (run_sets.RESULTS / "from_orthophoto.md").write_text(
        f"# Maps cut from an orthophoto\n\n{text}\n\nRight: the best place is within half a footprint of the truth. "
        "Wrong: accepted, and the fix is a quarter of a footprint off or more. Errors: median / 90 % of the accepted."
        "\n\n"
        f"{markdown(head, table)}\n\nCommit {made['commit']}, {made['date']}, {made['machine']['cpu']}. Made by "
        "`python benchmarks/from_orthophoto.py`.\n"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
