"""Lenses with distortion: their files, what is refused, and pictures that become those of a camera without it."""

import math
import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from distorted_cameras import SIZE_PX, DistortedCamera, make_fisheye_camera, make_wide_camera

from edgevpr.core.errors import ConfigError, ImageError
from edgevpr.core.types import Frame
from edgevpr.frames.lens import CalibratedLens, compute_lens_view, read_lens
from edgevpr.frames.level import UNKNOWN_VIEW, Lens, level_image, undistort_frame

PINHOLE = 400.0, 410.0, 322.0, 238.0
K = ", ".join(map(str, (PINHOLE[0], 0, PINHOLE[2], 0, PINHOLE[1], PINHOLE[3], 0, 0, 1)))
ROS = f"""\
image_width: 640
image_height: 480
camera_name: narrow
camera_matrix: {{rows: 3, cols: 3, data: [{K}]}}
distortion_model: MODEL
distortion_coefficients: {{rows: 1, cols: NUMBER, data: [COEFFICIENTS]}}
rectification_matrix: {{rows: 3, cols: 3, data: [1, 0, 0, 0, 1, 0, 0, 0, 1]}}
"""
KALIBR = f"""\
cam0:
  cam_overlaps: []
  camera_model: CAMERA
  distortion_coeffs: [COEFFICIENTS]
  distortion_model: MODEL
  intrinsics: [{", ".join(map(str, PINHOLE))}]
  resolution: [640, 480]
  rostopic: /cam0/image_raw
"""


def write_lens(path, text, **given):
    for name, value in given.items():
        text = text.replace(name.upper(), str(value))
    path.write_text(text)
    return str(path)


@pytest.mark.parametrize("name", ["lens.yaml", "lens.xml", "lens.json"])
@pytest.mark.parametrize("camera", [make_wide_camera(), make_fisheye_camera()])
def test_read_lens_of_opencv_in_all_its_forms(tmp_path, name, camera):
    path = camera.write(tmp_path / name)
    path.write_text(path.read_text().replace("%YAML 1.2", "%YAML:1.0"))  # as OpenCV 4 writes it
    lens = read_lens(str(path))
    assert lens.size_px == SIZE_PX
    assert (lens.focal_px[0], *lens.centre_px) == pytest.approx((camera.matrix[0, 0], *camera.matrix[:2, 2]))
    assert lens.coefficients == pytest.approx(tuple(camera.coefficients))
    assert lens.is_fisheye is camera.fisheye


def photograph_board(camera, rng):
    """A picture of a board of 10x7 squares, somewhere and somehow tilted before the camera."""
    squares = np.indices((7, 10)).sum(axis=0) % 2 * 235 + 20
    board = np.pad(np.kron(squares, np.ones((40, 40))), 400, constant_values=255).astype(np.uint8)
    depth, width = board.shape
    away, (east, north) = rng.uniform(6, 14), rng.uniform(-4, 4, 2)
    turned = dict(zip(("roll_deg", "pitch_deg", "heading_deg"), rng.uniform(-25, 25, 3), strict=True))
    at = {"east_m": width / 80 + east, "north_m": depth / 80 + north, "height_m": away}
    return cv2.GaussianBlur(camera.photograph(board, 1 / 40, **at, **turned), (3, 3), 0.7)


