"""Levelling: what a tilted, turned, high or low camera sees becomes what one straight above sees."""

import math
from dataclasses import replace

import numpy as np
import pytest

from edgevpr.core.reasons import ReasonCode
from edgevpr.core.types import Frame, Pose, Vehicle
from edgevpr.frames.level import MAX_TILT_UNLEVELLED_DEG, Lens, Mount, View, estimate_tilted_view, level_image
from edgevpr.lab.simulate.camera import Camera, CameraPose, Light, photograph

CAMERA = Camera(noise_sigma=0)
LENS = Lens(2 * math.degrees(math.atan(320 / CAMERA.focal_px)))
LENS_FOCAL = CAMERA.focal_px / 640
LIGHT = Light(sun_azimuth_deg=0, sun_elevation_deg=60)
HEIGHT_M = 100.0
FOOTPRINT_M = HEIGHT_M * 640 / CAMERA.focal_px
M_PER_PX = 0.5
MIDDLE_M = 800 * M_PER_PX  # of the ground


def photograph_ground(ground, camera=CAMERA, east_m=0.0, north_m=0.0, **pose):
    """The picture of a camera so far from the middle of the ground."""
    pose = {"height_m": HEIGHT_M, "heading_deg": 0.0} | pose
    where = CameraPose(east_m=MIDDLE_M + east_m, north_m=MIDDLE_M + north_m, **pose)
    return photograph(ground, M_PER_PX, where, camera, LIGHT, np.random.default_rng(0))


def make_frame(image, **told):
    return Frame(image=image, name="it", t_mono_s=0.0, **told)


def shoot(ground, **pose):
    """A frame that knows how it was taken."""
    pose = {"height_m": HEIGHT_M, "heading_deg": 0.0, "roll_deg": 0.0, "pitch_deg": 0.0} | pose
    return make_frame(photograph_ground(ground, **pose), **pose)


def photograph_above(ground, view):
    """What a square camera sees from straight above the middle of a levelled picture."""
    right_m, up_m = (share * view.footprint_m for share in view.nadir_offset)
    camera = replace(CAMERA, width=640, height=640)
    return photograph_ground(ground, camera, -right_m, -up_m, height_m=view.footprint_m * CAMERA.focal_px / 640)


def difference(one, other, mask):
    """Mean difference in grey levels where the mask lets look."""
    return np.abs(one.astype(float) - other)[mask].mean()


@pytest.mark.parametrize("below", [False, True])
@pytest.mark.parametrize(
    ("pose", "shown"),
    [
        ({"heading_deg": 37}, 0.6),
        ({"heading_deg": 270}, 0.7),
        ({"roll_deg": 20}, 0.5),
        ({"roll_deg": -15, "pitch_deg": 25, "heading_deg": 200}, 0.3),
        ({"height_m": 60, "pitch_deg": -20, "heading_deg": 120}, 0.25),
        ({"height_m": 180, "pitch_deg": 20, "heading_deg": 300}, 0.6),
        ({"pitch_deg": 60, "heading_deg": 300}, 0.9),  # its upper edge is above 80 degrees
    ],
)
def test_level_image_equals_an_image_taken_straight_down(ground, pose, shown, below):
    found = level_image(shoot(ground, **pose), None, LENS, FOOTPRINT_M, below=below)
    assert (found.view.up_deg, found.view.reason) == (0.0, None)
    assert found.view.footprint_m == pytest.approx(FOOTPRINT_M)
    assert found.image.shape == (640, 640, 3)
    mask = np.ones((640, 640), bool) if found.mask is None else found.mask
    assert mask.mean() > shown
    straight = photograph_above(ground, found.view)
    assert difference(found.image, straight, mask) < 0.5
    assert difference(np.roll(found.image, 8, axis=1), straight, mask) > 2, "one that is 8 pixels off would be noticed"
    is_steep = math.hypot(pose.get("roll_deg", 0.0), pose.get("pitch_deg", 0.0)) > MAX_TILT_UNLEVELLED_DEG
    assert not below or is_steep or found.view.nadir_offset == (0.0, 0.0)


