"""Levelling: what a tilted, turned, high or low camera sees becomes what one straight above sees."""

import math
from dataclasses import replace

import cv2
import numpy as np
import pytest

from edgevpr.core.types import Frame, Pose, Vehicle
from edgevpr.frames.level import MAX_TILT_UNLEVELLED_DEG, Lens, Mount, View, leaning, levelled
from edgevpr.lab.simulate.camera import Camera, CameraPose, Light, photograph

CAMERA = Camera(noise_sigma=0)
LENS = Lens(2 * math.degrees(math.atan(320 / CAMERA.focal_px)))
LENS_FOCAL = CAMERA.focal_px / 640
LIGHT = Light(sun_azimuth_deg=0, sun_elevation_deg=60)
HEIGHT_M = 100.0
FOOTPRINT_M = HEIGHT_M * 640 / CAMERA.focal_px
M_PER_PX, SIDE_PX = 0.5, 1200
MIDDLE_M = SIDE_PX * M_PER_PX / 2


@pytest.fixture(scope="module")
def ground():
    """Ground without relief, smooth enough that a picture of a picture is hardly another."""
    rng = np.random.default_rng(1)
    octaves = [rng.random((2**octave, 2**octave, 3), dtype=np.float32) / octave for octave in range(3, 8)]
    smooth = sum(cv2.resize(each, (SIDE_PX, SIDE_PX), interpolation=cv2.INTER_CUBIC) for each in octaves)
    return cv2.normalize(smooth, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)


def seen(ground, camera=CAMERA, east_m=0.0, north_m=0.0, **pose):
    """The picture of a camera so far from the middle of the ground."""
    pose = {"height_m": HEIGHT_M, "heading_deg": 0.0} | pose
    where = CameraPose(east_m=MIDDLE_M + east_m, north_m=MIDDLE_M + north_m, **pose)
    return photograph(ground, M_PER_PX, where, camera, LIGHT, np.random.default_rng(0))


def frame_of(image, **told):
    return Frame(image=image, name="it", t_mono_s=0.0, **told)


def taken(ground, **pose):
    """A frame that knows how it was taken."""
    pose = {"height_m": HEIGHT_M, "heading_deg": 0.0, "roll_deg": 0.0, "pitch_deg": 0.0} | pose
    return frame_of(seen(ground, **pose), **pose)


def from_above(ground, view):
    """What a square camera sees from straight above the middle of a levelled picture."""
    right_m, up_m = (share * view.footprint_m for share in view.aside)
    camera = replace(CAMERA, width=640, height=640)
    return seen(ground, camera, -right_m, -up_m, height_m=view.footprint_m * CAMERA.focal_px / 640)


def off(one, other, mask):
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
    ],
)
def test_a_picture_becomes_one_taken_from_straight_above(ground, pose, shown, below):
    found = levelled(taken(ground, **pose), None, LENS, FOOTPRINT_M, below=below)
    assert (found.view.up_deg, found.view.reason) == (0.0, None)
    assert found.view.footprint_m == pytest.approx(FOOTPRINT_M)
    assert found.image.shape == (640, 640, 3)
    mask = np.ones((640, 640), bool) if found.mask is None else found.mask
    assert mask.mean() > shown
    straight = from_above(ground, found.view)
    assert off(found.image, straight, mask) < 0.5
    assert off(np.roll(found.image, 8, axis=1), straight, mask) > 2, "one that is 8 pixels off would be noticed"
    is_steep = math.hypot(pose.get("roll_deg", 0.0), pose.get("pitch_deg", 0.0)) > MAX_TILT_UNLEVELLED_DEG
    assert not below or is_steep or found.view.aside == (0.0, 0.0)


def test_the_point_under_the_camera_is_told(ground):
    """With the nose up and to the east, the camera looks ahead: it hangs west of what it sees."""
    view = levelled(taken(ground, heading_deg=90, pitch_deg=30), None, LENS, FOOTPRINT_M).view
    away = HEIGHT_M * math.tan(math.radians(30)) / FOOTPRINT_M
    assert view.aside == pytest.approx((-away, 0.0), abs=1e-9)
    view = levelled(taken(ground, heading_deg=0, roll_deg=20), None, LENS, FOOTPRINT_M).view  # it looks to the left
    assert view.aside == pytest.approx((HEIGHT_M * math.tan(math.radians(20)) / FOOTPRINT_M, 0.0), abs=1e-9)


