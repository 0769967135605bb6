"""A flight over an orthophoto, as a rehearsal before the real one: pictures, and where they were taken. The track is
read from a positions.csv, or follows the waypoints of a mission. `edgevpr simulate flight` writes it."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from datetime import datetime, timedelta, timezone
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np

from edgevpr.core.arrays import Image
from edgevpr.core.errors import UsageError
from edgevpr.core.geodesy import distance_m, offset_m
from edgevpr.core.types import Position
from edgevpr.frames.positions import number_in, rows_of, tag_of
from edgevpr.lab.simulate.camera import Camera, CameraPose, Light, photograph, view_on_ground
from edgevpr.lab.simulate.generated import picture_table, wander
from edgevpr.mapmaking.cuttings import MOST_WITHOUT_DATA
from edgevpr.mapmaking.lattice import extent_words
from edgevpr.mapmaking.missions import Waypoint, read_area
from edgevpr.mapmaking.orthophoto import Orthophoto

_HEIGHT_M = (1.0, 10_000.0)
_MOST_PICTURES = 100_000
_START_UTC = datetime(2026, 2, 14, 0, 30, tzinfo=timezone.utc)
_FARTHEST = 3.0  # heights from the point below the camera to a corner of its picture: more is nearly the horizon
_COLUMNS = ("file", "lat", "lon", "alt", "roll_deg", "pitch_deg", "yaw_deg", "height_m", "time")


@dataclass(frozen=True, slots=True, kw_only=True)
class PlannedPicture:
    """One picture to be taken: `height_m` over the ground, attitude in degrees as in `CameraPose` (roll and pitch None:
    unknown), and `t_s`, the seconds from the start of the flight."""

    position: Position
    height_m: float
    t_s: float
    heading_deg: float
    roll_deg: float | None = None
    pitch_deg: float | None = None


def read_shots(path: str | Path, height_m: float | None, every_m: float, speed_m_s: float) -> list[PlannedPicture]:
    """Read a track. A positions.csv gives a picture for each line (columns lat and lon, and where present height_m,
    roll_deg, pitch_deg, yaw_deg); a mission file gives one `every_m` along its waypoints. `height_m` overrides the
    heights of the file (None: use them). Raises UsageError for a track that cannot be read, or has no height or no
    picture."""
    if Path(path).suffix.lower() == ".csv":
        planned = _of_lines(path, height_m)
    else:
        planned = _of_mission(path, height_m, every_m)
    if not planned:
        raise UsageError(f"{path} has no line with lat and lon: a track needs them.")
    return _flown(planned, speed_m_s)


def _of_lines(path: str | Path, height_m: float | None) -> list[PlannedPicture]:
    planned = []
    for where, row in rows_of(path):
        tag = tag_of(row, where)
        over_m = height_m or number_in(row, "height_m", *_HEIGHT_M, where)
        if tag.position is None:
            continue
        if over_m is None:
            raise UsageError(f"{where} has no height_m (metres over the ground): add the column, or give --height-m.")
        tilt = {name: number_in(row, name, -60, 60, where) for name in ("roll_deg", "pitch_deg")}
        heading_deg = np.nan if tag.heading_deg is None else tag.heading_deg
        planned.append(PlannedPicture(position=tag.position, height_m=over_m, t_s=0.0, heading_deg=heading_deg, **tilt))
    return planned


def _of_mission(path: str | Path, height_m: float | None, every_m: float) -> list[PlannedPicture]:
    waypoints = [way for part in read_area(path).paths for way in part]
    written_m = [height_m or way.height_m for way in waypoints]
    known_m = next((height for height in written_m if height is not None), None)
    if len(waypoints) < 2 or known_m is None:
        lacks = "no path of waypoints" if len(waypoints) < 2 else "no heights over the ground: give --height-m"
        raise UsageError(f"{path} has {lacks}.")
    heights_m = []
    for height in written_m:  # home and landings: the height of the waypoint before, or of the first that has one
        known_m = known_m if height is None else height
        heights_m.append(known_m)
    lat_deg, lon_deg = (np.array([getattr(way, name) for way in waypoints]) for name in ("lat_deg", "lon_deg"))
    way_m = np.append(0, np.cumsum(distance_m(lat_deg[:-1], lon_deg[:-1], lat_deg[1:], lon_deg[1:])))
    if way_m[-1] / every_m > _MOST_PICTURES:
        raise UsageError(
            f"{path} is {way_m[-1] / 1000:,.0f} km long, and {_MOST_PICTURES:,} pictures are written at most: give a "
            "larger --every-m."
        )
    at_m = np.arange(0, way_m[-1] + 1e-6, every_m)
    columns = (np.interp(at_m, way_m, values) for values in (lat_deg, lon_deg, heights_m))
    legs = np.clip(np.searchsorted(way_m, at_m, side="right") - 1, 0, len(way_m) - 2)
    courses_deg = [_course_deg(one, other) for one, other in pairwise(waypoints)]
    return [
        PlannedPicture(
            position=Position(float(lat), float(lon)), height_m=float(over_m), t_s=0.0, heading_deg=courses_deg[leg]
        )
        for lat, lon, over_m, leg in zip(*columns, legs, strict=True)
    ]


def _flown(planned: list[PlannedPicture], speed_m_s: float) -> list[PlannedPicture]:
    """Give each picture its time, at a constant speed, and the course as its heading where that is NaN (unknown)."""
    flown, t_s, course_deg = [], 0.0, 0.0
    for at, picture in enumerate(planned):
        here, there = (planned[at - 1], picture) if at else (picture, planned[min(1, len(planned) - 1)])
        way_m = _way_m(here.position, there.position)
        if way_m > 0:
            course_deg = _course_deg(here.position, there.position)
        t_s += way_m / speed_m_s if at else 0.0
        heading_deg = course_deg if np.isnan(picture.heading_deg) else picture.heading_deg
        flown.append(replace(picture, t_s=t_s, heading_deg=heading_deg))
    return flown


def _way_m(one: Position, other: Position) -> float:
    return float(distance_m(one.lat_deg, one.lon_deg, other.lat_deg, other.lon_deg))


def _course_deg(one: Position | Waypoint, other: Position | Waypoint) -> float:
    east_m, north_m = offset_m(one.lat_deg, one.lon_deg, other.lat_deg, other.lon_deg)
    return float(np.degrees(np.arctan2(east_m, north_m)) % 360)


@dataclass(frozen=True, slots=True)
class Weather:
    """Light, and faults of the camera, by which the flight's pictures differ from the orthophoto. The shadows stay
    those of the orthophoto."""

    light: Light
    camera: Camera


WEATHERS = {
    "clear": Weather(Light(sun_azimuth_deg=0, sun_elevation_deg=90), Camera()),
    "hazy": Weather(
        Light(sun_azimuth_deg=0, sun_elevation_deg=90, haze_frac=0.15, exposure=1.12, gamma=1.12),
        Camera(noise_sigma=3.0, blur_px=2.0, jpeg_quality=80),
    ),
}


def poses_of(planned: list[PlannedPicture], sway_deg: float, seed: int) -> list[CameraPose]:
    """Return the pose of the camera for each picture, with 0 m east and north. Where the track has neither roll nor
    pitch, they vary slowly by up to `sway_deg`, and so does the heading."""
    rng = np.random.default_rng((seed, 4))
    sways = sway_deg * np.stack([wander(rng, len(planned)) for _ in range(3)])
    poses = []
    for shot, (roll_deg, pitch_deg, yaw_deg) in zip(planned, sways.T.tolist(), strict=True):
        is_told = shot.roll_deg is not None or shot.pitch_deg is not None
        poses.append(
            CameraPose(
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
    orthophoto: Orthophoto, at: Position, pose: CameraPose, camera: Camera, light: Light, rng: np.random.Generator
) -> Image | None:
    """Take one picture over `at`, uint8 (camera.height, camera.width, 3) BGR. Returns None if the orthophoto lacks a
    tenth or more of its ground. Raises UsageError if it shows the horizon."""
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
    planned: list[PlannedPicture],
    weather: Weather,
    fov_deg: float,
    sway_deg: float,
    seed: int,
) -> Iterator[str | None]:
    """Write `folder`/images/*.jpg, and `folder`/positions.csv with the true position and attitude of every picture.

    Yields the name of each picture once it is written, or None for one that would show ground beyond the orthophoto.
    Raises OSError if the folder cannot be written.
    """
    camera = replace(weather.camera, focal_px=weather.camera.width / 2 / np.tan(np.radians(fov_deg / 2)))
    rng = np.random.default_rng((seed, 3))
    with picture_table(folder, _COLUMNS) as write:
        for number, (picture_of, pose) in enumerate(zip(planned, poses_of(planned, sway_deg, seed), strict=True)):
            at = picture_of.position
            picture = seen_from(orthophoto, at, pose, camera, weather.light, rng)
            if picture is None:
                yield None
                continue
            name, alt = f"frame_{number:05d}.jpg", "" if at.alt_m is None else f"{at.alt_m:.2f}"
            attitude = (f"{value:.2f}" for value in (pose.roll_deg, pose.pitch_deg, pose.heading_deg, pose.height_m))
            taken = _START_UTC + timedelta(seconds=picture_of.t_s)
            where = (f"{at.lat_deg:.8f}", f"{at.lon_deg:.8f}", alt)
            write(picture, camera.jpeg_quality, (name, *where, *attitude, taken.isoformat()))
            yield name


def none_written(orthophoto: Orthophoto, planned: list[PlannedPicture]) -> UsageError:
    """Return the error for a track of which no picture lies on the orthophoto."""
    lat_deg, lon_deg = zip(*((shot.position.lat_deg, shot.position.lon_deg) for shot in planned), strict=True)
    track = extent_words((min(lat_deg), min(lon_deg), max(lat_deg), max(lon_deg)))
    return UsageError(
        f"No picture of the track shows {orthophoto.path}: the track is at {track}, the orthophoto at "
        f"{extent_words(orthophoto.extent_deg)}, and pictures that leave it are not taken."
    )
