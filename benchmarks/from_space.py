"""Match pictures of another day in maps cut from a satellite image: `make from-space`.

The map is cut from the raster `before` of sat_marash by `edgevpr map build --orthophoto`. A simulated camera flies over
`after`, months later and after an earthquake: 96 pictures of half a metre a pixel, from 120 m above the ground, swaying
by 2 degrees, at any heading. Each is matched alone, as `edgevpr match` does, with heading and height, as an autopilot
reports them, and without. As a flight, they are matched in the order of the grid, its rows to and fro, without heading
and height: place and scale are known only from the previous matches. Maps are cut at five scales, as the given
footprint may be too small or too large, and from rasters of four resolutions; and at three footprints each, 0.62, 0.88
and 1.25 times the given one. Foreign: pictures of other ground (all other sites of the set, on both days, and all other
sets from the air, each rotated to eight angles), with heading and height.

Wrong: accepted, and the fix is off by more than a quarter of the footprint, or the ground is foreign. Constants of
edgevpr were chosen on this set, too, but on these pictures only the three shares and the rule that chooses among them.
"""

import tempfile
from collections.abc import Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path

import base
import cv2
import numpy as np
import rasterio
import walks
from base import Row

from edgevpr.core.geodesy import distance_m, offset_position
from edgevpr.core.types import Frame, Position
from edgevpr.frames.images import read_image
from edgevpr.frames.positions import GeoTag
from edgevpr.lab.simulate.camera import Camera, Light
from edgevpr.lab.simulate.overflight import make_poses, photograph_ground
from edgevpr.mapmaking.orthophoto import Orthophoto
from edgevpr.power.boards import load_board
from edgevpr.runtime.recognise.opening import open_recogniser

SET_NAME = "sat_marash"
FOV_DEG = 66.0
HEIGHT_M = 120.0
FOOTPRINT_M = 2 * HEIGHT_M * float(np.tan(np.radians(FOV_DEG / 2)))
SPACING_M = 40.0
_GRID = (12, 8)  # pictures per row, and rows
_SEED = 7
_FOREIGN_ROTATIONS = 8
_RASTER_SITE = "Hatay_Mimar_Sinan"  # the site that the rasters show
FOOTPRINT_SCALES = (1.0, 0.65, 0.8, 1.25, 1.5)
RESOLUTIONS_M = (0.5, 1.0, 2.0, 4.0)
_FOOTPRINT_SHARES = (0.62, 0.88, 1.25)
_NOTHING_KNOWN = "nothing"
_POSE_KNOWN = "heading, height"
_FLIGHT_KNOWN = "the flight so far"
_PICTURE_INTERVAL_S = 7.0  # from picture to picture, at 15 m/s
_LIGHT = Light(sun_azimuth_deg=0, sun_elevation_deg=90)
_COLUMNS = {
    "raster": "{raster}",
    "given footprint": "{footprint_scale:.2f}",
    "cut at": "{cut_at}",
    "known": "{known}",
    **{name: f"{{{name}}}" for name in ("places", "queries", "right", "accepted", "wrong")},
    f"accepted of {_GRID[0]} per row": "{by_row[least]} to {by_row[most]}",
    "fix error m": "{error[median_m]} / {error[p90_m]}",
}


@dataclass(frozen=True, slots=True)
class MapCut:
    """A map to cut from a `raster`, at `footprint_shares` of the footprint that the user gives: `footprint_scale` times
    that of the camera."""

    raster: Path
    footprint_scale: float
    footprint_shares: tuple[float, ...]


def write_coarser_raster(source: Path, path: Path, pixel_m: float) -> Path:
    """Write a raster with pixels of `pixel_m` metres, each the mean of the pixels that it covers."""
    with rasterio.open(source) as raster:
        factor = pixel_m / raster.res[0]
        shape = raster.count, round(raster.height / factor), round(raster.width / factor)
        bands = raster.read(out_shape=shape, resampling=rasterio.enums.Resampling.average)
        affine = raster.transform * rasterio.Affine.scale(raster.width / shape[2], raster.height / shape[1])
        layout = {"driver": "GTiff", "count": shape[0], "height": shape[1], "width": shape[2], "dtype": "uint8"}
        with rasterio.open(path, "w", crs=raster.crs, transform=affine, photometric="RGB", **layout) as out:
            out.write(bands)
    return path