@pytest.mark.parametrize("up_deg", [90.0, 180.0, 270.0])
def test_a_camera_that_is_mounted_turned(ground, up_deg):
    """A quarter turn of the camera to the right turns its picture by one to the left."""
    square = replace(CAMERA, width=640, height=640)
    pose = {"height_m": HEIGHT_M, "heading_deg": 20.0, "roll_deg": 10.0, "pitch_deg": -5.0}
    image = np.ascontiguousarray(np.rot90(seen(ground, square, **pose), up_deg / 90))
    one = levelled(frame_of(seen(ground, square, **pose), **pose), None, LENS, FOOTPRINT_M)
    other = levelled(frame_of(image, **pose), None, Lens(LENS.fov_deg, up_deg), FOOTPRINT_M)
    assert other.view.aside == pytest.approx(one.view.aside)
    assert off(one.image, other.image, one.mask & other.mask) < 0.1
    upright = levelled(frame_of(image, heading_deg=(360 - up_deg) % 360), None, Lens(LENS.fov_deg, up_deg))
    assert (upright.image is image, upright.view.up_deg) == (True, 0.0), "its top points north as it is"


def test_without_a_heading_it_is_untilted_and_not_turned(ground):
    tilted = replace(taken(ground, heading_deg=0, pitch_deg=25), heading_deg=None)
    found = levelled(tilted, None, LENS)
    assert found.view.up_deg is None
    assert off(found.image, from_above(ground, found.view), found.mask) < 0.5


def test_without_a_height_it_is_untilted_and_not_scaled(ground):
    pose = {"heading_deg": 60, "roll_deg": 18}
    unknown = replace(taken(ground, **pose), height_m=None)
    found, known = levelled(unknown, None, LENS, FOOTPRINT_M / 2), levelled(taken(ground, **pose), None, LENS)
    assert found.view == replace(known.view, footprint_m=None)
    assert np.array_equal(found.image, known.image)
    assert known.view.footprint_m == pytest.approx(FOOTPRINT_M)


def test_without_an_attitude_it_counts_as_level_and_nothing_is_said_of_the_point_below(ground):
    found = levelled(replace(taken(ground, heading_deg=90), roll_deg=None), None, LENS, FOOTPRINT_M)
    assert found.view == View(
        up_deg=0.0, footprint_m=pytest.approx(FOOTPRINT_M), aside=None, focal=pytest.approx(LENS_FOCAL)
    )
    assert off(found.image, from_above(ground, replace(found.view, aside=(0, 0))), found.mask) < 0.5


@pytest.mark.parametrize(
    "told", [{}, {"roll_deg": 0.4, "pitch_deg": -0.6}, {"heading_deg": 359.4}, {"height_m": 102.0}]
)
def test_where_nothing_is_known_or_needed_the_picture_is_the_same_object(told):
    image = np.zeros((48, 64), np.uint8)
    found = levelled(frame_of(image, **told), None, LENS, FOOTPRINT_M)
    assert found.image is image
    assert found.mask is None
    assert (found.view.up_deg, found.view.reason) == (told.get("heading_deg"), None)


def test_a_surveyed_picture_is_left_as_it_is(ground):
    pose = Pose(up_deg=30.0, footprint_m=50.0, covariance_m2=(1.0, 0.0, 1.0), is_surveyed=True)
    frame = replace(taken(ground, heading_deg=90, pitch_deg=20), pose=pose)
    found = levelled(frame, None, LENS, FOOTPRINT_M)
    assert found.image is frame.image
    assert found.view == View(up_deg=30.0, footprint_m=50.0, aside=(0.0, 0.0))


