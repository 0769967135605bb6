"""The tilt of a camera, by the motion from image to image."""

import cv2
import numpy as np
import pytest

from edgevpr.core.errors import UsageError
from edgevpr.frames.level import Lens
from edgevpr.lab.simulate.camera import Camera, CameraPose, Light, photograph
from edgevpr.mapmaking.advice import require_level_camera
from edgevpr.mapmaking.pictures import FlightPictures
from edgevpr.mapmaking.tilt import MAX_UNKNOWN_TILT_DEG, MIN_PAIRS, measure_tilt

CAMERA = Camera(width=320, height=240, focal_px=246.5, noise_sigma=0)
LENS = Lens(66.0)
LIGHT = Light(sun_azimuth_deg=0, sun_elevation_deg=90)


@pytest.fixture(scope="module")
def ground():
    rng = np.random.default_rng(1)
    coarse = rng.integers(60, 200, (120, 120, 3), np.uint8)
    return np.kron(coarse, np.ones((8, 8, 1), np.uint8)) + rng.integers(0, 50, (960, 960, 3), np.uint8)


def fly(ground, pitch_deg, count=24):
    rng = np.random.default_rng(2)
    for number in range(count):
        drift_deg = rng.normal(0, 1, 2).tolist()
        north_m = 20 + 6 * number
        attitude = {"heading_deg": 5 * drift_deg[0], "pitch_deg": pitch_deg + drift_deg[1]}
        pose = CameraPose(east_m=120, north_m=north_m, height_m=50, **attitude)
        yield photograph(ground, 0.25, pose, CAMERA, LIGHT, rng)


@pytest.mark.parametrize("pitch_deg", [30, 45])
def test_measure_tilt_finds_a_camera_that_faces_ahead(ground, pitch_deg):
    tilt = measure_tilt(fly(ground, pitch_deg))
    assert tilt.pairs >= MIN_PAIRS
    assert MAX_UNKNOWN_TILT_DEG < tilt.deg < pitch_deg + 8


def test_measure_tilt_is_zero_for_a_camera_that_faces_straight_down(ground):
    tilt = measure_tilt(fly(ground, 0))
    assert tilt is None or tilt.deg < 8


def test_require_level_refuses_a_tilted_camera_whose_angles_are_not_recorded(ground, tmp_path):
    for number, image in enumerate(fly(ground, 45)):
        cv2.imwrite(str(tmp_path / f"{number:02}.png"), image)
    pictures = FlightPictures(source=str(tmp_path))
    with pytest.raises(UsageError, match=r" \d\d degrees .*--fov-deg"):
        require_level_camera(pictures, None)


@pytest.mark.parametrize(("told_deg", "lens"), [(0, None), (0, LENS), (-45, LENS)], ids=["level", "lens", "sign"])
def test_require_level_refuses_a_camera_that_is_tilted_otherwise_than_recorded(ground, tmp_path, told_deg, lens):
    lines = ["file,lat,lon,roll_deg,pitch_deg"]
    for number, image in enumerate(fly(ground, 45)):
        cv2.imwrite(str(tmp_path / f"{number:02}.png"), image)
        lines.append(f"{number:02}.png,50,8,0,{told_deg}")
    pictures = FlightPictures(source=str(tmp_path))
    (tmp_path / "positions.csv").write_text("\n".join(lines))
    with pytest.raises(UsageError, match=r"from the direction given by roll_deg .*gimbal"):
        require_level_camera(pictures, lens)
    (tmp_path / "positions.csv").write_text("\n".join(lines).replace(f"0,{told_deg}", "0,45"))
    require_level_camera(pictures, LENS)


def test_measure_tilt_is_unknown_without_overlap():
    assert measure_tilt(np.random.default_rng(3).integers(0, 255, (20, 240, 320), np.uint8)) is None
