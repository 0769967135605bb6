"""Two flights over one generated landscape: the first makes a map; the second comes back later, and leaves the mapped
land."""

import csv
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import datetime, timedelta, timezone
from pathlib import Path

import cv2
import numpy as np

from edgevpr.core.geodesy import EARTH_RADIUS_M
from edgevpr.core.types import Position
from edgevpr.lab.simulate.camera import Camera, Light, Pose, lit, photograph
from edgevpr.lab.simulate.scene import Scene, make_scene

# The south-west corner of every scene: the home of ArduPilot's simulator (its Tools/autotest/locations.txt, CMAC).
ORIGIN = Position(-35.363261, 149.165230, 584.0)
SCENE_WIDTH_M, SCENE_DEPTH_M = 640.0, 420.0  # what the flights below need

_LEG_START_M, _LEG_END_M = 65.0, 345.0  # east; the land east of a leg's end is in no map
_LEGS_NORTH_M = (70.0, 140.0, 210.0, 280.0, 350.0)
_HEIGHT_M = 80.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Flight:
    """A flight with one picture at each pose, every `interval_s` from `start_utc` on; `seed` makes its clouds and its
    sensor's noise."""

    poses: tuple[Pose, ...]
    light: Light
    camera: Camera
    start_utc: datetime
    interval_s: float
    seed: int


def mapping_flight(seed: int) -> Flight:
    """Plan 70 places on five parallel legs, flown to and fro on a clear morning, the nose in the direction of
    flight."""
    rng = np.random.default_rng((seed, 1))
    poses = []
    for leg, north_m in enumerate(_LEGS_NORTH_M):
        east_m = np.linspace(_LEG_START_M, _LEG_END_M, 14)
        for east in east_m if leg % 2 == 0 else east_m[::-1]:
            off_m, off_deg = rng.normal(0, 0.7, 3), rng.normal(0, 0.8, 3)
            heading_deg = (90 if leg % 2 == 0 else 270) + off_deg[0]
            poses.append(
                Pose(
                    east_m=east + off_m[0],
                    north_m=north_m + off_m[1],
                    height_m=_HEIGHT_M + off_m[2],
                    heading_deg=heading_deg,
                    roll_deg=off_deg[1],
                    pitch_deg=off_deg[2],
                )
            )
    light = Light(sun_azimuth_deg=48, sun_elevation_deg=52, exposure=1.12)
    start_utc = datetime(2026, 2, 14, 0, 30, tzinfo=timezone.utc)
    return Flight(poses=tuple(poses), light=light, camera=Camera(), start_utc=start_utc, interval_s=2.0, seed=seed)


def later_flight(seed: int) -> Flight:
    """Plan 40 pictures on an afternoon with clouds and haze: back along the fourth leg, out along the third one and on
    over land that is in no map. The flight drifts up to 8 m beside the legs, 10 % in height, 10 degrees in heading, and
    tilts up to 3 degrees."""
    rng = np.random.default_rng((seed, 2))
    back_m = np.arange(_LEG_END_M - 6, _LEG_START_M, -21.0)
    out_m = np.arange(_LEG_START_M + 8, SCENE_WIDTH_M - 62, 19.0)
    east_m = np.concatenate((back_m, out_m))
    north_m = np.concatenate((np.full(len(back_m), _LEGS_NORTH_M[3]), np.full(len(out_m), _LEGS_NORTH_M[2])))
    heading_deg = np.concatenate((np.full(len(back_m), 270.0), np.full(len(out_m), 90.0)))
    drift = [wander(rng, len(east_m)) for _ in range(5)]
    columns = {
        "east_m": east_m,
        "north_m": north_m + 8 * drift[0],
        "height_m": _HEIGHT_M * (1 + 0.1 * drift[1]),
        "heading_deg": heading_deg + 10 * drift[2],
        "roll_deg": 3 * drift[3],
        "pitch_deg": 3 * drift[4],
    }
    poses = tuple(Pose(**{name: float(column[at]) for name, column in columns.items()}) for at in range(len(east_m)))
    light = Light(
        sun_azimuth_deg=14, sun_elevation_deg=58, warmth=0.8, cloud_frac=0.25, haze_frac=0.1, exposure=1.12, gamma=1.12
    )
    camera = Camera(noise_sigma=3.0, blur_px=2.0, jpeg_quality=80)
    start_utc = datetime(2026, 2, 14, 6, 10, tzinfo=timezone.utc)
    return Flight(poses=poses, light=light, camera=camera, start_utc=start_utc, interval_s=2.0, seed=seed + 1)