@pytest.mark.parametrize("height_m", [0.0, -3.0, 10_001.0, math.nan, math.inf, 25.0, 500.0])
def test_a_height_that_cannot_be_scales_nothing(ground, height_m):
    """25 and 500 m can be, and are too far from the map's to be of use."""
    frame = replace(taken(ground, heading_deg=90), height_m=height_m)
    found, unknown = (levelled(each, None, LENS, FOOTPRINT_M) for each in (frame, replace(frame, height_m=None)))
    assert np.array_equal(found.image, unknown.image)


@pytest.mark.parametrize("wrong", [math.nan, math.inf, -math.inf])
def test_what_is_no_number_is_unknown(ground, wrong):
    frame = taken(ground, heading_deg=90)
    odd = replace(frame, roll_deg=wrong, pitch_deg=wrong, heading_deg=wrong, height_m=wrong)
    found = levelled(odd, None, LENS, FOOTPRINT_M)
    assert found.image is frame.image
    assert found.view == View(focal=pytest.approx(LENS_FOCAL))


@pytest.mark.parametrize(
    "pose", [{"pitch_deg": 61.0}, {"roll_deg": -62.0}, {"roll_deg": 180.0}, {"pitch_deg": 90.0}, {"roll_deg": 1e9}]
)
def test_a_tilt_that_a_picture_does_not_bear_leaves_it_with_a_reason(pose):
    image = np.zeros((48, 64), np.uint8)
    found = levelled(frame_of(image, heading_deg=90.0, **{"roll_deg": 0.0, "pitch_deg": 0.0} | pose), None, LENS)
    assert found.image is image
    assert "tilted" in found.view.reason
    assert (found.view.footprint_m, found.view.aside) == (None, None)


def test_a_horizon_in_view_leaves_it_with_a_reason():
    image = np.zeros((48, 64), np.uint8)
    told = {"roll_deg": 40.0, "pitch_deg": 0.0}
    assert levelled(frame_of(image, **told), None, LENS).view.reason is None
    assert "tilted 40 degrees" in levelled(frame_of(image, **told), None, Lens(110.0)).view.reason


def test_levelled_keeps_the_middle_of_a_steep_picture_in_place_of_what_is_below():
    image = np.zeros((48, 64), np.uint8)
    found = levelled(frame_of(image, roll_deg=0.0, pitch_deg=40.0), None, Lens(40.0), below=True)
    assert found.view.reason is None
    assert found.view.aside != (0.0, 0.0)


def test_the_vehicle_tells_what_the_frame_does_not(ground):
    pose = {"heading_deg": 50, "roll_deg": 12, "pitch_deg": 8, "height_m": 120}
    known = taken(ground, **pose)
    vehicle = Vehicle(lat_deg=50.0, lon_deg=8.0, alt_m=300.0, t_heard_s=0.0, has_gps=True, **pose)
    wrong = replace(vehicle, heading_deg=0.0, roll_deg=0.0, pitch_deg=0.0, height_m=50.0)
    by_frame = levelled(known, wrong, LENS, FOOTPRINT_M)
    by_vehicle = levelled(frame_of(known.image), vehicle, LENS, FOOTPRINT_M)
    assert by_frame.view == by_vehicle.view
    assert np.array_equal(by_frame.image, by_vehicle.image)


@pytest.mark.parametrize("below", [False, True])
def test_a_display_stays_masked_where_it_goes(ground, below):
    frame = taken(ground, heading_deg=90, roll_deg=15)
    image = frame.image.copy()
    image[:120, :200] = 255
    overlay = np.ones(image.shape[:2], bool)
    overlay[:122, :202] = False
    found = levelled(replace(frame, image=image), None, LENS, FOOTPRINT_M, overlay=overlay, below=below)
    clean = levelled(frame, None, LENS, FOOTPRINT_M, below=below)
    assert np.array_equal(found.image[found.mask], clean.image[found.mask]), "nothing of it is left"
    assert found.mask.sum() < clean.mask.sum()
    assert not (found.mask & ~clean.mask).any()
    still = levelled(replace(frame, heading_deg=None, roll_deg=0.0), None, LENS, FOOTPRINT_M, overlay=overlay)
    assert still.mask is overlay


