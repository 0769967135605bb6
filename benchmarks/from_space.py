"""Maps of a picture from space, flown over on another day: `make from-space`.

The map is cut from the raster `before` of sat_marash by `edgevpr map build --orthophoto`, and a simulated camera flies
over `after`, months later and after an earthquake: 96 pictures of half a metre a pixel, from 120 m above the ground,
swaying by 2 degrees, nose anywhere. Each is asked alone, as `edgevpr match` does: with heading and height, as an
autopilot tells them, and without. As a flight they are asked in the order of the grid, its rows to and fro, and nothing
is told: all that is known of place and scale is by the matches before. Maps are cut at five scales, the footprint told
being too small or too large, and of rasters of four resolutions. Foreign: pictures of other ground (all other sites of
the set, both days, and all other sets from the air, each turned by eight angles), told heading and height.

Wrong: accepted, and the fix is off by more than a quarter of the footprint, or the ground is foreign. The constants of
edgevpr were chosen on pictures of this set, too; not on these.
"""

import tempfile
from collections.abc import Iterable, Iterator
from dataclasses import replace
from itertools import chain
from pathlib import Path

import base
import cv2
import numpy as np
import rasterio
import walks
from base import Row

from edgevpr.core.geodesy import distance_m, moved
from edgevpr.core.types import Frame, Position
from edgevpr.frames.images import read_image
from edgevpr.frames.positions import GeoTag
from edgevpr.lab.simulate.camera import Camera, Light
from edgevpr.lab.simulate.rehearsal import poses_of, seen_from
from edgevpr.mapmaking.orthophoto import Orthophoto
from edgevpr.power.boards import load_board
from edgevpr.runtime.recognise.opening import open_recogniser

SET, FOV_DEG, HEIGHT_M = "sat_marash", 66.0, 120.0
FOOTPRINT_M = 2 * HEIGHT_M * float(np.tan(np.radians(FOV_DEG / 2)))
SPACING_M = 40.0
_GRID, _SEED, _TURNS = (12, 8), 7, 8
_SITE = "Hatay_Mimar_Sinan"  # that the rasters show
SCALES, RESOLUTIONS_M = (0.65, 0.8, 1.0, 1.25, 1.5), (0.5, 1.0, 2.0, 4.0)
_NOTHING, _TOLD, _FLOWN = "nothing", "heading, height", "the flight so far"
_STEP_S = 7.0  # from picture to picture, at 15 m/s
_LIGHT = Light(sun_azimuth_deg=0, sun_elevation_deg=90)
_COLUMNS = {
    "pixel m": "{resolution_m:g}",
    "footprint told": "{scale:.2f}",
    "known": "{known}",
    **{name: f"{{{name}}}" for name in ("places", "queries", "right", "accepted", "wrong")},
    "fix error m": "{error[median_m]} / {error[p90_m]}",
}


def coarser(source: Path, path: Path, pixel_m: float) -> Path:
    """Write a raster with larger pixels, each the mean of those that it covers."""
    with rasterio.open(source) as raster:
        by = pixel_m / raster.res[0]
        shape = raster.count, round(raster.height / by), round(raster.width / by)
        bands = raster.read(out_shape=shape, resampling=rasterio.enums.Resampling.average)
        affine = raster.transform * rasterio.Affine.scale(raster.width / shape[2], raster.height / shape[1])
        layout = {"driver": "GTiff", "count": shape[0], "height": shape[1], "width": shape[2], "dtype": "uint8"}
        with rasterio.open(path, "w", crs=raster.crs, transform=affine, photometric="RGB", **layout) as out:
            out.write(bands)
    return path


