"""The ground of the flights, in the light of two days, and edgevpr's map of it: made once and kept in a folder."""

import csv
import os
import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import rasterio

from edgevpr.core.geodesy import move_position
from edgevpr.lab.simulate.camera import Camera, CameraPose, Light, light_scene, photograph
from edgevpr.lab.simulate.generated import ORIGIN, to_position
from edgevpr.lab.simulate.landscape import make_scene
from edgevpr.places.mapfile import PlaceMap

CHECKOUT = Path(os.environ.get("EDGEVPR_CHECKOUT") or Path(__file__).parents[2]).resolve()  # of the edgevpr that flies
WIDTH_M = 1400.0
DEPTH_M = 1000.0
METRES_PER_PIXEL = 0.2
SEED = 16
GROUND_ALT_M = ORIGIN.alt_m
PICTURE_SPACING_M = 30.0
EDGE_MARGIN_M = 50.0
CAMERAS = {"mapping": Camera(), "later": Camera(noise_sigma=3.0, blur_px=2.0)}
LIGHTS = {
    "mapping": Light(sun_azimuth_deg=52, sun_elevation_deg=50, exposure=1.1),
    "later": Light(
        sun_azimuth_deg=8, sun_elevation_deg=60, warmth=0.7, cloud_frac=0.25, haze_frac=0.1, exposure=1.1, gamma=1.1
    ),
}
FOV_DEG = round(float(np.degrees(2 * np.arctan(Camera().width / 2 / Camera().focal_px))), 2)


def load_ground(work: Path, day: str) -> np.ndarray:
    """Return the ground in the light of a day, uint8 (H, W, 3) BGR, memory-mapped. Makes the files if missing."""
    files = {name: work / f"ground-{name}.npy" for name in LIGHTS}
    if not all(path.exists() for path in files.values()):
        work.mkdir(parents=True, exist_ok=True)
        scene = make_scene(SEED, WIDTH_M, DEPTH_M, METRES_PER_PIXEL)
        for number, (name, path) in enumerate(files.items()):
            unfinished = work / f"unfinished-{name}.npy"
            np.save(unfinished, light_scene(scene, LIGHTS[name], SEED + number))
            unfinished.rename(path)
    return np.load(files[day], mmap_mode="r")


