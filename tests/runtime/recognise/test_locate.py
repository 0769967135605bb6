"""From matches to metres: positions, covariances, and what places must agree on."""

import math
from dataclasses import replace

import numpy as np
import pytest
from fixed_confidence import make_agreement

from edgevpr.core.contract import FineMatch
from edgevpr.core.geodesy import offset_position, project_to_metres
from edgevpr.core.reasons import ReasonCode
from edgevpr.core.types import Candidate, Place, Pose, Position
from edgevpr.frames.level import View
from edgevpr.runtime.recognise.locate import locate, locate_at_place, measure_distance_m

ORIGIN = Position(50.0, 8.0, 120.0)
CELLS = 32
FOOTPRINT_M = 64.0


def make_candidate(number=1, shift=(0.0, 0.0), east_m=0.0, north_m=0.0, up_deg=0.0, turned_deg=0.0, score=0.3, **pose):
    lat_deg, lon_deg = offset_position(ORIGIN.lat_deg, ORIGIN.lon_deg, east_m, north_m)
    lies = Pose(**{"up_deg": up_deg, "footprint_m": FOOTPRINT_M, "covariance_m2": (4.0, 0.0, 4.0), **pose})
    place = Place(place_id=number, source_image=f"{number}", position=Position(lat_deg, lon_deg, 120.0), pose=lies)
    match = FineMatch(score, shift_cells=shift, covariance_cells2=(0.2, 0.0, 0.2), rotation_deg=turned_deg)
    return Candidate(place, match)


def measure_offset_m(position):
    lat_deg, lon_deg = np.array([(point.lat_deg, point.lon_deg) for point in (ORIGIN, position)]).T
    east_m, north_m = project_to_metres(lat_deg, lon_deg)
    return east_m[1], north_m[1]


@pytest.mark.parametrize(
    ("shift", "up_deg", "there"),
    [
        ((4, 0), 0, (8, 0)),  # a cell is 2 m: right is east where the top of the picture is north
        ((0, 4), 0, (0, -8)),  # and down is south
        ((4, 0), 90, (0, -8)),  # the top is east: right is south
        ((0, 4), 90, (-8, 0)),
        ((4, 0), 180, (-8, 0)),
        ((0, -4), 270, (-8, 0)),
        ((4, 0), 45, (8 / math.sqrt(2), -8 / math.sqrt(2))),
    ],
)
def test_locate_converts_a_shift_in_the_image_to_the_ground(shift, up_deg, there):
    found = locate([make_candidate(shift=shift, up_deg=up_deg)], CELLS, View(nadir_offset=(0.0, 0.0)))
    assert measure_offset_m(found.position) == pytest.approx(there, abs=0.01)
    assert found.position.alt_m == ORIGIN.alt_m


@pytest.mark.parametrize(("up_deg", "turned_deg", "heading_deg"), [(0, 0, 0), (90, 30, 120), (300, 90, 30)])
def test_locate_adds_the_rotation_to_the_heading_of_the_place(up_deg, turned_deg, heading_deg):
    found = locate([make_candidate(up_deg=up_deg, turned_deg=turned_deg)], CELLS)
    assert found.heading_deg == pytest.approx(heading_deg)


@pytest.mark.parametrize(
    ("turned_deg", "nadir_offset", "there"),
    [
        (0, (0.25, 0.0), (16, 0)),
        (0, (0.0, 0.25), (0, 16)),
        (90, (0.0, 0.25), (16, 0)),  # the query's top is east
        (90, (0.25, 0.0), (0, -16)),
    ],
)
def test_locate_gives_the_position_of_the_aircraft_not_of_the_image_centre(turned_deg, nadir_offset, there):
    found = locate([make_candidate(turned_deg=turned_deg)], CELLS, View(nadir_offset=nadir_offset))
    assert measure_offset_m(found.position) == pytest.approx(there, abs=0.01)


@pytest.mark.parametrize("pose", [{"is_surveyed": True}, {"recorded": ORIGIN}, {}], ids=["surveyed", "refined", "none"])
def test_locate_claims_an_error_of_direction_and_size_that_are_only_recorded(pose):
    found = [locate([make_candidate(shift=shift, **pose)], CELLS) for shift in ((0, 0), (12, 0))]
    at_centre_m, beside_m = (located.accuracy_m for located in found)
    assert beside_m == pytest.approx(math.hypot(at_centre_m, 0.03 * 24 if pose else 0.2 * 24), rel=0.05)


def test_locate_scales_the_nadir_offset_with_the_height():
    proof = make_agreement(20, (0.0, 0.0), scale=2.0)
    found = locate([make_candidate()], CELLS, View(nadir_offset=(0.25, 0.0)), proof)
    assert measure_offset_m(found.position) == pytest.approx((32, 0), abs=0.01)
    assert (found.height_ratio, found.footprint_m) == (2.0, 128.0)


