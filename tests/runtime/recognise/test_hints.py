"""What is known beforehand narrows a query, and never keeps the next one from looking everywhere."""

from dataclasses import replace

import numpy as np
import pytest
from fakes import make_vehicle
from fixed_confidence import make_bare_index

from edgevpr.core.contract import FineMatch
from edgevpr.core.types import Candidate, Frame, Place, Position
from edgevpr.runtime.recognise.hints import Hints, Prior, Reach, RecordedPrior, to_expectation
from edgevpr.runtime.recognise.locate import Located

HOME = Position(50.0, 8.0)
WITHIN_DEG = 22.5
DEG_PER_M = 1 / 111_195  # of latitude


def to_position(metres):
    return Position(50.0 + metres * DEG_PER_M, 8.0)


def make_index(north_m, heading_deg):
    """Places so far to the north (NaN: without a position) with these headings."""
    index = make_bare_index(len(north_m))
    index.lat_deg[:] = [to_position(metres).lat_deg for metres in north_m]
    index.lon_deg[:] = np.where(np.isnan(north_m), np.nan, 8.0)
    index.heading_deg[:] = heading_deg
    return index


@pytest.fixture
def index():
    return make_index([0, 100, 200, 300, np.nan], [0, 10, 20, np.nan, 350])


def vehicle(position, t_received_s):
    return make_vehicle(position.lat_deg, position.lon_deg, t_received_s)


def make_place_match(metres=0.0, heading_deg=None, rotation_deg=None):
    return Candidate(
        Place(place_id=1, source_image="a", position=to_position(metres), heading_deg=heading_deg),
        FineMatch(0.5, rotation_deg=rotation_deg),
    )


def make_hints(now_s, index, autopilot=None, fix=None, reach_m_s=10.0, heading_deg=None):
    """The hints for a frame at this time, `fix` being our own position and its time (None: there is none)."""
    prior = Prior(reach_m_s, None if heading_deg is None else WITHIN_DEG, is_live=True)
    if fix:
        prior.update(make_place_match(fix[0]), True, fix[1])
    frame = Frame(image=np.zeros((1, 1), np.uint8), name="", t_mono_s=now_s, heading_deg=heading_deg)
    return prior.make_hints(frame, autopilot, index, 50.0)


def test_reach_grows_with_the_time_since_the_position_was_known(index):
    assert make_hints(10.0, index, fix=(0, 8.0), reach_m_s=15.0) == Hints(Reach(HOME, 80.0))
    assert make_hints(10.0, index, fix=(0, 10.0), reach_m_s=15.0) == Hints(Reach(HOME, 50.0))
    heard_after_the_frame = vehicle(HOME, 10.5)
    assert make_hints(10.0, index, heard_after_the_frame) == Hints(Reach(HOME, 55.0))


def test_hints_prefer_a_fresh_autopilot_to_our_own_fix_and_both_grow_with_age(index):
    autopilot, fix = vehicle(to_position(200), 9.5), (0, 0.0)
    assert make_hints(10.0, index, autopilot, fix) == Hints(Reach(to_position(200), 55.0))
    assert make_hints(10.6, index, autopilot, fix) == Hints(Reach(HOME, pytest.approx(156.0)))
    assert make_hints(60.1, index, None, fix) is None
    assert make_hints(10.0, index) is None


def test_to_expectation_allows_only_places_in_reach_and_all_without_a_position(index):
    expected = to_expectation(Hints(Reach(to_position(120), 90.0)), 1.0, index)
    assert expected.in_reach.tolist() == [False, True, True, False, False]
    assert expected.rotation_deg is None
    assert make_hints(10.0, index, vehicle(to_position(5000), 10.0)) is None, "no place is in reach: all are searched"
    everywhere = to_expectation(None, 1.0, index)
    assert (everywhere.in_reach, everywhere.rotation_deg) == (None, None)


def test_to_expectation_gives_the_expected_rotation_of_each_place_if_the_heading_is_known(index):
    hints = make_hints(10.0, index, heading_deg=5.0)
    assert to_expectation(hints, 1.0, index).in_reach is None
    np.testing.assert_array_equal(to_expectation(hints, 1.0, index).rotation_deg, [5, 355, 345, np.nan, 15])
    index.heading_deg[:] = np.nan
    assert make_hints(10.0, index, heading_deg=5.0) is None
    assert make_hints(10.0, index, vehicle(HOME, 10.0), heading_deg=5.0) == Hints(Reach(HOME, 50.0))


@pytest.mark.parametrize(
    ("hints", "candidate", "agrees"),
    [
        (Hints(Reach(HOME, 100.0)), make_place_match(90), (True, True)),
        (Hints(Reach(HOME, 100.0)), make_place_match(110), (False, True)),
        (Hints(Reach(HOME, 100.0)), Candidate(Place(place_id=1, source_image="a"), FineMatch(0.5)), (True, True)),
        (Hints(heading_deg=10.0), make_place_match(0, 350.0, 30.0), (True, True)),
        (Hints(heading_deg=10.0), make_place_match(0, 350.0, 0.0), (True, True)),
        (Hints(heading_deg=10.0), make_place_match(0, 350.0, 345.0), (True, False)),
        (Hints(heading_deg=10.0), make_place_match(0, 350.0, 45.0), (True, False)),
        (Hints(heading_deg=10.0), make_place_match(0, None, 180.0), (True, True)),
        (Hints(Reach(HOME, 100.0), 10.0), make_place_match(0, 10.0, 180.0), (True, False)),
        (Hints(Reach(HOME, 100.0), 10.0), make_place_match(110, 10.0, 0.0), (False, True)),
    ],
)
def test_agree_with_accepts_a_place_that_the_hints_would_have_allowed(hints, candidate, agrees):
    assert hints.agree_with(candidate, WITHIN_DEG) == agrees


