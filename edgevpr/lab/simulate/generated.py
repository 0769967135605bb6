"""Generates two flights over one generated landscape. The first is for making a map; the second returns hours later and
also leaves the mapped land. `edgevpr simulate flight` writes them, and `demo` flies them."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path

import cv2
import numpy as np

from edgevpr.core.arrays import Doubles, Image
from edgevpr.core.geodesy import offset_m, offset_position
from edgevpr.core.types import Position
from edgevpr.frames.positions import GeoTag, write_positions
from edgevpr.lab.simulate.brush import Scene
from edgevpr.lab.simulate.camera import Camera, CameraPose, Light, light_scene, photograph
from edgevpr.lab.simulate.landscape import make_scene

# The south-west corner of every scene: home of ArduPilot's simulator (CMAC in its Tools/autotest/locations.txt).
_ORIGIN_ALT_M = 584.0
ORIGIN = Position(-35.363261, 149.165230, _ORIGIN_ALT_M)
SCENE_WIDTH_M = 640.0  # large enough for the flights below
SCENE_DEPTH_M = 420.0

_LEG_START_M = 65.0  # east
_LEG_END_M = 345.0  # the land east of this is not mapped
_LEGS_NORTH_M = (70.0, 140.0, 210.0, 280.0, 350.0)
_HEIGHT_M = 80.0


@dataclass(frozen=True, slots=True, kw_only=True)
class GeneratedFlight:
    """A flight with one picture per pose, every `interval_s` seconds from `start_utc`. `seed`: of clouds and noise."""

    poses: tuple[CameraPose, ...]
    light: Light
    camera: Camera
    start_utc: datetime
    seed: int
    interval_s: float = 2.0


def plan_mapping_flight(seed: int) -> GeneratedFlight:
    """Plan 70 pictures on five parallel legs, flown back and forth on a clear morning, nose forward."""
    rng = np.random.default_rng((seed, 1))
    poses = []
    for leg, north_m in enumerate(_LEGS_NORTH_M):
        eastwards = leg % 2 == 0
        for east in np.linspace(_LEG_START_M, _LEG_END_M, 14)[:: 1 if eastwards else -1].tolist():
            dx_m, dy_m, dz_m = rng.normal(0, 0.7, 3).tolist()
            yaw_deg, roll_deg, pitch_deg = rng.normal(0, 0.8, 3).tolist()
            position = {"east_m": east + dx_m, "north_m": north_m + dy_m, "height_m": _HEIGHT_M + dz_m}
            heading_deg = (90 if eastwards else 270) + yaw_deg
            poses.append(CameraPose(**position, heading_deg=heading_deg, roll_deg=roll_deg, pitch_deg=pitch_deg))
    light = Light(sun_azimuth_deg=48, sun_elevation_deg=52, exposure=1.12)
    start_utc = datetime(2026, 2, 14, 0, 30, tzinfo=timezone.utc)
    return GeneratedFlight(poses=tuple(poses), light=light, camera=Camera(), start_utc=start_utc, seed=seed)


def plan_later_flight(seed: int) -> GeneratedFlight:
    """Plan 40 pictures on a cloudy, hazy afternoon: back along the fourth leg, out along the third one, and on over
    land that is not mapped, with slow deviations in position, height, heading and tilt."""
    rng = np.random.default_rng((seed, 2))
    return_m = np.arange(_LEG_END_M - 6, _LEG_START_M, -21.0)
    out_m = np.arange(_LEG_START_M + 8, SCENE_WIDTH_M - 62, 19.0)
    legs = [(east, _LEGS_NORTH_M[3], 270.0) for east in return_m] + [(east, _LEGS_NORTH_M[2], 90.0) for east in out_m]
    drifts = np.stack([make_oscillation(rng, len(legs)) for _ in range(5)], axis=1).tolist()
    poses = tuple(
        CameraPose(
            east_m=float(east_m),
            north_m=north_m + 8 * drift[0],
            height_m=_HEIGHT_M * (1 + 0.1 * drift[1]),
            heading_deg=heading_deg + 10 * drift[2],
            roll_deg=3 * drift[3],
            pitch_deg=3 * drift[4],
        )
        for (east_m, north_m, heading_deg), drift in zip(legs, drifts, strict=True)
    )
    light = Light(
        sun_azimuth_deg=14, sun_elevation_deg=58, warmth=0.8, cloud_frac=0.25, haze_frac=0.1, exposure=1.12, gamma=1.12
    )
    camera = Camera(noise_sigma=3.0, blur_px=2.0, jpeg_quality=80)
    start_utc = datetime(2026, 2, 14, 6, 10, tzinfo=timezone.utc)
    return GeneratedFlight(poses=poses, light=light, camera=camera, start_utc=start_utc, seed=seed + 1)


def write_flight(folder: str | Path, scene: Scene, flight: GeneratedFlight) -> Iterator[str]:
    """Write the pictures of a flight over a scene (see `write_shots`)."""
    ground = light_scene(scene, flight.light, flight.seed)
    rng = np.random.default_rng((flight.seed, 3))

    def take_shots() -> Iterator[tuple[GeoTag, Image]]:
        for number, pose in enumerate(flight.poses):
            tag = GeoTag(
                position=to_position(pose),
                heading_deg=pose.heading_deg % 360,
                t_utc_s=flight.start_utc.timestamp() + number * flight.interval_s,
                roll_deg=pose.roll_deg,
                pitch_deg=pose.pitch_deg,
                height_m=pose.height_m,
            )
            yield tag, photograph(ground, scene.metres_per_pixel, pose, flight.camera, flight.light, rng)

    return write_shots(Path(folder), take_shots(), flight.camera.jpeg_quality)


def write_shots(folder: Path, shots: Iterable[tuple[GeoTag, Image | None]], quality: int) -> Iterator[str]:
    """Write `folder`/images/*.jpg, and finally `folder`/positions.csv with the true position and attitude of each
    image. A shot is a tag and a picture, uint8 (H, W, 3) BGR; shots without a picture are skipped.

    Yields the name of each image once it is written. Raises OSError if the folder cannot be written."""
    (folder / "images").mkdir(parents=True, exist_ok=True)
    written: dict[str, GeoTag] = {}
    for number, (tag, picture) in enumerate(shots):
        if picture is not None:
            name = f"frame_{number:04d}.jpg"
            _, jpeg = cv2.imencode(".jpg", picture, (cv2.IMWRITE_JPEG_QUALITY, quality))
            (folder / "images" / name).write_bytes(jpeg.tobytes())
            written[name] = tag
            yield name
    write_positions(folder / "positions.csv", written)


def write_generated_flight(folder: Path, which: str, seed: int) -> str:
    """Write the flight `which` ("map" or "query") over the landscape from `seed`; return a sentence about it."""
    flight = plan_mapping_flight(seed) if which == "map" else plan_later_flight(seed)
    written = list(write_flight(folder, make_scene(seed, SCENE_WIDTH_M, SCENE_DEPTH_M), flight))
    return f"{folder}: {len(written)} images in images/, their positions in positions.csv"


def to_position(pose: CameraPose) -> Position:
    """Return the geographic position of a pose in the scene, a plane tangent to the Earth at ORIGIN."""
    lat_deg, lon_deg = offset_position(ORIGIN.lat_deg, ORIGIN.lon_deg, pose.east_m, pose.north_m)
    return Position(lat_deg, lon_deg, _ORIGIN_ALT_M + pose.height_m)


def to_metres(lat_deg: float, lon_deg: float) -> tuple[float, float]:
    """Return the east and north coordinates of a position in the scene, in metres: the inverse of `to_position`."""
    east_m, north_m = offset_m(ORIGIN.lat_deg, ORIGIN.lon_deg, lat_deg, lon_deg)
    return float(east_m), float(north_m)


def make_oscillation(rng: np.random.Generator, count: int) -> Doubles:
    """Make a slow random oscillation between -1 and 1, float64 (count,)."""
    t = np.arange(count)[:, None] / 9
    return np.sin(2 * np.pi * (t * (1, 2.3) + rng.random(2))) @ (0.75, 0.25)
