"""The height above ground from step to step, by pictures rendered over generated ground that falls away or rises."""

import math
from dataclasses import replace

import numpy as np
import pytest
from levelled_views import FOOTPRINT_M, draw_ground, take_level_view

from edgevpr.lab.simulate.camera import CameraPose
from edgevpr.runtime.recognise.landmarks import QUERY_LANDMARKS, detect_landmarks
from edgevpr.runtime.recognise.odometry import VisualOdometry
from edgevpr.runtime.recognise.parallax import ImageMotion, ParallaxChain

HEIGHT_M = 100.0
EDGE_M = 210.0  # east, of the cliff
START = CameraPose(east_m=110.0, north_m=200.0, height_m=HEIGHT_M, heading_deg=0.0, roll_deg=0.0, pitch_deg=0.0)


@pytest.fixture(scope="module")
def ground():
    return draw_ground(440.0, 400.0)


def take_picture(ground, pose, told, terraces):
    """The levelled picture of ground in `terraces`, from west to east: the edge where each begins, and by what the
    height above it is multiplied. A terrace begins where the one before would be seen beyond the edge."""
    picture = take_level_view(ground, pose, told)
    image = picture.image.copy()
    middle, factor = (image.shape[1] - 1) / 2, 1.0
    for edge_m, next_factor in terraces:
        first = middle + (edge_m - pose.east_m) / (pose.height_m * factor / HEIGHT_M) / FOOTPRINT_M * image.shape[1]
        factor, lower = next_factor, replace(pose, height_m=pose.height_m * next_factor)
        beyond = np.arange(image.shape[1]) >= first
        image[:, beyond] = take_level_view(ground, lower, told).image[:, beyond]
    return picture.view, detect_landmarks(image, picture.mask, QUERY_LANDMARKS)


def fly(ground, step_m, terraces, climb=lambda east_m: 1.0, lean_deg=0.0, way_m=220):
    """Fly east over the terraces; `climb` multiplies the height, and the camera leans by more than is told. Return the
    steps of odometry."""
    odometry, steps = VisualOdometry(), []
    for number in range(round(way_m / step_m)):
        pose = replace(START, east_m=START.east_m + number * step_m)
        higher = replace(pose, height_m=HEIGHT_M * climb(pose.east_m), roll_deg=lean_deg)
        steps.append(odometry.measure(float(number), *take_picture(ground, higher, pose, terraces)))
    assert steps[0] is None
    assert all(steps[1:])
    return steps[1:]


def sum_heights(steps):
    """The change of height over all steps, as a logarithm, and its standard deviation."""
    return sum(step.log_height for step in steps), math.hypot(*(step.log_height_sd for step in steps))


def sum_way_m(steps):
    """The way east, each step corrected by the heights up to it."""
    heights = np.exp(np.cumsum([step.log_height for step in steps]))
    return float(np.dot(heights, [step.moved_m[0] for step in steps]))


@pytest.mark.parametrize("step_m", [4.0, 10.0, 20.0])
@pytest.mark.parametrize("factor", [1.0, 1.4, 0.75])
def test_cliff_is_measured_by_the_parallax_of_landmarks(ground, factor, step_m):
    """The pictures before and after show no other scale, and no step is refused."""
    steps = fly(ground, step_m, [(EDGE_M, factor)])
    log_height, sd = sum_heights(steps)
    assert abs(log_height - math.log(factor)) < max(0.06, 2 * sd)
    assert sd < 0.2
    assert sum_way_m(steps) == pytest.approx(step_m * len(steps), rel=0.06)
    uncorrected_m = sum(step.moved_m[0] for step in steps)
    assert factor == 1.0 or abs(uncorrected_m / (step_m * len(steps)) - 1) > 0.12


def test_slope_is_measured_though_the_scale_of_the_pictures_shows_the_opposite(ground):
    terraces = [(180.0 + 10 * number, 1.0 + 0.05 * (number + 1)) for number in range(8)]
    steps = fly(ground, 10.0, terraces)
    assert sum_heights(steps)[0] == pytest.approx(math.log(1.4), abs=0.06)
    assert sum_way_m(steps) == pytest.approx(10.0 * len(steps), rel=0.05)


@pytest.mark.parametrize("climb_m", [0.1, 60.0])
def test_climb_that_is_not_reported_is_measured_by_the_scale(ground, climb_m):
    """At once, as where the source of the height changes, or over some way."""
    steps = fly(ground, 10.0, [], climb=lambda east_m: 1 + 0.3 * min(1.0, max(0.0, (east_m - 195) / climb_m)))
    assert sum_heights(steps)[0] == pytest.approx(math.log(1.3), abs=0.05)
    assert sum_way_m(steps) == pytest.approx(10.0 * len(steps), rel=0.04)


@pytest.mark.parametrize("lean_deg", [2.0, -2.0, 5.0])
def test_tilt_along_the_flight_that_is_not_reported_is_no_slope(ground, lean_deg):
    """Parallax alone shows a slope of as many degrees, 0.07 to 0.18 in all, and the scale the opposite. Landmarks lie
    on whole pixels: their median does not see changes of less than a pixel a step."""
    log_height, sd = sum_heights(fly(ground, 10.0, [], lean_deg=lean_deg))
    assert abs(log_height) < max(0.03, 2 * sd)
    assert sd < 0.06


def test_slow_flight_changes_no_height(ground):
    """Between two frames, landmarks shift by two pixels."""
    log_height, sd = sum_heights(fly(ground, 0.4, [], way_m=48))
    assert abs(log_height) < 0.02
    assert sd < 0.03


def test_landmarks_in_a_narrow_band_show_no_climb(ground):
    """Along a road, the scale across the motion is known to a tenth only, and claimed so."""
    start = np.random.default_rng(3).uniform(-0.4, 0.4, (150, 2)) @ (1.0, 0.04j)
    chain, log_heights, sds = ParallaxChain(), [], []
    for number in range(40):
        noise = np.random.default_rng(number).normal(0, 0.0015, (2, 150))
        points = start - 0.1 + noise[0] + 1j * noise[1]
        _, climb = chain.add(ImageMotion((points, start), (0j, 0j), 1 + 0j, 0.1 + 0j, 0.0, 150, 1.0))
        log_heights.append(climb.log_ratio)
        sds.append(climb.sd)
    assert abs(sum(log_heights)) < 2 * math.hypot(*sds)
    assert math.hypot(*sds) < 0.1


def test_height_is_followed_over_a_step_that_cannot_be_measured(ground):
    odometry, pose = VisualOdometry(), START
    view, landmarks = take_picture(ground, pose, pose, [])
    dark = detect_landmarks(np.zeros((48, 64), np.uint8))
    steps = []
    for number, east_m in enumerate((110.0, 120.0, 130.0, None, 150.0, 160.0)):
        if east_m:
            pose = replace(START, east_m=east_m)
            view, landmarks = take_picture(ground, pose, pose, [])
        steps.append(odometry.measure(float(number), view, landmarks if east_m else dark))
    assert steps[0] is steps[3] is steps[4] is None
    assert steps[2].log_height_sd < 0.05
    assert max(step.log_height_sd for step in steps if step) < 0.03, "the picture before shows the same ground"


def test_ground_that_no_three_pictures_share_is_claimed_as_unknown(ground):
    steps = fly(ground, 65.0, [])
    assert sum_heights(steps[:1])[1] == 0.0, "there is nothing to compare the first step with"
    assert all(step.log_height_sd > 0.07 for step in steps[1:])