@pytest.mark.parametrize("up_deg", [90.0, 180.0, 270.0])
def test_level_image_accepts_a_rotated_camera(ground, up_deg):
    """A quarter turn of the camera to the right turns its picture by one to the left."""
    square = replace(CAMERA, width=640, height=640)
    pose = {"height_m": HEIGHT_M, "heading_deg": 20.0, "roll_deg": 10.0, "pitch_deg": -5.0}
    image = np.ascontiguousarray(np.rot90(photograph_ground(ground, square, **pose), up_deg / 90))
    one = level_image(make_frame(photograph_ground(ground, square, **pose), **pose), None, LENS, FOOTPRINT_M)
    other = level_image(make_frame(image, **pose), None, Lens(LENS.fov_deg, up_deg), FOOTPRINT_M)
    assert other.view.nadir_offset == pytest.approx(one.view.nadir_offset)
    assert difference(one.image, other.image, one.mask & other.mask) < 0.1
    upright = level_image(make_frame(image, heading_deg=(360 - up_deg) % 360), None, Lens(LENS.fov_deg, up_deg))
    assert (upright.image is image, upright.view.up_deg) == (True, 0.0), "its top points north as it is"


def test_level_image_does_not_rotate_without_a_heading(ground):
    steep, tilted = (replace(shoot(ground, heading_deg=0, pitch_deg=deg), heading_deg=None) for deg in (25, 18))
    assert level_image(steep, None, LENS, below=True).view.reason.code is ReasonCode.TILTED_WITHOUT_HEADING
    for frame in (steep, tilted):
        found = level_image(frame, None, LENS)
        assert found.view.up_deg is None
        assert difference(found.image, photograph_above(ground, found.view), found.mask) < 0.5


def test_level_image_does_not_scale_without_a_height(ground):
    pose = {"heading_deg": 60, "roll_deg": 18}
    unknown = replace(shoot(ground, **pose), height_m=None)
    found, known = level_image(unknown, None, LENS, FOOTPRINT_M / 2), level_image(shoot(ground, **pose), None, LENS)
    assert found.view == replace(known.view, footprint_m=None)
    assert np.array_equal(found.image, known.image)
    assert known.view.footprint_m == pytest.approx(FOOTPRINT_M)


def test_level_image_has_no_nadir_without_an_attitude(ground):
    found = level_image(replace(shoot(ground, heading_deg=90), roll_deg=None), None, LENS, FOOTPRINT_M)
    width_m, focal = pytest.approx(FOOTPRINT_M), pytest.approx(LENS_FOCAL)
    assert found.view == View(up_deg=0.0, footprint_m=width_m, focal=focal, rotation_deg=90.0)
    assert difference(found.image, photograph_above(ground, replace(found.view, nadir_offset=(0, 0))), found.mask) < 0.5


@pytest.mark.parametrize("its", [{}, {"roll_deg": 0.4, "pitch_deg": -0.6}, {"heading_deg": 359.4}, {"height_m": 102.0}])
def test_level_image_returns_the_same_object_if_nothing_is_known_or_needed(its):
    image = np.zeros((48, 64), np.uint8)
    found = level_image(make_frame(image, **its), None, LENS, FOOTPRINT_M)
    assert found.image is image
    assert found.mask is None
    assert (found.view.up_deg, found.view.reason) == (its.get("heading_deg"), None)


def test_level_image_leaves_a_surveyed_image_unchanged(ground):
    pose = Pose(up_deg=30.0, footprint_m=50.0, covariance_m2=(1.0, 0.0, 1.0), is_surveyed=True)
    frame = replace(shoot(ground, heading_deg=90, pitch_deg=20), pose=pose)
    found = level_image(frame, None, LENS, FOOTPRINT_M)
    assert found.image is frame.image
    assert found.view == View(up_deg=30.0, footprint_m=50.0, nadir_offset=(0.0, 0.0))


