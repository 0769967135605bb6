"""A flight over an orthophoto, as a rehearsal before the real one: pictures, and where they were taken."""

import csv
from collections.abc import Iterator
from dataclasses import dataclass, replace
from datetime import datetime, timedelta, timezone
from pathlib import Path

import cv2
import numpy as np

from edgevpr.core.errors import UsageError
from edgevpr.core.types import Position
from edgevpr.lab.simulate.camera import Camera, Light, Pose, photograph, view_on_ground
from edgevpr.lab.simulate.flight import wander
from edgevpr.lab.simulate.track import Shot
from edgevpr.mapmaking.cuttings import MOST_WITHOUT_DATA
from edgevpr.mapmaking.lattice import extent_words
from edgevpr.mapmaking.orthophoto import Orthophoto

_START_UTC = datetime(2026, 2, 14, 0, 30, tzinfo=timezone.utc)
_FARTHEST = 3.0  # heights from the point below the camera to a corner of its picture: more is nearly the horizon
_COLUMNS = ("file", "lat", "lon", "alt", "roll_deg", "pitch_deg", "yaw_deg", "height_m", "time")


@dataclass(frozen=True, slots=True)
class Weather:
    """Differences of the flight from the orthophoto: the light, and the faults of the camera. The shadows are those of
    the orthophoto."""

    light: Light
    camera: Camera


WEATHERS = {
    "clear": Weather(Light(sun_azimuth_deg=0, sun_elevation_deg=90), Camera()),
    "hazy": Weather(
        Light(sun_azimuth_deg=0, sun_elevation_deg=90, haze_frac=0.15, exposure=1.12, gamma=1.12),
        Camera(noise_sigma=3.0, blur_px=2.0, jpeg_quality=80),
    ),
}


def poses_of(shots: list[Shot], sway_deg: float, seed: int) -> list[Pose]:
    """Return how the camera is held at each picture (0 m east and north: over its position). Where the track does not
    tell roll and pitch, the aircraft sways slowly by up to `sway_deg`, and so does its nose."""
    rng = np.random.default_rng((seed, 4))
    sways = sway_deg * np.stack([wander(rng, len(shots)) for _ in range(3)])
    poses = []
    for shot, (roll_deg, pitch_deg, yaw_deg) in zip(shots, sways.T.tolist(), strict=True):
        is_told = shot.roll_deg is not None or shot.pitch_deg is not None
        poses.append(
            Pose(
                east_m=0.0,
                north_m=0.0,
                height_m=shot.height_m,
                heading_deg=(shot.heading_deg + (0 if is_told else yaw_deg)) % 360,
                roll_deg=(shot.roll_deg or 0.0) if is_told else roll_deg,
                pitch_deg=(shot.pitch_deg or 0.0) if is_told else pitch_deg,
            )
        )
    return poses


def seen_from(
    orthophoto: Orthophoto, at: Position, pose: Pose, camera: Camera, light: Light, rng: np.random.Generator
) -> np.ndarray | None:
    """Take one picture over `at`, uint8 (camera.height, camera.width, 3) BGR; None where a tenth of it or more has no
    ground in the orthophoto. Raises UsageError where it shows the horizon."""
    corners_m = view_on_ground(pose, camera)
    if corners_m is None or (reach_m := float(np.abs(corners_m).max())) > _FARTHEST * pose.height_m:
        raise UsageError(
            f"At roll {pose.roll_deg:.0f} and pitch {pose.pitch_deg:.0f} degrees the picture shows the horizon, and "
            "an orthophoto has none: give smaller angles, or a narrower --fov-deg."
        )
    side_px = int(np.ceil(2 * reach_m * camera.focal_px / pose.height_m)) + 4
    metres_per_pixel = pose.height_m / camera.focal_px
    half_m = side_px * metres_per_pixel / 2
    ground, valid = orthophoto.cut(at, 2 * half_m, side_px)
    view = np.zeros(valid.shape, np.uint8)
    in_pixels = (corners_m * (1, -1) + half_m) / metres_per_pixel - 0.5
    cv2.fillConvexPoly(view, in_pixels.round().astype(np.int32), 1)
    if valid[view > 0].mean() < 1 - MOST_WITHOUT_DATA:
        return None
    over_patch = replace(pose, east_m=half_m, north_m=half_m)
    return photograph(ground, metres_per_pixel, over_patch, camera, light, rng)


def write_rehearsal(
    folder: Path,
    orthophoto: Orthophoto,
    shots: list[Shot],
    weather: Weather,
    fov_deg: float,
    sway_deg: float,
    seed: int,
) -> Iterator[str | None]:
    """Write `folder`/images/*.jpg, and `folder`/positions.csv with the true position and attitude of every picture.

    Yields the name of each picture once it is written, None for one that would show ground beyond the orthophoto.
    Raises OSError where the folder cannot be written.
    """
    camera = replace(weather.camera, focal_px=weather.camera.width / 2 / np.tan(np.radians(fov_deg / 2)))
    rng = np.random.default_rng((seed, 3))
    images = folder / "images"
    images.mkdir(parents=True, exist_ok=True)
    with open(folder / "positions.csv", "w", encoding="utf-8", newline="") as handle:
        table = csv.writer(handle)
        table.writerow(_COLUMNS)
        for number, (shot, pose) in enumerate(zip(shots, poses_of(shots, sway_deg, seed), strict=True)):
            picture = seen_from(orthophoto, shot.position, pose, camera, weather.light, rng)
            if picture is None:
                yield None
                continue
            name, at = f"frame_{number:05d}.jpg", shot.position
            _, jpeg = cv2.imencode(".jpg", picture, (cv2.IMWRITE_JPEG_QUALITY, camera.jpeg_quality))
            (images / name).write_bytes(jpeg.tobytes())
            attitude = (f"{value:.2f}" for value in (pose.roll_deg, pose.pitch_deg, pose.heading_deg, pose.height_m))
            alt = "" if at.alt_m is None else f"{at.alt_m:.2f}"
            taken = _START_UTC + timedelta(seconds=shot.t_s)
            table.writerow((name, f"{at.lat_deg:.8f}", f"{at.lon_deg:.8f}", alt, *attitude, taken.isoformat()))
            yield name


def none_written(orthophoto: Orthophoto, shots: list[Shot]) -> UsageError:
    """Return the error of a track that is nowhere over the orthophoto."""
    lat_deg, lon_deg = zip(*((shot.position.lat_deg, shot.position.lon_deg) for shot in shots), strict=True)
    track = extent_words((min(lat_deg), min(lon_deg), max(lat_deg), max(lon_deg)))
    return UsageError(
        f"No picture of the track shows {orthophoto.path}: the track is at {track}, the orthophoto at "
        f"{extent_words(orthophoto.extent_deg)}, and pictures that leave it are not taken."
    )