def flown(raster: Path) -> Iterator[Frame]:
    """Take the pictures of the flight: a frame each, with all that an autopilot tells."""
    photo, rng, camera = Orthophoto(raster), np.random.default_rng(_SEED), Camera(noise_sigma=2.0)
    south, west, north, east = photo.extent_deg
    high_m, wide_m = (float(distance_m(south, west, *at)) for at in ((north, west), (south, east)))
    inside_m = 0.75 * FOOTPRINT_M
    shots = []
    for row in np.linspace(inside_m, high_m - inside_m, _GRID[1]):
        for column in np.linspace(inside_m, wide_m - inside_m, _GRID[0])[:: -1 if len(shots) // _GRID[0] % 2 else 1]:
            at = Position(*moved(south, west, column, row))
            shots.append(GeoTag(position=at, height_m=HEIGHT_M, heading_deg=float(rng.uniform(0, 360))))
    for number, (shot, pose) in enumerate(zip(shots, poses_of(shots, _SEED), strict=True)):
        image = seen_from(photo, shot.position, pose, camera, _LIGHT, rng)
        if image is None:
            raise base.EdgevprError(f"Picture {number} leaves {raster}: choose another grid.")
        yield Frame(
            image=image,
            name=f"{number:03d}",
            t_mono_s=_STEP_S * number,
            position=shot.position,
            height_m=HEIGHT_M,
            **{name: getattr(pose, name) for name in ("heading_deg", "roll_deg", "pitch_deg")},
        )
    photo.close()


def foreign(folder: Path) -> Iterator[Frame]:
    """Give pictures of other ground: of the set's other sites, or of another set."""
    sites = {row["file"]: row["site"] for row in base.read_csv(folder / "sites.csv")} if folder.name == SET else {}
    for path in sorted([*(folder / "ref").iterdir(), *(folder / "query").iterdir()]):
        if sites.get(path.name) == _SITE:
            continue
        image = read_image(path)
        middle = image.shape[1] / 2 - 0.5, image.shape[0] / 2 - 0.5
        for turn in range(_TURNS):
            turn_deg = 360 * turn / _TURNS
            view = cv2.getRotationMatrix2D(middle, turn_deg, 1.25 if turn % 2 else 1.0)
            turned = cv2.warpAffine(image, view, image.shape[1::-1], borderMode=cv2.BORDER_REFLECT)
            yield Frame(image=turned, name=path.name, t_mono_s=0.0, heading_deg=turn_deg, height_m=HEIGHT_M)


def matched(path: Path, frames: Iterable[Frame], known: str) -> Row:
    """Match each picture by what is `known`: nothing, heading and height, or the pictures of the flight before it."""
    is_told, is_flown = known == _TOLD, known == _FLOWN
    config = walks.config(
        map=str(path), **{"source.camera": "nadir"}, **({"source.fov_deg": FOV_DEG} if is_told else {})
    )
    told = ("heading", "height") if is_told else ()
    recogniser = open_recogniser(config, load_board("this"), known=told, narrowed=is_flown, follows=is_flown)
    asked = right = 0
    errors_m = []
    for frame in frames:
        asked += 1
        told = frame if is_told else replace(frame, heading_deg=None, height_m=None, roll_deg=None, pitch_deg=None)
        event = recogniser.step(replace(told, position=None))
        if event.failed:
            raise base.EdgevprError(event.reason)
        if frame.position is None:
            errors_m += [np.inf] * event.accepted
            continue
        here = frame.position.lat_deg, frame.position.lon_deg
        if event.best and (place := event.best.place.position):
            right += float(distance_m(*here, place.lat_deg, place.lon_deg)) < FOOTPRINT_M / 2
        if event.accepted and event.position:
            errors_m.append(float(distance_m(*here, event.position.lat_deg, event.position.lon_deg)))
    recogniser.place_map.close()
    found: Row = {"known": known, "places": len(recogniser.index)}
    found |= {"queries": asked, "right": right, "accepted": len(errors_m)}
    found |= {"wrong": sum(error_m > FOOTPRINT_M / 4 for error_m in errors_m)}
    if errors_m and np.isfinite(errors_m).all():
        found["error"] = {"median_m": round(float(np.median(errors_m)), 1)}
        found["error"]["p90_m"] = round(float(np.quantile(errors_m, 0.9)), 1)
    return found


def measure(folder: Path, work: Path) -> list[Row]:
    frames, rows = list(flown(folder / "raster" / "after.vrt")), []
    for resolution_m, scale in [(pixel_m, 1.0) for pixel_m in RESOLUTIONS_M] + [(0.5, each) for each in SCALES]:
        if any((row["resolution_m"], row["scale"]) == (resolution_m, scale) for row in rows):
            continue
        path = work / f"{resolution_m:g}-{scale:g}.gpkg"
        tif = coarser(folder / "raster" / "before.vrt", work / f"{resolution_m:g}.tif", resolution_m)
        size = ("--footprint-m", f"{scale * FOOTPRINT_M:.1f}", "--spacing-m", f"{SPACING_M:g}")
        base.edgevpr("map", "build", path, "--orthophoto", tif, *size)
        for known in (_NOTHING, _TOLD, _FLOWN):
            rows.append({"resolution_m": resolution_m, "scale": scale} | matched(path, frames, known))
            print(rows[-1], flush=True)
    others = [each for each in base.find_sets(camera="nadir") if each.name != SET]
    for known, folders in (("foreign: other sites", [folder]), ("foreign: other sets", others)):
        found = matched(work / "0.5-1.gpkg", chain.from_iterable(map(foreign, folders)), _TOLD)
        rows.append({"resolution_m": 0.5, "scale": 1.0} | found | {"known": known, "right": "-"})
    return rows


def main() -> None:
    (folder,) = base.find_sets(names=[SET])
    with tempfile.TemporaryDirectory(prefix="edgevpr-space-") as work:
        found = {**base.made_by(), "rows": measure(folder, Path(work))}
    base.write("from_space", found, page(found))


def page(found: Row) -> str:
    return f"""# Maps of a picture from space

{base.told(__doc__)}

Right: the place named first is within half a footprint ({FOOTPRINT_M:.0f} m). Errors: median / 90 % of the accepted.

{base.table(found["rows"], _COLUMNS)}

{base.made_line(found, "make from-space")}
"""


if __name__ == "__main__":
    base.run(main)
