"""The tilt that landmarks show: of rays that are turned by a known angle, and of rendered pictures."""

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from levelled_views import draw_ground, take_level_view
from scipy.spatial.transform import Rotation

from edgevpr.core.contract import Perspective
from edgevpr.frames.level import View
from edgevpr.lab.simulate.camera import CameraPose
from edgevpr.runtime.recognise.agreement import measure_agreement
from edgevpr.runtime.recognise.landmarks import QUERY_LANDMARKS, detect_landmarks
from edgevpr.runtime.recognise.perspective import CommonTilt, convert_to_tilt, fit_attitude_error

FOCAL = 0.77  # shares of the longest side: 66 degrees across
SEEN = View(nadir_offset=(0.0, 0.0), focal=FOCAL, up_deg=0.0)


def make_landmarks(
    count=60, roll_deg=0.0, pitch_deg=0.0, turned_deg=0.0, scale=1.0, noise=0.0, nadir_offset=(0.0, 0.0)
):
    """Points of a query whose camera rolls and pitches more than reported, and of the place seen straight from above:
    the nose is the top of the query, the top of the place north."""
    rng = np.random.default_rng(3)
    right, down = rng.uniform(-0.5, 0.5, count), rng.uniform(-0.37, 0.37, count)
    # Rays through the picture, in the axes nose, right, down of the aircraft, turned to those of a level one.
    rays = np.column_stack([-(down + nadir_offset[1]), right - nadir_offset[0], np.full(count, FOCAL)])
    nose, to_right, below = Rotation.from_euler("YX", (pitch_deg, roll_deg), degrees=True).apply(rays).T
    ground = FOCAL * (to_right - 1j * nose) / below
    known = scale * np.exp(1j * math.radians(turned_deg)) * ground + complex(0.05, -0.03)
    return right + 1j * down, known + noise * (rng.normal(size=count) + 1j * rng.normal(size=count))


@pytest.mark.parametrize(("turned_deg", "scale"), [(0.0, 1.0), (70.0, 1.2), (200.0, 0.8)])
@pytest.mark.parametrize(("roll_deg", "pitch_deg"), [(2.0, 0.0), (0.0, -3.0), (-1.0, 1.5)])
def test_fit_attitude_error_moves_the_nadir_opposite_to_the_tilt(roll_deg, pitch_deg, turned_deg, scale):
    """Right wing down, the middle of the picture is to the left: the aircraft is right of it."""
    asked, known = make_landmarks(roll_deg=roll_deg, pitch_deg=pitch_deg, turned_deg=turned_deg, scale=scale)
    lean = fit_attitude_error(asked, known, SEEN, up_deg=turned_deg)
    along = math.tan(math.radians(roll_deg)) - 1j * math.tan(math.radians(pitch_deg))  # right, ahead
    east_north = along * np.exp(-1j * math.radians(turned_deg))
    assert complex(*lean.nadir_shift) == pytest.approx(east_north, abs=0.004)
    assert lean.sd == pytest.approx(math.tan(math.radians(0.5)), rel=0.2)  # of the place's picture


def test_fit_attitude_error_is_as_accurate_as_it_reports():
    seen = (make_landmarks(roll_deg=2.0, noise=2 / 640, count=count) for count in (30, 60, 120, 240))
    told = [fit_attitude_error(*each, SEEN, 0.0) for each in seen]
    for lean in told:
        assert lean.nadir_shift[0] == pytest.approx(math.tan(math.radians(2.0)), abs=2 * lean.sd)
        assert lean.nadir_shift[1] == pytest.approx(0.0, abs=2 * lean.sd)
    assert all(later.sd < before.sd for before, later in pairwise(told))


def test_fit_attitude_error_accepts_a_nadir_away_from_the_centre():
    nadir_offset = (0.2, -0.1)
    view = View(nadir_offset=nadir_offset, focal=FOCAL)
    lean = fit_attitude_error(*make_landmarks(roll_deg=2.0, nadir_offset=nadir_offset), view, 0.0)
    assert lean.nadir_shift == pytest.approx((math.tan(math.radians(2.0)), 0.0), abs=0.005)


def test_fit_attitude_error_ignores_a_slope_of_the_ground():
    """Seen from 15 m beside the place at 100 m, a slope of ten degrees shears the picture by some 3 %."""
    asked, known = make_landmarks(count=60, noise=2 / 640)
    beside = asked.real > -0.1  # the pictures overlap on one side only
    sheared = (known + 0.03 * asked.conj())[beside]
    lean = fit_attitude_error(asked[beside], sheared, SEEN, 0.0)
    assert math.hypot(*lean.nadir_shift) < 2 * lean.sd < 0.1


@pytest.mark.parametrize("view", [View(), View(nadir_offset=(0.0, 0.0)), View(focal=FOCAL)])
def test_fit_attitude_error_needs_attitude_and_lens(view):
    assert fit_attitude_error(*make_landmarks(roll_deg=2.0), view, 0.0) is None


def test_fit_attitude_error_needs_enough_landmarks_off_a_line():
    asked, known = make_landmarks(count=11)
    assert fit_attitude_error(asked, known, SEEN, 0.0) is None
    line = np.linspace(-0.4, 0.4, 20) + 0j
    lean = fit_attitude_error(line, line, SEEN, 0.0)
    assert lean is None or lean.sd > 1.0


