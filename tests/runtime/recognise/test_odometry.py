"""The motion between two frames, by pictures rendered over generated ground, and where there is none to be told."""

import math
from dataclasses import replace

import cv2
import numpy as np
import pytest
from levelled_views import FOOTPRINT_M, draw_ground, take_level_view

from edgevpr.frames.level import UNKNOWN_VIEW
from edgevpr.lab.simulate.camera import CameraPose
from edgevpr.runtime.recognise.landmarks import QUERY_LANDMARKS, detect_landmarks
from edgevpr.runtime.recognise.odometry import VisualOdometry

START = CameraPose(east_m=200.0, north_m=200.0, height_m=100.0, heading_deg=30.0, roll_deg=4.0, pitch_deg=-3.0)


@pytest.fixture(scope="module")
def ground():
    return draw_ground(400.0, 400.0)


def take_view(ground, pose, told=None, scale=1.0):
    """The view from a pose, and its landmarks; `told` and `scale` as in `take_level_view`."""
    picture = take_level_view(ground, pose, told, scale)
    return picture.view, detect_landmarks(picture.image, picture.mask, QUERY_LANDMARKS)


def measure_odometry(first, second, after_s=1.0):
    strides = VisualOdometry()
    assert strides.measure(5.0, *first) is None
    return strides.measure(5.0 + after_s, *second)


def test_the_next_frame_is_due_when_a_tenth_of_the_view_has_moved_on(ground):
    first, second = take_view(ground, START), take_view(ground, replace(START, east_m=215.0))
    elsewhere = take_view(ground, replace(START, east_m=60.0, north_m=330.0))
    odometry, intervals_s = VisualOdometry(), []
    for number, view in enumerate([first, first, second, elsewhere]):
        odometry.measure(5.0 + number, *view)
        intervals_s.append(odometry.interval_s)
    assert intervals_s == pytest.approx([0.5, 2.0, FOOTPRINT_M / 10 / 15.0, 0.5], rel=0.05), "soon after a missed step"


@pytest.mark.parametrize(
    "change",
    [
        {},
        {"east_m": 215.0, "north_m": 190.0},
        {"north_m": 240.0, "heading_deg": 50.0},
        {"east_m": 190.0, "roll_deg": -20.0, "pitch_deg": 5.0},
        {"east_m": 210.0, "height_m": 110.0},
    ],
)
def test_odometry_measures_the_displacement_of_the_aircraft(ground, change):
    second = replace(START, **change)
    found = measure_odometry(take_view(ground, START), take_view(ground, second))
    assert found.moved_m == pytest.approx((second.east_m - START.east_m, second.north_m - START.north_m), abs=0.5)
    assert (found.from_s, found.to_s) == (5.0, 6.0)
    assert found.sd_m < 0.5


def test_odometry_is_scaled_by_a_wrong_height_and_rotated_by_a_wrong_compass(ground):
    second = replace(START, east_m=230.0)
    low, turned = ({"height_m": 90.0}, {"heading_deg": 40.0})
    pair = [take_view(ground, pose, replace(pose, **low)) for pose in (START, second)]
    assert measure_odometry(*pair).moved_m == pytest.approx((27.0, 0.0), abs=0.7)
    scaled = [take_view(ground, pose, replace(pose, **low), 1 / 0.9) for pose in (START, second)]
    for first in (pair[0], scaled[0]):
        assert measure_odometry(first, scaled[1]).moved_m == pytest.approx((27.0, 0.0), abs=0.7), "whatever the scale"
    pair = [take_view(ground, pose, replace(pose, **turned)) for pose in (START, second)]
    east, north = measure_odometry(*pair).moved_m
    assert math.degrees(math.atan2(-north, east)) == pytest.approx(10.0, abs=1.0)


def test_odometry_is_none_if_it_cannot_be_measured(ground):
    first, second = take_view(ground, START), take_view(ground, replace(START, east_m=215.0))
    assert measure_odometry(first, take_view(ground, replace(START, east_m=60.0, north_m=330.0))) is None
    assert measure_odometry(first, second, after_s=40.0) is None
    assert measure_odometry(first, second, after_s=0.0) is None
    assert measure_odometry(first, (UNKNOWN_VIEW, second[1])) is None
    assert measure_odometry(first, (replace(second[0], footprint_m=None), second[1])) is None


def test_odometry_rejects_a_jump_of_the_compass(ground):
    second = replace(START, east_m=215.0)
    turned = take_view(ground, second, replace(second, heading_deg=50.0))
    assert measure_odometry(take_view(ground, START), turned) is None


def test_odometry_measures_a_jump_of_the_reported_height(ground):
    strides = VisualOdometry()
    low = [replace(START, east_m=east_m, height_m=70.0) for east_m in (215.0, 230.0)]
    true = [replace(pose, height_m=100.0) for pose in low]
    strides.measure(5.0, *take_view(ground, START))
    jump = strides.measure(6.0, *take_view(ground, true[0], low[0]))
    after = strides.measure(7.0, *take_view(ground, true[1], low[1]))
    assert jump.moved_m == pytest.approx((15.0, 0.0), abs=0.5), "by the height before"
    assert after.moved_m == pytest.approx((10.5, 0.0), abs=0.5)
    assert jump.log_height == 0.0
    assert after.log_height == pytest.approx(math.log(100 / 70), abs=0.03)


def test_odometry_is_none_over_repetitive_or_featureless_ground():
    tile = cv2.GaussianBlur(np.random.default_rng(2).uniform(0, 255, (40, 40)).astype(np.float32), (0, 0), 2)
    tile = cv2.normalize(tile, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)
    repeated = np.repeat(np.tile(tile, (40, 40))[..., None], 3, 2)
    second = replace(START, east_m=217.0)
    found = measure_odometry(take_view(repeated, START), take_view(repeated, second))
    assert found is None or found.moved_m == pytest.approx((17.0, 0.0), abs=0.5)
    blank = np.full((1600, 1600, 3), 90, np.uint8)
    assert measure_odometry(take_view(blank, START), take_view(blank, second)) is None