@pytest.mark.parametrize("height_m", [0.0, -3.0, 10_001.0, math.nan, math.inf, 25.0, 500.0])
def test_level_image_ignores_an_implausible_height(ground, height_m):
    """25 and 500 m can be, and are too far from the map's to be of use."""
    frame = replace(shoot(ground, heading_deg=90), height_m=height_m)
    found, unknown = (level_image(each, None, LENS, FOOTPRINT_M) for each in (frame, replace(frame, height_m=None)))
    assert np.array_equal(found.image, unknown.image)


@pytest.mark.parametrize("wrong", [math.nan, math.inf, -math.inf])
def test_level_image_treats_nan_as_unknown(wrong):
    odd = dict.fromkeys(("roll_deg", "pitch_deg", "heading_deg", "height_m"), wrong)
    found = level_image(make_frame(np.zeros((48, 64), np.uint8), **odd), None, LENS, FOOTPRINT_M)
    assert found.view == View(focal=pytest.approx(LENS_FOCAL))


TILTED = {"heading_deg": 90.0, "roll_deg": 0.0, "pitch_deg": 40.0}


@pytest.mark.parametrize(
    "pose", [{"pitch_deg": 64.0}, {"roll_deg": -65.0}, {"roll_deg": 180.0}, {"pitch_deg": 90.0}, {"roll_deg": 1e9}]
)
def test_level_image_refuses_an_impossible_warp_with_a_reason(pose):
    image = np.zeros((48, 64), np.uint8)
    found = level_image(make_frame(image, **TILTED | pose), None, LENS)
    assert found.image is image
    assert found.view.reason.code is ReasonCode.TILTED
    assert (found.view.footprint_m, found.view.nadir_offset) == (None, None)


@pytest.mark.parametrize("below", [False, True])
def test_level_image_keeps_the_centre_of_a_steep_image(below):
    found = level_image(make_frame(np.zeros((48, 64), np.uint8), **TILTED), None, Lens(40.0), below=below)
    assert found.view.reason is None
    assert found.view.nadir_offset != (0.0, 0.0)


def test_level_image_completes_the_frame_from_the_vehicle(ground):
    pose = {"heading_deg": 50, "roll_deg": 12, "pitch_deg": 8, "height_m": 120}
    known = shoot(ground, **pose)
    vehicle = Vehicle(lat_deg=50.0, lon_deg=8.0, alt_m=300.0, t_received_s=0.0, has_gps=True, **pose)
    wrong = replace(vehicle, heading_deg=0.0, roll_deg=0.0, pitch_deg=0.0, height_m=50.0)
    by_frame = level_image(known, wrong, LENS, FOOTPRINT_M)
    by_vehicle = level_image(make_frame(known.image), vehicle, LENS, FOOTPRINT_M)
    assert by_frame.view == by_vehicle.view
    assert np.array_equal(by_frame.image, by_vehicle.image)


def test_level_image_shrinks_a_large_image_without_skipping_pixels():
    """Rows of one pixel, black and white in turns, become grey; a warp alone would make stripes of them."""
    stripes = np.zeros((3000, 4000), np.uint8)
    stripes[::2] = 200
    found = level_image(make_frame(stripes, heading_deg=180.0), None, LENS)
    assert found.image.shape == (1024, 1024)
    inner = found.image[found.mask][5000:-5000].astype(float)
    assert (inner.mean(), inner.std()) == (pytest.approx(100, abs=1), pytest.approx(0, abs=4))


@pytest.mark.parametrize(
    ("mount", "attitude"), [(Mount(ahead_deg=9.0), {"pitch_deg": 9.0}), (Mount(right_deg=-6.0), {"roll_deg": 6.0})]
)
def test_mount_counts_as_the_attitude_of_a_level_airframe(mount, attitude):
    pose = {"heading_deg": 70.0, "height_m": HEIGHT_M, "roll_deg": 0.0, "pitch_deg": 0.0}
    level, tilted = (make_frame(np.zeros((48, 64), np.uint8), **pose | more) for more in ({}, attitude))
    expected = level_image(tilted, None, LENS, FOOTPRINT_M).view
    assert level_image(level, None, replace(LENS, mount=mount), FOOTPRINT_M).view == expected
    assert estimate_tilted_view(level, None, mount) == estimate_tilted_view(tilted, None)