def test_prior_alternates_with_and_without_hints_until_a_match_confirms_them(index):
    prior, near, seen = Prior(10.0, None, is_live=True), Position(50.0, 8.0), []
    answers = [(50, False), (50, False), (50, False), (50, True), (50, True), (500, True), (0, False)]
    for number, (metres, accepted) in enumerate(answers):
        # The autopilot knows where it is to within 100 m, so that hints are there for every query.
        frame = Frame(image=np.zeros((1, 1), np.uint8), name="", t_mono_s=float(number))
        seen.append(prior.make_hints(frame, vehicle(near, float(number)), index, 100.0) is not None)
        prior.update(make_place_match(metres), accepted, float(number))
    assert seen == [True, False, True, False, True, True, False]


def test_prior_keeps_the_area_with_a_wrong_compass_and_the_heading_with_a_wrong_position(index):
    prior, near, seen = Prior(10.0, WITHIN_DEG, is_live=True), Position(50.0, 8.0), []
    # Metres, and degrees against the compass, of a match; None: nothing is accepted.
    answers = [(50, 90.0), None, None, (50, 90.0), (500, 0.0), (500, 90.0), None, None, (50, 0.0), None]
    for number, answer in enumerate(answers):
        frame = Frame(image=np.zeros((1, 1), np.uint8), name="", t_mono_s=float(number), heading_deg=0.0)
        hints = prior.make_hints(frame, vehicle(near, float(number)), index, 100.0)
        seen.append(hints and (hints.reach is not None, hints.heading_deg is not None))
        metres, rotation_deg = answer or (50, 0.0)
        prior.update(make_place_match(metres, 0.0, rotation_deg), answer is not None, float(number))
    both, area, heading = (True, True), (True, False), (False, True)
    assert seen == [both, area, None, area, area, heading, None, both, None, both]


def test_prior_of_a_certain_flight_narrows_the_search_for_a_minute():
    long_index = make_index(100 * np.arange(40), [np.nan] * 40)
    prior, frame = Prior(None, None, is_live=True), Frame(image=np.zeros((1, 1), np.uint8), name="", t_mono_s=10.0)
    there = Located(position=to_position(2000), covariance_m2=(9.0, 0.0, 16.0))
    prior.update_area(there, 0.98, 10.0)
    prior.update_area(None, 1.0, 10.0)
    assert prior.make_hints(frame, None, long_index, 50.0) is None
    prior.update_area(there, 0.99, 10.0)
    assert prior.make_hints(frame, None, long_index, 50.0) == Hints(Reach(to_position(2000), 320.0))
    assert prior.make_hints(frame, None, long_index, 100.0) == Hints(Reach(to_position(2000), 520.0)), (
        "five places on every side"
    )
    prior.update_area(there, 0.5, 12.0)
    hints = Hints(Reach(to_position(2000), 440.0))
    assert prior.make_hints(replace(frame, t_mono_s=14.0), None, long_index, 50.0) == hints
    assert prior.make_hints(replace(frame, t_mono_s=70.1), None, long_index, 50.0) is None


def test_prior_scales_the_next_image_to_a_height_that_is_searched():
    prior, tried = Prior(None, WITHIN_DEG, is_live=True), (0.5, 0.7, 1.0, 1.42, 2.0)

    def learn(ratio, accepted=True):
        best = Candidate(Place(place_id=1, source_image="a"), FineMatch(0.5, height_ratio=ratio))
        prior.update(best, accepted, 0.0, prior.scale(tried))
        return prior.height_ratio, prior.scale(tried)

    assert learn(0.7, accepted=False) == (1.0, 1.0)
    assert learn(1.05) == (1.0, 1.0), "an error of the match"
    assert learn(0.8) == (0.8, 0.8)
    assert learn(None) == (0.8, 0.8), "a technique that tells no height"
    assert learn(0.95) == (0.8, 0.8)
    assert learn(1.5) == (pytest.approx(1.2), pytest.approx(1.2 / 1.42)), "no more is cut off than needed"
    assert learn(1.42 * 1.42) == (pytest.approx(1.704), pytest.approx(1.704 / 2))
    assert learn(0.25) == (pytest.approx(0.213), 0.5), "no picture is made smaller than that"
    assert prior.scale(()) == 1.0


def test_prior_searches_all_heights_every_second_query_over_unmapped_ground():
    prior = Prior(None, WITHIN_DEG, is_live=True)
    again = []
    for accepted in (False, False, False, True, True, False, False):
        again.append(prior.searches_heights)
        prior.update(make_place_match(), accepted, 0.0)
    assert again == [True, False, True, False, True, True, False]


@pytest.mark.parametrize(("ratio", "matches"), [(0.9, 3), (1.25, 1), (0.95, 0)])
def test_recorded_prior_corrects_a_small_error_of_the_height_by_three_matches_only(index, ratio, matches):
    prior = RecordedPrior(("height",))
    frame = Frame(image=np.zeros((8, 8), np.uint8), name="", t_mono_s=0.0)
    best = Candidate(Place(place_id=1, source_image="a"), FineMatch(0.5, height_ratio=ratio))
    found = []
    for _ in range(4):
        prior.make_hints(frame, None, index, 0.0)
        found.append(prior.height_ratio)
        prior.update(best, True, 0.0, 1.0, 60.0)
    uncorrected = matches or 4
    assert found == [1.0] * uncorrected + [pytest.approx(ratio)] * (4 - uncorrected)