def render_flight(raster: Path, fov_deg: float = FOV_DEG, tilt_deg: float = 0.0) -> Iterator[Frame]:
    """Yield the frames of the flight, with position, height and attitude. A camera that is tilted forward by `tilt_deg`
    flies farther back, so that it sees the same ground."""
    half = np.tan(np.radians(fov_deg / 2))
    photo, rng, camera = Orthophoto(raster), np.random.default_rng(_SEED), Camera(focal_px=float(320 / half))
    height_m = FOOTPRINT_M / 2 / float(half)
    ahead_m = height_m * np.tan(np.radians(tilt_deg))
    south, west, north, east = photo.extent_deg
    high_m, wide_m = (float(distance_m(south, west, *corner)) for corner in ((north, west), (south, east)))
    inside_m = 0.75 * FOOTPRINT_M
    tags, attitude = [], {"roll_deg": 0.0, "pitch_deg": tilt_deg} if tilt_deg else {}
    for row in np.linspace(inside_m, high_m - inside_m, _GRID[1]):
        for column in np.linspace(inside_m, wide_m - inside_m, _GRID[0])[:: -1 if len(tags) // _GRID[0] % 2 else 1]:
            heading_deg = float(rng.uniform(0, 360))
            back_m = -ahead_m * np.array([np.sin(np.radians(heading_deg)), np.cos(np.radians(heading_deg))])
            camera_position = Position(*offset_position(south, west, column + back_m[0], row + back_m[1]))
            tags.append(GeoTag(position=camera_position, height_m=height_m, heading_deg=heading_deg, **attitude))
    for number, (tag, pose) in enumerate(zip(tags, make_poses(tags, _SEED), strict=True)):
        image = photograph_ground(photo, tag.position, pose, camera, _LIGHT, rng)
        if image is None and tilt_deg:
            continue  # a tilted view can reach beyond the raster
        if image is None:
            raise base.EdgevprError(f"Picture {number} leaves {raster}: choose another grid.")
        yield Frame(
            image=image,
            name=f"{number:03d}",
            t_mono_s=_PICTURE_INTERVAL_S * number,
            position=tag.position,
            height_m=height_m,
            **{name: getattr(pose, name) for name in ("heading_deg", "roll_deg", "pitch_deg")},
        )
    photo.close()


def yield_foreign_frames(folder: Path) -> Iterator[Frame]:
    """Yield rotated pictures of other ground: of the other sites of sat_marash, or of another set."""
    sites = {row["file"]: row["site"] for row in base.read_csv(folder / "sites.csv")} if folder.name == SET_NAME else {}
    for path in sorted([*(folder / "ref").iterdir(), *(folder / "query").iterdir()]):
        if sites.get(path.name) == _RASTER_SITE:
            continue
        image = read_image(path)
        middle = image.shape[1] / 2 - 0.5, image.shape[0] / 2 - 0.5
        for turn in range(_FOREIGN_ROTATIONS):
            turn_deg = 360 * turn / _FOREIGN_ROTATIONS
            view = cv2.getRotationMatrix2D(middle, turn_deg, 1.25 if turn % 2 else 1.0)
            turned = cv2.warpAffine(image, view, image.shape[1::-1], borderMode=cv2.BORDER_REFLECT)
            yield Frame(image=turned, name=path.name, t_mono_s=0.0, heading_deg=turn_deg, height_m=HEIGHT_M)


def match_frames(path: Path, frames: Iterable[Frame], known: str, fov_deg: float = FOV_DEG) -> Row:
    """Match each frame by what is `known`: nothing, heading and height, or the flight so far. Returns the figures."""
    knows_pose, knows_flight = known == _POSE_KNOWN, known == _FLIGHT_KNOWN
    lens, prior = ({"source.fov_deg": fov_deg}, ("heading", "height")) if knows_pose else ({}, ())
    config = walks.make_config(map=str(path), **{"source.camera": "nadir"}, **lens)
    flags = {"uses_hints": knows_flight, "tracks_flight": knows_flight}
    recogniser = open_recogniser(config, load_board("this"), known=prior, **flags)
    right, errors_m, claims_m = 0, [], []
    for frame in frames:
        query = frame if knows_pose else replace(frame, heading_deg=None, height_m=None, roll_deg=None, pitch_deg=None)
        event = recogniser.step(replace(query, position=None))
        if event.failed:
            raise base.EdgevprError(str(event.reason))
        errors_m.append(np.inf if event.accepted else np.nan)
        if frame.position is None:
            continue
        truth = frame.position.lat_deg, frame.position.lon_deg
        if event.best and (place := event.best.place.position):
            right += float(distance_m(*truth, place.lat_deg, place.lon_deg)) < FOOTPRINT_M / 2
        if event.accepted and event.position:
            errors_m[-1] = float(distance_m(*truth, event.position.lat_deg, event.position.lon_deg))
            claims_m.append((errors_m[-1], event.accuracy_m))
    recogniser.place_map.close()
    accepted = ~np.isnan(errors_m)
    result: Row = {"known": known, "places": len(recogniser.index), "queries": len(errors_m), "right": right}
    result |= {"accepted": int(accepted.sum()), "wrong": int(np.sum(np.array(errors_m) > FOOTPRINT_M / 4))}
    result |= judge_claims(claims_m)
    if len(errors_m) == _GRID[0] * _GRID[1]:
        by_row = accepted.reshape(_GRID[::-1]).sum(axis=1)
        result["by_row"] = {"least": int(by_row.min()), "most": int(by_row.max())}
    return result


def judge_claims(claims_m: list[tuple[float, float]]) -> Row:
    """Return the figures of accepted matches, each (error, claimed accuracy) in metres; {} if there are none."""
    if not claims_m:
        return {}
    error_m, claimed_m = np.array(claims_m).T
    within = error_m <= 2 * claimed_m
    return {
        "error": {"median_m": round(float(np.median(error_m)), 1), "p90_m": round(float(np.quantile(error_m, 0.9)), 1)},
        "claim_m": round(float(np.median(claimed_m)), 1),
        "within": round(float(np.mean(within)), 2),
        "too_sure": int(np.sum(~within & (claimed_m < 40))),
    }


def measure_map(cut: MapCut, folder: Path, work: Path, frames: list[Frame]) -> list[Row]:
    """Cut a map and match the frames. In maps of the sharpest raster at the right scale, match foreign pictures too."""
    path = work / f"{cut.raster.stem} {cut.footprint_scale:g} {len(cut.footprint_shares)}.gpkg"
    footprints = ",".join(f"{share * cut.footprint_scale * FOOTPRINT_M:.1f}" for share in cut.footprint_shares)
    size = ("--footprint-m", footprints, "--spacing-m", f"{SPACING_M:g}")
    base.run_edgevpr("map", "build", path, "--orthophoto", cut.raster, *size)
    rows = [match_frames(path, frames, known) for known in (_NOTHING_KNOWN, _POSE_KNOWN, _FLIGHT_KNOWN)]
    if cut.raster.stem == f"{RESOLUTIONS_M[0]:g} m" and cut.footprint_scale == 1:
        others = [other for other in base.find_sets(camera="nadir") if other.name != SET_NAME]
        for known, folders in (("foreign: other sites", [folder]), ("foreign: other sets", others)):
            matched = match_frames(path, chain.from_iterable(map(yield_foreign_frames, folders)), _POSE_KNOWN)
            rows.append(matched | {"known": known, "right": "-"})
    cut_at = ", ".join(f"{share:g}" for share in cut.footprint_shares)
    fields = {"raster": cut.raster.stem, "footprint_scale": cut.footprint_scale, "cut_at": cut_at}
    rows = [fields | row for row in rows]
    print(*rows, sep="\n", flush=True)
    return rows


def measure_maps(folder: Path, work: Path) -> list[Row]:
    """Cut and measure all maps, in parallel."""
    frames, before = list(render_flight(folder / "raster" / "after.vrt")), folder / "raster" / "before.vrt"
    rasters = [write_coarser_raster(before, work / f"{pixel_m:g} m.tif", pixel_m) for pixel_m in RESOLUTIONS_M]
    all_shares = ((1.0,), _FOOTPRINT_SHARES)
    cuts = [MapCut(rasters[0], scale, shares) for shares in all_shares for scale in FOOTPRINT_SCALES]
    cuts += [MapCut(raster, 1.0, (1.0,)) for raster in rasters[1:]]
    with ProcessPoolExecutor() as pool:
        jobs = [pool.submit(measure_map, cut, folder, work, frames) for cut in cuts]
        return [row for job in jobs for row in job.result()]


def main() -> None:
    (folder,) = base.find_sets(names=[SET_NAME])
    with tempfile.TemporaryDirectory(prefix="edgevpr-space-") as work:
        result = {**base.describe_run(), "rows": measure_maps(folder, Path(work))}
    base.write("from_space", result, format_page(result))


def format_page(result: Row) -> str:
    """Return the results as Markdown."""
    return f"""# Maps from a satellite image

{base.strip_title(__doc__)}

Right: the best place is within half a footprint ({FOOTPRINT_M:.0f} m). Errors: median / 90th percentile if accepted.

{base.format_table(result["rows"], _COLUMNS)}

{base.format_origin(result, "make from-space")}
"""


if __name__ == "__main__":
    base.run(main)
