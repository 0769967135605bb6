"""The generated landscape, lit from where the sun is, and where a point of the ground appears in the picture."""

from dataclasses import replace

import numpy as np
import pytest

from edgevpr.lab.simulate.brush import Scene
from edgevpr.lab.simulate.camera import Camera, CameraPose, Light, lit, photograph

CAMERA = Camera(noise_sigma=0)
NOON = Light(sun_azimuth_deg=180, sun_elevation_deg=60)
F = CAMERA.focal_px
MIDDLE = 319.5, 239.5
ABOVE = CameraPose(east_m=70, north_m=90, height_m=80, heading_deg=0)


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
    ("change", "column", "row"),
    [
        ({}, 0, 0),
        ({"east_m": 60}, F * 10 / 80, 0),  # the mark is 10 m to the right of a nose that points north
        ({"north_m": 80}, 0, -F * 10 / 80),  # ... 10 m ahead: up in the picture
        ({"east_m": 60, "heading_deg": 90}, 0, -F * 10 / 80),  # nose east: ahead
        ({"north_m": 80, "heading_deg": 90}, -F * 10 / 80, 0),  # nose east: 10 m to the left
        ({"north_m": 80, "heading_deg": 180, "height_m": 40}, 0, F * 10 / 40),  # half as high: twice as far behind
        ({"roll_deg": 5}, F * np.tan(np.radians(5)), 0),  # right wing down: the camera looks left
        ({"pitch_deg": 5}, 0, F * np.tan(np.radians(5))),  # nose up: it looks ahead
    ],
)
def test_photograph_shows_a_point_where_it_must(marked, change, column, row):
    pose = replace(ABOVE, **change)
    frame = photograph(lit(marked, NOON, 0), 0.25, pose, CAMERA, NOON, np.random.default_rng(0))
    assert frame.shape == (480, 640, 3)
    assert mark_in(frame) == pytest.approx((MIDDLE[0] + column, MIDDLE[1] + row), abs=0.6)