@pytest.mark.slow
def test_calibration_script_of_the_docs_recovers_a_known_lens(tmp_path, monkeypatch):
    camera, page = make_wide_camera(), (Path(__file__).parents[2] / "docs/how-to/cameras.md").read_text("utf-8")
    (tmp_path / "board").mkdir()
    rng = np.random.default_rng(0)
    for number in range(40):
        cv2.imwrite(str(tmp_path / f"board/{number}.png"), photograph_board(camera, rng))
    monkeypatch.chdir(tmp_path)
    (script,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    exec(script, {})
    lens = read_lens("lens.yaml")
    assert lens.focal_px == pytest.approx([camera.matrix[0, 0]] * 2, rel=0.002)
    rows, columns = np.mgrid[24:456:8, 32:608:8]
    found_px = lens.project(camera.rays[rows, columns].reshape(-1, 2))
    assert np.linalg.norm(found_px - np.column_stack([columns.ravel(), rows.ravel()]), axis=1).max() < 1.0


@pytest.mark.parametrize(
    ("text", "model", "coefficients"),
    [
        (ROS, "plumb_bob", (-0.2, 0.05, 0.001, -0.001, 0.0)),
        (ROS, "rational_polynomial", (-0.2, 0.05, 0.001, -0.001, 0.0, 0.1, 0.01, 0.0)),
        (ROS, "equidistant", (0.02, -0.01, 0.003, -0.0005)),
        (KALIBR, "radtan", (-0.2, 0.05, 0.001, -0.001)),
        (KALIBR, "equidistant", (0.02, -0.01, 0.003, -0.0005)),
        (KALIBR, "none", ()),
    ],
)
def test_read_lens_of_ros_and_kalibr(tmp_path, text, model, coefficients):
    given = {"camera": "pinhole", "model": model, "number": len(coefficients)}
    lens = read_lens(write_lens(tmp_path / "a.yaml", text, coefficients=", ".join(map(str, coefficients)), **given))
    assert (*lens.focal_px, *lens.centre_px) == PINHOLE
    assert (lens.coefficients, lens.is_fisheye) == (coefficients or (0.0,) * 4, model == "equidistant")


@pytest.mark.parametrize(
    ("text", "given", "says"),
    [
        (KALIBR, {"camera": "omni", "model": "radtan", "coefficients": "0,0,0,0"}, "model `omni`"),
        (KALIBR, {"camera": "pinhole", "model": "fov", "coefficients": "0.9"}, "model `fov`"),
        (KALIBR, {"camera": "pinhole", "model": "radtan", "coefficients": "0,0,0"}, "3 coefficients"),
        (ROS, {"model": "plumb_bob", "number": 5, "coefficients": ".nan,0,0,0,0"}, "not a finite number"),
        (ROS, {"model": "plumb_bob", "number": 5, "coefficients": "-3,0,0,0,0"}, "not invertible"),
        (ROS.replace("400.0", "-400.0"), {"model": "plumb_bob", "number": 4, "coefficients": "0,0,0,0"}, "positive"),
        (ROS.replace("322.0", "3220"), {"model": "plumb_bob", "number": 4, "coefficients": "0,0,0,0"}, "outside"),
        (ROS.replace("400.0", "9e9"), {"model": "plumb_bob", "number": 4, "coefficients": "0,0,0,0"}, "0.0 degrees"),
        (ROS.replace("image_height: 480", ""), {"model": "plumb_bob", "coefficients": "0"}, "lacks `image_height`"),
        ("camera_matrix: [400, 5, 320, 0, 400, 240, 0, 0, 1]\ndistortion_coefficients: [0]", {}, "skew"),
        ("1: 2", {}, "lacks `camera_matrix`"),
        ("camera_matrix: [1, 2]\ndistortion_coefficients: [0]", {}, "2 numbers"),
        ("%YAML:1.0\n---\ncamera_matrix: !!opencv-matrix\n   rows: 3\n", {}, "lacks `data`"),
        ("<?xml version='1.0'?>\n<opencv_storage><a>", {}, "is not valid XML"),
        ("nothing: here", {}, "OpenCV, ROS or Kalibr"),
    ],
)
def test_read_lens_refuses_files_that_are_not_calibrations(tmp_path, text, given, says):
    path = write_lens(tmp_path / "lens.yaml", text, **given)
    with pytest.raises(ConfigError, match=says) as error:
        read_lens(path)
    assert str(error.value).startswith(path)
    with pytest.raises(ConfigError, match=r"absent\.yaml"):
        read_lens(str(tmp_path / "absent.yaml"))


def make_lens(camera):
    (focal_x, _, column), (_, focal_y, row) = camera.matrix[:2]
    return CalibratedLens(
        path="lens.yaml",
        focal_px=(focal_x, focal_y),
        centre_px=(column, row),
        coefficients=tuple(camera.coefficients),
        is_fisheye=camera.fisheye,
        size_px=camera.size_px,
    )


def photograph(camera, ground, **pose):
    pose = {"height_m": 100.0, "heading_deg": 0.0, "roll_deg": 0.0, "pitch_deg": 0.0} | pose
    return Frame(image=camera.photograph(ground, 0.5, east_m=400, north_m=400, **pose), name="it", t_mono_s=0.0, **pose)


def make_pinhole(focal_px, size_px):
    return DistortedCamera(focal_px, (0,) * 4, centre_px=tuple((side - 1) / 2 for side in size_px), size_px=size_px)


def difference(one, other):
    return np.abs(one.astype(float) - other).mean()


CAMERAS = pytest.mark.parametrize("camera", [make_wide_camera(), make_fisheye_camera()], ids=["wide", "fisheye"])


@CAMERAS
def test_undistort_frame_equals_an_image_without_distortion(camera, ground):
    lens, frame = make_lens(camera), photograph(camera, ground)
    found = undistort_frame(frame.image, None, UNKNOWN_VIEW, lens)
    sight = compute_lens_view(lens, SIZE_PX)
    height, width = found.image.shape[:2]
    assert (width, height) == sight.undistorted_px
    assert max(width, height) == max(SIZE_PX)
    other = make_pinhole(max(SIZE_PX) / 2 / math.tan(math.radians(sight.fov_deg / 2)), (width, height))
    truth = photograph(other, ground).image
    shown = np.ones((height, width), bool) if found.mask is None else found.mask
    assert shown.mean() > 0.95
    distorted = cv2.resize(frame.image, (width, height))
    assert difference(found.image[shown], truth[shown]) < 1.5 < difference(distorted, truth) / 3


@CAMERAS
@pytest.mark.parametrize(
    "pose",
    [
        {"heading_deg": 37.0, "roll_deg": 12.0},
        {"roll_deg": -9.0, "pitch_deg": 14.0, "heading_deg": 200.0, "height_m": 80.0},
        {},
    ],
)
def test_level_image_levels_and_undistorts_in_one_warp(camera, ground, pose):
    lens = make_lens(camera)
    footprint_m = 150.0
    found = level_image(
        photograph(camera, ground, **pose),
        None,
        Lens(compute_lens_view(lens, SIZE_PX).fov_deg, 0.0, lens),
        footprint_m,
        below=True,
    )
    assert (found.view.nadir_offset, found.view.footprint_m) == ((0.0, 0.0), pytest.approx(footprint_m))
    side = found.image.shape[0]
    straight = photograph(make_pinhole(side * 100.0 / footprint_m, (side, side)), ground).image
    shown = np.ones((side, side), bool) if found.mask is None else found.mask
    assert shown.mean() > 0.5
    assert difference(found.image[shown], straight[shown]) < 1.5


def test_undistort_frame_moves_the_mask_with_its_image(ground):
    camera = make_wide_camera()
    overlay = np.ones(SIZE_PX[::-1], bool)
    overlay[:, :160] = False
    found = undistort_frame(np.where(overlay, 255, 0).astype(np.uint8), overlay, UNKNOWN_VIEW, make_lens(camera))
    assert found.mask is not None
    assert 0.6 < found.mask.mean() < 0.95
    sure = (found.image < 5) | (found.image > 250)
    assert np.array_equal(found.mask[sure], found.image[sure] > 128)


def test_level_image_masks_what_is_outside_the_lens(ground):
    """With strong barrel distortion alone, directions far outside of the picture have pixels inside of it too."""
    camera = DistortedCamera(512.0, (-0.3, 0, 0, 0))
    lens = make_lens(camera)
    picture = level_image(
        photograph(camera, ground, pitch_deg=30.0),
        None,
        Lens(compute_lens_view(lens, SIZE_PX).fov_deg, 0.0, lens),
        250.0,
    )
    assert picture.mask is not None
    outline = cv2.findContours(picture.mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)[0]
    assert len(outline) == 1


def test_frames_of_another_size_are_scaled_and_of_another_shape_refused(ground):
    camera = make_wide_camera()
    lens, frame = make_lens(camera), photograph(camera, ground)
    small = cv2.resize(frame.image, (320, 240), interpolation=cv2.INTER_AREA)
    half = undistort_frame(small, None, UNKNOWN_VIEW, lens).image
    full = undistort_frame(frame.image, None, UNKNOWN_VIEW, lens).image
    assert difference(half, cv2.resize(full, half.shape[1::-1], interpolation=cv2.INTER_AREA)) < 1
    with pytest.raises(ImageError, match=r"640x360 .*lens\.yaml .* 640x480"):
        undistort_frame(frame.image[60:420], None, UNKNOWN_VIEW, lens)
