"""Simulates a flight over an orthophoto: its pictures and their positions. The track is read from a positions.csv, or
follows the waypoints of a mission. `edgevpr simulate flight` writes it."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from edgevpr.core.arrays import Image
from edgevpr.core.errors import UsageError
from edgevpr.core.geodesy import distance_m, offset_m
from edgevpr.core.types import Position
from edgevpr.frames.positions import GeoTag, read_positions
from edgevpr.lab.simulate.camera import Camera, CameraPose, Light, photograph, project_view
from edgevpr.lab.simulate.generated import make_oscillation, write_shots
from edgevpr.mapmaking.missions import read_area
from edgevpr.mapmaking.orthophoto import Orthophoto
from edgevpr.mapmaking.orthophoto_source import MAX_WITHOUT_DATA

SPEED_M_S = 10.0
_SWAY_DEG = 2.0  # largest roll, pitch and yaw deviation on a track without attitude
_START_UTC_S = 1_771_029_000.0
_LIGHT = Light(sun_azimuth_deg=0, sun_elevation_deg=90)  # adds no shadows to those of the orthophoto
_MAX_CORNER_HEIGHTS = 3.0  # largest distance of a picture corner on the ground, in heights; the horizon is beyond


def read_shots(path: str | Path, height_m: float | None, every_m: float) -> list[GeoTag]:
    """Read a track and return the pictures to take along it: one for each row of a positions.csv with a position, or
    one every `every_m` metres along the waypoints of a mission file. Each picture gets a height above ground
    (`height_m`, or that of the track if it is None), a heading and a time. Raises UsageError if the track cannot be
    read, or has no height or no picture."""
    if Path(path).suffix.lower() == ".csv":
        shots = [tag for tag in read_positions(path).values() if tag.position]
    else:
        shots = _plan_mission_shots(path, every_m)
    if not shots:
        raise UsageError(f"{path} contains no track: it needs waypoints, or rows with lat and lon.")
    points_deg = [(shot.position.lat_deg, shot.position.lon_deg) for shot in shots if shot.position]
    timed_shots, t_s, course_deg = [], _START_UTC_S, 0.0
    for number, shot in enumerate(shots):
        shot_height_m = height_m or shot.height_m
        if not (shot_height_m and shot_height_m > 0):
            raise UsageError(f"{path} lacks heights above ground (height_m > 0): pass --height-m.")
        # The first picture has the course from its own position to the second one.
        start, end = points_deg[max(0, number - 1)], points_deg[number or min(1, len(points_deg) - 1)]
        if (step_m := float(distance_m(*start, *end))) > 0:
            east_m, north_m = offset_m(*start, *end)
            course_deg = float(np.degrees(np.arctan2(east_m, north_m)) % 360)
        t_s += step_m / SPEED_M_S if number else 0.0
        heading_deg = course_deg if shot.heading_deg is None else shot.heading_deg
        timed_shots.append(replace(shot, height_m=shot_height_m, heading_deg=heading_deg, t_utc_s=t_s))
    return timed_shots


def _plan_mission_shots(path: str | Path, every_m: float) -> list[GeoTag]:
    waypoints = read_area(path).path
    if len(waypoints) < 2:
        return []
    lat_deg, lon_deg = (np.array([getattr(wp, name) for wp in waypoints]) for name in ("lat_deg", "lon_deg"))
    track_m = np.append(0, np.cumsum(distance_m(lat_deg[:-1], lon_deg[:-1], lat_deg[1:], lon_deg[1:])))
    shot_m = np.arange(0, track_m[-1] + 1e-6, every_m)  # along the track
    waypoint_m = np.array([wp.height_m for wp in waypoints], float)  # heights; NaN for home and landings
    valid = np.isfinite(waypoint_m)
    heights_m = np.interp(shot_m, track_m[valid], waypoint_m[valid]).tolist() if valid.any() else [None] * len(shot_m)
    places = zip(*(np.interp(shot_m, track_m, degrees).tolist() for degrees in (lat_deg, lon_deg)), strict=True)
    return [GeoTag(position=Position(*place), height_m=height) for place, height in zip(places, heights_m, strict=True)]


def make_poses(shots: list[GeoTag], seed: int) -> list[CameraPose]:
    """Return the camera pose of each picture, at 0 m east and north. If the track has neither roll nor pitch, both vary
    slowly by up to 2 degrees, and so does the heading."""
    rng = np.random.default_rng((seed, 4))
    sways = _SWAY_DEG * np.stack([make_oscillation(rng, len(shots)) for _ in range(3)])
    poses = []
    for shot, sway in zip(shots, sways.T.tolist(), strict=True):
        has_attitude = shot.roll_deg is not None or shot.pitch_deg is not None
        roll_deg, pitch_deg, yaw_deg = (shot.roll_deg or 0.0, shot.pitch_deg or 0.0, 0.0) if has_attitude else sway
        heading_deg = ((shot.heading_deg or 0.0) + yaw_deg) % 360
        height_m = shot.height_m or 0.0
        poses.append(CameraPose(height_m=height_m, heading_deg=heading_deg, roll_deg=roll_deg, pitch_deg=pitch_deg))
    return poses


def photograph_ground(
    orthophoto: Orthophoto, position: Position, pose: CameraPose, camera: Camera, light: Light, rng: np.random.Generator
) -> Image | None:
    """Take one picture above `position`, uint8 (camera.height, camera.width, 3) BGR; None if the orthophoto lacks more
    than a tenth of the ground in the picture. Raises UsageError if the picture shows the horizon."""
    corners_m = project_view(pose, camera)
    if corners_m is None or (reach_m := float(np.abs(corners_m).max())) > _MAX_CORNER_HEIGHTS * pose.height_m:
        raise UsageError(
            f"At roll {pose.roll_deg:.0f} and pitch {pose.pitch_deg:.0f} degrees the picture shows the horizon, which "
            "an orthophoto does not contain: use smaller angles, or pass a smaller --fov-deg."
        )
    side_px = int(np.ceil(2 * reach_m * camera.focal_px / pose.height_m)) + 4
    metres_per_pixel = pose.height_m / camera.focal_px
    half_m = side_px * metres_per_pixel / 2
    ground, valid = orthophoto.cut(position, 2 * half_m, side_px)
    view = np.zeros(valid.shape, np.uint8)
    corners_px = (corners_m * (1, -1) + half_m) / metres_per_pixel - 0.5
    cv2.fillConvexPoly(view, corners_px.round().astype(np.int32), 1)
    if valid[view > 0].mean() < 1 - MAX_WITHOUT_DATA:
        return None
    return photograph(ground, metres_per_pixel, replace(pose, east_m=half_m, north_m=half_m), camera, light, rng)


def write_overflight(
    folder: Path, orthophoto: Orthophoto, shots: list[GeoTag], fov_deg: float, seed: int
) -> Iterator[str]:
    """Write the pictures with `write_shots`, skipping those that would show ground beyond the orthophoto."""
    camera = Camera()
    camera = replace(camera, focal_px=float(camera.width / 2 / np.tan(np.radians(fov_deg / 2))))
    rng = np.random.default_rng((seed, 3))

    def take_shots() -> Iterator[tuple[GeoTag, Image | None]]:
        for shot, pose in zip(shots, make_poses(shots, seed), strict=True):
            picture = photograph_ground(orthophoto, shot.position, pose, camera, _LIGHT, rng) if shot.position else None
            tag = replace(shot, heading_deg=pose.heading_deg, roll_deg=pose.roll_deg, pitch_deg=pose.pitch_deg)
            yield tag, picture

    return write_shots(folder, take_shots(), camera.jpeg_quality)