def test_locate_prefers_landmarks_to_the_vote():
    proof = make_agreement(20, (0.11, -0.05), rotation_deg=4.0, covariance_share2=(1e-5, 0.0, 1e-5))
    by_vote = locate([make_candidate(shift=(4, -2))], CELLS, View(nadir_offset=(0.0, 0.0)))
    found = locate([make_candidate(shift=(4, -2))], CELLS, View(nadir_offset=(0.0, 0.0)), proof)
    between = 0.125 * 64, 0.0625 * 64  # what the vote says
    assert measure_offset_m(found.position) == pytest.approx((0.11 * 64, 0.05 * 64), abs=0.5)
    assert math.dist(measure_offset_m(found.position), between) > 0.5
    assert found.heading_deg == pytest.approx(4.0)
    assert found.places == (1,)
    assert found.accuracy_m < by_vote.accuracy_m


def test_locate_averages_places_of_the_same_ground():
    one, other = make_candidate(1, shift=(4, 0)), make_candidate(2, shift=(-4, 0), east_m=16.4)
    found = locate([one, other], CELLS, View(nadir_offset=(0.0, 0.0)))
    assert measure_offset_m(found.position) == pytest.approx((8.2, 0), abs=0.01)
    assert found.places == (1, 2)
    assert found.accuracy_m < locate([one], CELLS, View(nadir_offset=(0.0, 0.0))).accuracy_m
    assert found.accuracy_m >= 2.0, "what is wrong with the map does not become less by hearing more of it"
    assert found.objection is None


def test_locate_refuses_contradicting_places():
    candidates = [make_candidate(1, shift=(4, 0)), make_candidate(2, east_m=22)]
    assert locate(candidates, CELLS, View(nadir_offset=(0.0, 0.0))).objection.code is ReasonCode.POSITIONS_DISAGREE


def test_locate_skips_a_slightly_inconsistent_place_without_objection():
    candidates = [make_candidate(1, shift=(4, 0)), make_candidate(2, shift=(0, 0), east_m=20)]
    found = locate(candidates, CELLS, View(nadir_offset=(0.0, 0.0)))
    assert found.places == (1,)
    assert found.objection is None
    assert measure_offset_m(found.position) == pytest.approx((8, 0), abs=0.01)
    assert found.accuracy_m > 7.0, "the other place, 12 m off, may be the right one"


@pytest.mark.parametrize(
    "other",
    [
        make_candidate(2, shift=(0, 0), east_m=40, score=0.1),  # it agrees by far less
        make_candidate(2, shift=(0, 0), east_m=400),  # other ground
    ],
)
def test_locate_skips_places_of_other_ground(other):
    found = locate([make_candidate(1, shift=(4, 0)), other], CELLS)
    assert (found.places, found.objection) == ((1,), None)


def test_locate_needs_a_pose_and_a_shift():
    bare = Place(place_id=1, source_image="1", position=ORIGIN)
    assert locate([Candidate(bare, make_candidate().match)], CELLS) is None
    assert locate([Candidate(make_candidate().place, FineMatch(0.5))], CELLS) is None
    assert locate([make_candidate()], None) is None, "ahead, a step says nothing about metres"
    assert locate_at_place(ORIGIN, 20.0).accuracy_m == pytest.approx(20.0)


def test_measure_distance_takes_its_scale_from_places_of_the_same_ground():
    """Above a point 30 m north of the first place and 16 m north of the second, whose image is turned by 90 degrees."""
    first = make_candidate(1, shift=(0, -15))
    second = make_candidate(2, shift=(8, 0), north_m=14.0, turned_deg=90.0)
    other = make_candidate(3, shift=(10, 10), east_m=900.0, score=0.1)
    assert measure_distance_m([first, second, other], CELLS) == pytest.approx(30.0, abs=0.01)
    assert measure_distance_m([second, first], CELLS) == pytest.approx(16.0, abs=0.01)
    assert measure_distance_m([first, other], CELLS) == 0.0, "its scale is unknown"
    assert measure_distance_m([first, replace(first, place=second.place)], CELLS) == 0.0, "both at the same shift"
    unshifted = Candidate(first.place, FineMatch(0.3))
    assert measure_distance_m([unshifted, first, second], CELLS) == 0.0
    assert measure_distance_m([first, unshifted, second], CELLS) == pytest.approx(30.0, abs=0.01)
    assert measure_distance_m([first, second], None) == 0.0, "ahead"


def test_locate_rotates_the_covariance_of_the_place_to_the_ground():
    found = locate([make_candidate(covariance_m2=(100.0, 0.0, 1.0))], CELLS, View(nadir_offset=(0.0, 0.0)))
    var_east, cov, var_north = found.covariance_m2
    assert var_east > 100 > 10 > var_north > 1
    assert abs(cov) < 0.1
    assert found.accuracy_m == pytest.approx(math.sqrt(var_east), rel=1e-3)