def write_flight(folder: str | Path, scene: Scene, flight: Flight) -> Iterator[str]:
    """Write `folder`/images/*.jpg, and `folder`/positions.csv with the true position and attitude of every image.

    Yields the name of every image once it is written. Raises OSError where the folder cannot be written.
    """
    images = Path(folder) / "images"
    images.mkdir(parents=True, exist_ok=True)
    ground = lit(scene, flight.light, flight.seed)
    rng = np.random.default_rng((flight.seed, 3))
    with open(Path(folder) / "positions.csv", "w", encoding="utf-8", newline="") as handle:
        table = csv.writer(handle)
        table.writerow(("file", "lat", "lon", "alt", "rel_alt", "yaw_deg", "roll_deg", "pitch_deg", "time"))
        for number, pose in enumerate(flight.poses):
            name = f"frame_{number:04d}.jpg"
            frame = photograph(ground, scene.metres_per_pixel, pose, flight.camera, flight.light, rng)
            _, jpeg = cv2.imencode(".jpg", frame, (cv2.IMWRITE_JPEG_QUALITY, flight.camera.jpeg_quality))
            (images / name).write_bytes(jpeg.tobytes())
            at = to_position(pose)
            taken = flight.start_utc + timedelta(seconds=number * flight.interval_s)
            where = (f"{at.lat_deg:.8f}", f"{at.lon_deg:.8f}", f"{at.alt_m:.2f}", f"{pose.height_m:.2f}")
            attitude = (f"{pose.heading_deg % 360:.2f}", f"{pose.roll_deg:.2f}", f"{pose.pitch_deg:.2f}")
            table.writerow((name, *where, *attitude, f"{taken:%Y:%m:%d %H:%M:%S}"))
            yield name


def fly_and_write(folder: Path, which: str, seed: int) -> str:
    """Write the "map" or the "query" flight over the landscape of a seed; return a sentence about it."""
    flight = mapping_flight(seed) if which == "map" else later_flight(seed)
    written = list(write_flight(folder, make_scene(seed, SCENE_WIDTH_M, SCENE_DEPTH_M), flight))
    return f"{folder}: {len(written)} images in images/, where they were taken in positions.csv"


def to_position(pose: Pose) -> Position:
    """Return the position of a pose on the globe: the scene is a plane that touches it at ORIGIN."""
    lat_deg = ORIGIN.lat_deg + np.degrees(pose.north_m / EARTH_RADIUS_M)
    lon_deg = ORIGIN.lon_deg + np.degrees(pose.east_m / _radius_of_latitude_m())
    return Position(float(lat_deg), float(lon_deg), ORIGIN.alt_m + pose.height_m)


def to_metres(lat_deg: float, lon_deg: float) -> tuple[float, float]:
    """Return the metres (east, north) of a position in the scene, the inverse of `to_position`."""
    north_m = np.radians(lat_deg - ORIGIN.lat_deg) * EARTH_RADIUS_M
    return float(np.radians(lon_deg - ORIGIN.lon_deg) * _radius_of_latitude_m()), float(north_m)


def _radius_of_latitude_m() -> float:
    return EARTH_RADIUS_M * float(np.cos(np.radians(ORIGIN.lat_deg)))


def wander(rng: np.random.Generator, count: int) -> np.ndarray:
    """Make a slow random swing between -1 and 1, float64 (count,)."""
    t = np.arange(count)[:, None] / 9
    waves = np.sin(2 * np.pi * (t * (1, 2.3) + rng.random(2)))
    return waves @ (0.75, 0.25)