def test_a_large_picture_is_made_smaller_without_leaving_pixels_out():
    """Rows of one pixel, black and white in turns, become grey; a warp alone would make stripes of them."""
    stripes = np.zeros((3000, 4000), np.uint8)
    stripes[::2] = 200
    found = levelled(frame_of(stripes, heading_deg=180.0), None, LENS)
    assert found.image.shape == (1024, 1024)
    inner = found.image[found.mask][5000:-5000].astype(float)
    assert (inner.mean(), inner.std()) == (pytest.approx(100, abs=1), pytest.approx(0, abs=4))


@pytest.mark.parametrize("shape", [(16, 16), (16, 400), (400, 16, 3)])
def test_any_shape_is_levelled(shape):
    found = levelled(frame_of(np.zeros(shape, np.uint8), heading_deg=45.0, roll_deg=10.0, pitch_deg=5.0), None, LENS)
    assert found.image.shape[:2] == (max(shape[:2]),) * 2
    assert found.mask.shape == found.image.shape[:2]
    assert found.mask.any()


def turned_by(mount, heading_deg, roll_deg, pitch_deg):
    """Heading, roll and pitch of a camera that is mounted so, of an airframe with this attitude."""
    yaw = math.radians(heading_deg)
    about_down = np.array([[math.cos(yaw), -math.sin(yaw), 0], [math.sin(yaw), math.cos(yaw), 0], [0, 0, 1]])
    body = Mount(pitch_deg, -roll_deg).body_from_straight()
    all_of_it = about_down @ body @ mount.body_from_straight()
    return {
        "heading_deg": math.degrees(math.atan2(all_of_it[1, 0], all_of_it[0, 0])) % 360,
        "roll_deg": math.degrees(math.atan2(all_of_it[2, 1], all_of_it[2, 2])),
        "pitch_deg": math.degrees(-math.asin(all_of_it[2, 0])),
    }


@pytest.mark.parametrize(
    ("mount", "attitude"),
    [
        (Mount(9.0, 0.0), (10.0, 0.0, 0.0)),
        (Mount(0.0, -6.0), (120.0, 0.0, 0.0)),
        (Mount(9.0, 4.0), (200.0, 15.0, -5.0)),
    ],
)
def test_a_camera_that_does_not_look_straight_down_of_the_airframe(ground, mount, attitude):
    """With the mount known, its picture is that of one straight above; without, it is taken to be elsewhere."""
    heading_deg, roll_deg, pitch_deg = attitude
    told = {"height_m": HEIGHT_M, "heading_deg": heading_deg, "roll_deg": roll_deg, "pitch_deg": pitch_deg}
    image = seen(ground, **turned_by(mount, *attitude))
    found = levelled(frame_of(image, **told), None, replace(LENS, mount=mount), FOOTPRINT_M)
    mask = np.ones((640, 640), bool) if found.mask is None else found.mask
    assert off(found.image, from_above(ground, found.view), mask) < 0.5
    blind = levelled(frame_of(image, **told), None, LENS, FOOTPRINT_M)
    mask = np.ones((640, 640), bool) if blind.mask is None else blind.mask
    assert off(blind.image, from_above(ground, blind.view), mask) > 2


def test_a_mount_counts_as_the_attitude_of_a_level_airframe(ground):
    told = {"heading_deg": 70.0, "height_m": HEIGHT_M}
    image = np.zeros((48, 64), np.uint8)
    pitched, rolled = (
        frame_of(image, roll_deg=roll_deg, pitch_deg=pitch_deg, **told)
        for roll_deg, pitch_deg in ((0.0, 9.0), (6.0, 0.0))
    )
    level = frame_of(image, roll_deg=0.0, pitch_deg=0.0, **told)
    for mount, other in ((Mount(ahead_deg=9.0), pitched), (Mount(right_deg=-6.0), rolled)):
        expected = levelled(other, None, LENS, FOOTPRINT_M).view
        assert levelled(level, None, replace(LENS, mount=mount), FOOTPRINT_M).view == expected
        assert leaning(level, None, mount) == leaning(other, None)