@pytest.fixture(scope="module")
def ground():
    return draw_ground(320.0, 280.0)


@pytest.mark.parametrize(("roll_deg", "pitch_deg", "told_deg"), [(3.0, 0.0, 0.0), (0.0, -3.0, 0.0), (15.0, 2.0, 13.0)])
def test_pictures_show_by_how_much_the_reported_attitude_is_wrong(ground, roll_deg, pitch_deg, told_deg):
    place = take_level_view(ground, CameraPose(east_m=160.0, north_m=140.0, height_m=100.0, heading_deg=0.0))
    attitude = {"heading_deg": 40.0, "roll_deg": roll_deg, "pitch_deg": pitch_deg}
    pose = CameraPose(east_m=168.0, north_m=134.0, height_m=102.0, **attitude)
    query = take_level_view(ground, pose, replace(pose, roll_deg=told_deg, pitch_deg=0.0))
    landmarks = detect_landmarks(query.image, query.mask, QUERY_LANDMARKS)
    found = measure_agreement(landmarks, detect_landmarks(place.image, place.mask))
    lean = fit_attitude_error(*found.inlier_points, query.view, found.rotation_deg)
    # The left wing is up: the camera looks to the left, and the aircraft is right of where it is taken to be.
    right, ahead = (math.tan(math.radians(each)) for each in (roll_deg - told_deg, -pitch_deg))
    east_north = complex(right, ahead) * np.exp(-1j * math.radians(pose.heading_deg))
    assert complex(*lean.nadir_shift) == pytest.approx(east_north, abs=max(0.012, 2 * lean.sd))
    assert lean.sd < 0.03


@pytest.mark.parametrize(("tilt_deg", "is_clear"), [(0.0, False), (20.0, False), (45.0, True), (60.0, True)])
def test_convert_to_tilt_of_a_narrow_lens_goes_by_the_stretch(tilt_deg, is_clear):
    """Without a change of scale across the picture, and turned."""
    stretch = np.diag([1.0, math.cos(math.radians(tilt_deg)), 1.0])
    turn = np.array([[0.6, -0.8, 0.1], [0.8, 0.6, -0.2], [0.0, 0.0, 1.0]])
    tilt = convert_to_tilt(Perspective(turn @ stretch, slope_sd=0.05, regions=100), focal=3.0)
    assert tilt.is_clear == is_clear
    assert tilt.deg == pytest.approx(tilt_deg if is_clear else 0.0, abs=0.1)


def estimate_common_tilt(tilt, slope_of_ground, seed=5, count=6, place_ids=None):
    """Return the common tilt of matches whose camera leans by `tilt` in its own axes (right + down j, a tangent) over
    ground that slopes in a fixed direction; the nose points anywhere, and each perspective is somewhat wrong."""
    rng, common = np.random.default_rng(seed), CommonTilt()
    for number in range(count):
        turned_deg = float(rng.uniform(0, 360))
        slope = (tilt * np.exp(1j * math.radians(turned_deg)) + slope_of_ground) / FOCAL
        slope += 0.1 * complex(*rng.normal(size=2))
        over_place = np.eye(3)
        over_place[2, :2] = slope.real, slope.imag
        view = replace(SEEN, rotation_deg=turned_deg)
        common.add(Perspective(over_place, slope_sd=0.15, regions=40), view, (place_ids or range(count))[number])
    return common


def test_common_tilt_is_that_of_the_camera(caplog):
    found = estimate_common_tilt(0.3 - 0.2j, 0)
    assert found.probability > 0.95
    assert found.mean.deg == pytest.approx(math.degrees(math.atan(math.hypot(0.3, 0.2))), abs=5)
    assert found.sd == pytest.approx(math.hypot(0.3, 0.2), abs=0.1)
    assert caplog.text.count("set source.mount_ahead_deg") == 1


@pytest.mark.parametrize("slope_of_ground", [0, 0.1])
def test_common_tilt_of_a_level_camera_is_not_claimed(slope_of_ground, caplog):
    assert max(estimate_common_tilt(0, slope_of_ground, seed, 12).sd for seed in range(20)) < math.tan(math.radians(4))
    assert not caplog.text


@pytest.mark.parametrize("tilt_deg", [8, 12, 20, 30])
@pytest.mark.parametrize("count", [3, 12])
def test_common_tilt_claims_what_it_cannot_exclude(tilt_deg, count):
    tilt = math.tan(math.radians(tilt_deg))
    found = [estimate_common_tilt(tilt, 0, seed, count) for seed in range(40)]
    assert np.mean([tilt <= 2 * common.sd for common in found]) >= 0.8


def test_common_tilt_counts_a_place_once():
    assert estimate_common_tilt(0.15, 0, place_ids=[7] * 6).mean == estimate_common_tilt(0.15, 0, count=1).mean
    assert CommonTilt().sd > 0


@pytest.mark.parametrize("focal", [None, 0.8])
def test_common_tilt_is_learnt_with_and_without_a_lens(focal):
    common = CommonTilt()
    for place_id in range(12):
        common.add(Perspective(np.eye(3), slope_sd=0.1, regions=40), replace(SEEN, focal=focal), place_id)
    assert common.sd < CommonTilt().sd / 4
