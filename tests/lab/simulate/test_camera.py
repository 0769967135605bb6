"""Where a point on the ground appears in the picture, and what light may and may not change."""

from dataclasses import replace

import numpy as np
import pytest

from edgevpr.lab.simulate.camera import Camera, CameraPose, Light, ground_to_pixel, lit, photograph
from edgevpr.lab.simulate.landscape import Scene, make_scene

CAMERA = Camera(noise_sigma=0)
NOON = Light(sun_azimuth_deg=180, sun_elevation_deg=60)
F = CAMERA.focal_px
MIDDLE = 319.5, 239.5
MARK_M = (70.0, 90.0)


@pytest.fixture(scope="module")
def marked() -> Scene:
    """Dark ground, 200 m by 160 m, with one white mark of 2 m by 2 m."""
    albedo = np.full((640, 800, 3), 20, np.uint8)
    albedo[276:284, 276:284] = 220  # rows count from the north: (160 - 90) / 0.25 = 280
    return Scene(albedo, np.full((640, 800), 300, np.uint16), 0.25)


def mark_in(frame: np.ndarray) -> np.ndarray:
    """The centre (column, row) of the mark, weighted by brightness."""
    weight = np.clip(frame.max(axis=2).astype(float) - frame.max() / 2, 0, None)
    rows, columns = np.indices(weight.shape)
    return np.array([(columns * weight).sum(), (rows * weight).sum()]) / weight.sum()


@pytest.mark.parametrize(
    ("pose", "column", "row"),
    [
        (CameraPose(east_m=70, north_m=90, height_m=80, heading_deg=0), 0, 0),
        (
            CameraPose(east_m=60, north_m=90, height_m=80, heading_deg=0),
            F * 10 / 80,
            0,
        ),  # the mark is 10 m to the right of a nose that points north
        (
            CameraPose(east_m=70, north_m=80, height_m=80, heading_deg=0),
            0,
            -F * 10 / 80,
        ),  # ... 10 m ahead: up in the picture
        (CameraPose(east_m=60, north_m=90, height_m=80, heading_deg=90), 0, -F * 10 / 80),  # nose east: ahead
        (
            CameraPose(east_m=70, north_m=80, height_m=80, heading_deg=90),
            -F * 10 / 80,
            0,
        ),  # nose east: 10 m to the left
        (
            CameraPose(east_m=70, north_m=80, height_m=40, heading_deg=180),
            0,
            F * 10 / 40,
        ),  # nose south, half as high: twice as far behind
        (
            CameraPose(east_m=70, north_m=90, height_m=80, heading_deg=0, roll_deg=5),
            F * np.tan(np.radians(5)),
            0,
        ),  # right wing down: the camera looks left
        (
            CameraPose(east_m=70, north_m=90, height_m=80, heading_deg=0, pitch_deg=5),
            0,
            F * np.tan(np.radians(5)),
        ),  # nose up: it looks ahead
    ],
)
def test_a_known_point_appears_where_it_must(marked, pose, column, row):
    frame = photograph(lit(marked, NOON, 0), 0.25, pose, CAMERA, NOON, np.random.default_rng(0))
    assert frame.shape == (480, 640, 3)
    assert mark_in(frame) == pytest.approx((MIDDLE[0] + column, MIDDLE[1] + row), abs=0.6)


def test_the_homography_and_the_picture_agree_at_any_pose(marked):
    ground = lit(marked, NOON, 0)
    rng = np.random.default_rng(5)
    for _ in range(10):
        off = rng.uniform(-1, 1, 6)
        pose = CameraPose(
            east_m=70 + 15 * off[0],
            north_m=90 + 12 * off[1],
            height_m=80 + 10 * off[2],
            heading_deg=180 * off[3],
            roll_deg=4 * off[4],
            pitch_deg=4 * off[5],
        )
        expected = ground_to_pixel(pose, CAMERA) @ (*MARK_M, 1)
        frame = photograph(ground, 0.25, pose, CAMERA, NOON, rng)
        assert mark_in(frame) == pytest.approx(expected[:2] / expected[2], abs=0.6)


def test_light_changes_the_picture_and_not_its_geometry(marked):
    pose = CameraPose(east_m=75, north_m=84, height_m=78, heading_deg=30, roll_deg=2, pitch_deg=-1)
    evening = Light(sun_azimuth_deg=300, sun_elevation_deg=20, warmth=1, haze_frac=0.2, exposure=0.9, gamma=1.2)
    centres, frames = [], []
    for light in (NOON, evening):
        frames.append(photograph(lit(marked, light, 0), 0.25, pose, CAMERA, light, np.random.default_rng(0)))
        centres.append(mark_in(frames[-1]))
    assert np.abs(frames[0].astype(int) - frames[1]).mean() > 10
    assert centres[0] == pytest.approx(centres[1], abs=0.2)


def test_every_part_of_the_light_and_the_camera_has_its_effect():
    scene = make_scene(2, 120, 100, metres_per_pixel=0.4)
    pose = CameraPose(east_m=60, north_m=50, height_m=40, heading_deg=0)

    def frame(light: Light, camera: Camera) -> np.ndarray:
        return photograph(lit(scene, light, 1), 0.4, pose, camera, light, np.random.default_rng(0)).astype(int)

    plain = frame(NOON, CAMERA)
    for change in ({"sun_azimuth_deg": 90}, {"sun_elevation_deg": 25}, {"cloud_frac": 0.5}, {"gamma": 1.3}):
        assert np.abs(frame(replace(NOON, **change), CAMERA) - plain).mean() > 1, change
    assert frame(replace(NOON, exposure=1.2), CAMERA).mean() > 1.1 * plain.mean()
    assert frame(replace(NOON, haze_frac=0.4), CAMERA).std() < 0.7 * plain.std()
    red_over_blue = [
        image[..., 2].mean() / image[..., 0].mean() for image in (plain, frame(replace(NOON, warmth=1), CAMERA))
    ]
    assert red_over_blue[1] > 1.1 * red_over_blue[0]
    assert (frame(NOON, replace(CAMERA, noise_sigma=5)) - plain).std() == pytest.approx(5, abs=0.5)


def test_motion_blurs_along_the_flight_only(marked):
    def extent(blur_px: float) -> tuple[int, int]:
        camera = replace(CAMERA, blur_px=blur_px)
        frame = photograph(
            lit(marked, NOON, 0),
            0.25,
            CameraPose(east_m=MARK_M[0], north_m=MARK_M[1], height_m=80, heading_deg=0),
            camera,
            NOON,
            np.random.default_rng(0),
        )
        rows, columns = np.nonzero(frame.max(axis=2) > 40)
        return int(np.ptp(columns)), int(np.ptp(rows))

    (wide, high), (wide_blurred, high_blurred) = extent(0), extent(8)
    assert wide_blurred == wide
    assert high_blurred >= high + 4