def make_raster_ground(work: Path, mapped: Path, later: Path, height_m: float) -> Path:
    """Return the work folder of a ground made of two satellite rasters of the same place, with pixel sizes in metres:
    `mapped` for the map and `later` for the flight, at `height_m`. They are centred; the ground around is black."""
    folder = work / f"{mapped.stem}-{later.stem}-{height_m:g}m"
    folder.mkdir(parents=True, exist_ok=True)
    for name, path in (("mapping", mapped), ("later", later)):
        if not (folder / f"ground-{name}.npy").exists():
            with rasterio.open(path) as raster:
                height, width = (round(size * raster.res[0] / METRES_PER_PIXEL) for size in raster.shape)
                bands = raster.read((3, 2, 1), out_shape=(3, height, width), resampling=rasterio.enums.Resampling.cubic)
            ground = np.zeros((round(DEPTH_M / METRES_PER_PIXEL), round(WIDTH_M / METRES_PER_PIXEL), 3), np.uint8)
            rows, columns = min(height, len(ground)), min(width, ground.shape[1])
            top, left, skipped = (len(ground) - rows) // 2, (ground.shape[1] - columns) // 2, (width - columns) // 2
            centre = bands.transpose(1, 2, 0)[(height - rows) // 2 :][:rows, skipped : skipped + columns]
            ground[top : top + rows, left : left + columns] = centre
            np.save(folder / f"ground-{name}.npy", ground)
    return folder


def take_picture(ground: np.ndarray, pose: CameraPose, day: str, rng: np.random.Generator) -> bytes:
    """Return a picture from this pose, with the camera and light of a day, as a JPEG."""
    camera = CAMERAS[day]
    # The border is black: mirrored ground could be recognised, rotated by 180 degrees.
    frame = photograph(ground, METRES_PER_PIXEL, pose, camera, LIGHTS[day], rng, cv2.BORDER_CONSTANT)
    return cv2.imencode(".jpg", frame, (cv2.IMWRITE_JPEG_QUALITY, camera.jpeg_quality))[1].tobytes()


def make_environment() -> dict[str, str]:
    """Return an environment in which `python -m edgevpr` runs the code of CHECKOUT with one BLAS thread."""
    return {**os.environ, "PYTHONPATH": str(CHECKOUT), "OPENBLAS_NUM_THREADS": "1"}


def build_place_map(work: Path, height_m: float, mapped_m: float | None = None) -> Path:
    """Return the map of the ground up to `mapped_m` north (None: all of it), built once by `edgevpr map build` from the
    pictures of a mapping flight at `height_m`, taken from a gimbal and tagged with their true positions."""
    suffix = "" if mapped_m is None else f"-{mapped_m:.0f}m"
    path, folder = work / f"ground{suffix}.gpkg", work / f"mapping{suffix}"
    if path.exists():
        return path
    ground = load_ground(work, "mapping")
    (folder / "images").mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(SEED)
    with open(folder / "positions.csv", "w", newline="", encoding="utf-8") as handle:
        table = csv.writer(handle)
        table.writerow(("file", "lat", "lon", "alt", "height_m", "yaw_deg"))
        poses = [pose for pose in _plan_mapping_poses(rng, height_m) if mapped_m is None or pose.north_m <= mapped_m]
        for number, pose in enumerate(poses):
            name, position = f"{number:05d}.jpg", to_position(pose)
            (folder / "images" / name).write_bytes(take_picture(ground, pose, "mapping", rng))
            degrees = (f"{position.lat_deg:.8f}", f"{position.lon_deg:.8f}")
            metres_and_heading = (position.alt_m, pose.height_m, pose.heading_deg % 360)
            table.writerow((name, *degrees, *(f"{value:.2f}" for value in metres_and_heading)))
    unfinished = work / f"unfinished-{os.getpid()}.gpkg"
    unfinished.unlink(missing_ok=True)
    pictures = ("--images", folder / "images", "--positions", folder / "positions.csv", "--camera", "nadir")
    command = ("map", "build", *pictures, "--fov-deg", FOV_DEG, "--technique", "cohog", unfinished)
    command_line = [sys.executable, "-m", "edgevpr", *map(str, command)]
    subprocess.run(command_line, env=make_environment(), check=True, stdout=subprocess.DEVNULL)
    unfinished.rename(path)
    return path


def move_map(place_map: Path, east_m: float, up_m: float) -> Path:
    """Return a copy of a map with all places moved by `east_m` and `up_m`; made once, in the same folder."""
    if not (east_m or up_m):
        return place_map
    path = place_map.with_name(f"{place_map.stem}-{east_m:g}m-east-{up_m:g}m-up.gpkg")
    if not path.exists():
        unfinished = path.with_name(f"{os.getpid()}-{path.name}")
        shutil.copy(place_map, unfinished)
        with PlaceMap.open_for_writing(unfinished) as places, places.transaction():
            for place in list(places.read_places()):
                position = move_position(place.position, east_m, 0.0, place.position.alt_m + up_m)
                places.move_place(place.place_id, position, place.pose)
        unfinished.rename(path)
    return path


def _plan_mapping_poses(rng: np.random.Generator, height_m: float) -> list[CameraPose]:
    """Return poses on legs east and west over all of the ground, a picture every PICTURE_SPACING_M metres."""
    east_m = np.arange(EDGE_MARGIN_M, WIDTH_M - EDGE_MARGIN_M + 1, PICTURE_SPACING_M)
    poses = []
    for leg, north_m in enumerate(np.arange(EDGE_MARGIN_M, DEPTH_M - EDGE_MARGIN_M + 1, PICTURE_SPACING_M)):
        for east in east_m if leg % 2 == 0 else east_m[::-1]:
            planned = (east, north_m, height_m, 90 if leg % 2 == 0 else 270)
            actual = (planned + rng.normal(0, (1.0, 1.0, 0.7, 1.0))).tolist()
            poses.append(CameraPose(**dict(zip(("east_m", "north_m", "height_m", "heading_deg"), actual, strict=True))))
    return poses
