"""A fix that contradicts the autopilot's own position is held back until a second, independent one says the same."""

import math
from dataclasses import replace

import numpy as np
import pytest
from fakes import FakeClock, FakeSource
from flights import Flight, connect_autopilot, select
from pictures import draw_texture

from edgevpr.core.geodesy import move_position
from edgevpr.core.reasons import Reason, ReasonCode
from edgevpr.core.types import Position
from edgevpr.runtime.flight.consistency import Consistency, PredictedFix, can_follow, confirm_each_other
from edgevpr.runtime.flight.measurements import FrameMeasurement, PositionedMatch

HOME = 50.0, 8.0
START_S = 1000.0


def fly(recording, tmp_path, pictures, off_deg=0.05, has_gps=False, **settings):
    """A flight past the places, one a second, with an autopilot that is `off_deg` of longitude off; its lines, link."""
    clock = FakeClock()
    link = connect_autopilot(clock, off_deg=off_deg, has_gps=has_gps)
    flight = Flight(recording / "cohog.gpkg", tmp_path / "log", clock, link, **{"source.rate_hz": 1.0} | settings)
    lines = flight.fly(FakeSource([draw_texture(number, 240, 320) for number in pictures], clock))
    return select(lines, "query"), link


def test_gate_fix_logs_and_announces_a_held_fix_once_in_flight(recording, tmp_path):
    queries, link = fly(recording, tmp_path, (0, 20, 2, 3, 4))
    assert all(line["accepted"] for line in queries), "held back or not, the match stays accepted"
    assert [line["fix"]["sent"] for line in queries] == [False, False, False, True, True]
    assert queries[0]["fix"]["why"]["code"] == "HELD_OFF_PATH"
    assert queries[0]["fix"]["why"]["parameters"]["distance_m"] == pytest.approx(3574.0, abs=0.5)
    assert link.stats().fixes_sent == 2
    assert [severity for severity, text in link.texts() if "fix" in text] == [4, 6]
    assert sum(each.name == "vpr_place" for each in link.sent if each.get_type() == "NAMED_VALUE_INT") == 5


def make_fix(off_m, t_s, places=1, *, path_m=0.0, predicted_m=0.0, error_deg=None):
    """A fix off to the east, whose covariance is 5.5 m2 and that of its prediction 30.5 m2: together 6 m."""
    places = places if isinstance(places, tuple) else (places,)
    frame = FrameMeasurement(t_s=START_S + t_s, sd_m=0.0)
    said = {"position": Position(*HOME), "accuracy_m": 1.0, "places": places, "heading_error_deg": error_deg}
    vectors_m = {"path_point_m": 700.0 + path_m, "offset_m": off_m, "predicted_m": predicted_m}
    vectors_m = {name: np.array([east_m, 0.0]) for name, east_m in vectors_m.items()}
    match = PositionedMatch(frame=frame, covariance_m2=5.5 * np.eye(2), **said)
    return PredictedFix(match=match, covariance_m2=30.5 * np.eye(2), **vectors_m)


def abbreviate(result):
    """ "." for a fix that is believed as expected, "a" against the path, "l" against a lost one, "h" if it is held."""
    verdicts = {(False, False, False): ".", (False, True, False): "a", (False, True, True): "l"}
    held = result.reason is not None
    return (verdicts | {(True, False, False): "h"})[held, result.overrules_path, result.restarts_path]


@pytest.mark.parametrize(
    ("fixes", "is_tracked", "verdicts"),
    [
        ([(24.0, 0)], False, "."),
        ([(24.1, 0)], False, "h"),
        ([(100, 0, 1), (0, 1, 2), (100, 2, 3)], False, "h.h"),
        ([(100, 0, 1), (-100, 1, 2), (100, 2, 3), (100, 3, 4), (0, 4, 5)], False, "hhha."),
        # Two that agree: after 2 s they differ by 6 m, with the drift that is allowed for.
        ([(100, 0, 1), (112.0, 2, 2)], False, "ha"),
        ([(100, 0, 1), (112.1, 2, 2)], False, "hh"),
        ([(100, 0, 1), (100, 30.0, 2)], False, "ha"),
        ([(100, 0, 1), (100, 30.1, 2)], False, "hh"),
        ([(100, 0, (1, 2)), (100, 2, (2, 3))], False, "hh"),
        ([(100, 0, (1, 2)), (100, 2, (3, 4))], False, "ha"),
        # Where the camera has followed the path it takes four, after 24 s within 2 * 12.45 m.
        ([(100, 0, 0), (100, 8, 1), (100, 16, 2), (124.8, 24, 3)], True, "hhha"),
        ([(100, 0, 0), (100, 8, 1), (100, 16, 2), (125.0, 24, 3)], True, "hhhh"),
        ([(100, 0, 0), (100, 30, 1), (100, 60, 2), (100, 90, 3)], True, "hhha"),
        ([(100, 0, 0), (100, 30, 1), (100, 60, 2), (100, 90.1, 3)], True, "hhhh"),
        # The same place is another one if the aircraft has flown on by more than 24 m.
        ([(100, 0), (100, 2, 1, {"path_m": 24.0})], False, "hh"),
        ([(100, 0), (100, 2, 1, {"path_m": 24.1})], False, "ha"),
        ([(100, 0, 1, {"predicted_m": 3.0}), (110, 2, 1, {"path_m": 13.9, "predicted_m": 13.1})], False, "hh"),
        ([(100, 0, 1, {"predicted_m": 3.0}), (110, 2, 1, {"path_m": 14.1, "predicted_m": 13.1})], False, "ha"),
        # Four of different places that an aircraft of 30 m/s can have flown through within 10 s: the path is lost.
        ([(100, 0, 1), (190, 3, 2), (280, 6, 3), (400.0, 10.0, 4)], False, "hhhl"),
        ([(100, 0, 1), (190, 3, 2), (280, 6, 3), (400.1, 10.0, 4)], False, "hhhh"),
        ([(100, 0, 1), (190, 3, 2), (280, 6, 3), (400.0, 10.1, 4)], False, "hhhh"),
        ([(100, 0, 1), (190, 3, 2), (280, 6, 3), (400.0, 10.0, 3)], False, "hhhh"),
        ([(100, 0, 1), (100, 0, 2), (190, 3, 3), (280, 6, 4)], True, "hhhh"),
        # Pictures that are suddenly turned against the compass, and a compass that was wrong from the start.
        ([(0, second, second, {"error_deg": turn}) for second, turn in enumerate((3, 180, 3))], False, ".h."),
        ([(0, second, second, {"error_deg": turn}) for second, turn in enumerate((3, *[100] * 5))], False, ".hhhl."),
        ([(0, second, second, {"error_deg": 140}) for second in range(3)], False, "..."),
    ],
)
def test_consistency_accepts_a_fix_that_others_confirm_within_limits(fixes, is_tracked, verdicts):
    judge = Consistency()
    results = [
        judge.judge(make_fix(*each[:3], **dict(*each[3:])), has_gps=False, is_tracked=is_tracked) for each in fixes
    ]
    assert "".join(map(abbreviate, results)) == verdicts


def judge_track(judge, off_m, predicted_m, times):
    """Judge fixes at different places off to the east, once a second, on a tracked path."""
    fixes = [make_fix(off_m, second, second, predicted_m=predicted_m) for second in range(times)]
    return "".join(abbreviate(judge.judge(fix, has_gps=False, is_tracked=True)) for fix in fixes)


@pytest.mark.parametrize(("supported", "doubted"), [(3, 3), (30, 20)])
def test_consistency_doubts_a_new_track_until_as_many_fixes_support_it(supported, doubted):
    judge = Consistency()
    assert judge_track(judge, 0, 0, supported) + judge_track(judge, 100, 0, 4) == supported * "." + "hhha"
    assert judge_track(judge, 100, 100, doubted - 1) == (doubted - 1) * "."
    assert judge.doubt_m == 100
    assert judge_track(judge, 100, 100, 1) + judge_track(judge, 0, 100, 1) == ".h"
    assert judge.doubt_m == 0


@pytest.mark.parametrize(("gap_s", "doubt_m"), [(10.0, 100), (10.1, 0)])
@pytest.mark.parametrize("is_by_gps", [False, True])
def test_consistency_does_not_doubt_a_new_track_if_nothing_supported_the_old_one(is_by_gps, gap_s, doubt_m):
    judge = Consistency()
    if is_by_gps:
        judge.trust_path(START_S)
    else:
        judge.judge(make_fix(0, 0), has_gps=False, is_tracked=True)
    fixes = [make_fix(100, gap_s + 3 * number, number) for number in range(4)]
    verdicts = [judge.judge(fix, has_gps=False, is_tracked=True) for fix in fixes]
    assert "".join(map(abbreviate, verdicts)) == "hhha"
    assert judge.doubt_m == doubt_m


def test_consistency_returns_to_a_track_in_doubt_at_the_first_fix_there():
    judge = Consistency()
    judge_track(judge, 0, 0, 9)
    for _ in range(2):
        assert judge_track(judge, 100, 0, 4) + judge_track(judge, 100, 100, 5) == "hhha....."
        assert judge_track(judge, 12, 100, 1) + judge_track(judge, 0, 12, 1) == "a."
        assert judge.doubt_m == 0
    assert judge_track(judge, -100, 0, 4) == "hhha"
    judge.trust_path(0.0)
    assert judge.doubt_m == 0, "GPS supports it"
    assert judge_track(judge, 0, -100, 1) == "h"


def test_consistency_rejects_any_fix_against_gps():
    judge = Consistency()
    for second in range(6):
        reason = judge.judge(make_fix(500.0, second, second), has_gps=True, is_tracked=False).reason
        assert reason == Reason(ReasonCode.HELD_OFF_GPS, {"distance_m": 500.0})
    assert not judge.is_contradicted(START_S + 5, is_tracked=False)


@pytest.mark.parametrize(("is_tracked", "good_for_s"), [(True, 2.5), (False, 30.0)])
def test_consistency_is_in_doubt_until_another_should_have_agreed(is_tracked, good_for_s):
    judge = Consistency()
    assert not judge.is_contradicted(START_S, is_tracked)
    for t_s in range(8):
        reason = judge.judge(make_fix(-100, t_s), has_gps=False, is_tracked=is_tracked).reason
        assert reason == Reason(ReasonCode.HELD_OFF_PATH, {"distance_m": 100.0, "accuracy_m": math.sqrt(30.5)})
    assert judge.is_contradicted(START_S + 7 + good_for_s, is_tracked)
    assert not judge.is_contradicted(START_S + 7.1 + good_for_s, is_tracked), "no other has agreed"
    assert judge.judge(make_fix(0.0, 9), has_gps=False, is_tracked=is_tracked).reason is None
    assert not judge.is_contradicted(START_S + 9, is_tracked)


@pytest.mark.parametrize(("before_deg", "error_deg"), [(100.0, 0.0), (0.0, 100.0)])
def test_consistency_reports_the_rotation_of_an_image(before_deg, error_deg):
    judge = Consistency()
    judge.judge(make_fix(0.0, 0, error_deg=before_deg), has_gps=True, is_tracked=False)
    for has_gps in (True, False):
        reason = judge.judge(make_fix(0.0, 1, error_deg=error_deg), has_gps=has_gps, is_tracked=False).reason
        assert reason == Reason(ReasonCode.HELD_ROTATED, {"rotation_deg": error_deg})


def make_match(off_m, t_s=0.0, place=1):
    """An accepted match off to the east, whose standard deviation is 2.35 m."""
    return replace(make_fix(0.0, t_s, place).match, position=move_position(Position(*HOME), off_m, 0.0))


@pytest.mark.parametrize(
    ("offs_m", "places", "is_confirmed"),
    [
        ([], "", False),
        ([0], "1", False),
        ([0, 0], "12", True),
        ([0, 0, 0], "111", False),
        ([0, 0, 0, 0], "1111", True),
        ([0, 90, 0], "121", False),
        # Apart by more than four standard deviations of the difference: 13.27 m.
        ([0, 13.2], "11", False),
        ([0, 0, 13.4], "111", True),
    ],
)
def test_matches_confirm_each_other_if_independent_or_four(offs_m, places, is_confirmed):
    matches = [make_match(off_m, place=place) for off_m, place in zip(offs_m, places, strict=True)]
    assert confirm_each_other(matches) is is_confirmed


@pytest.mark.parametrize(
    ("off_m", "after_s", "can"),
    [
        (64.2, 2, True),
        (64.3, 2, False),
        (9, 0.5, True),
        (0, 0, False),
        (0, -0.5, False),
        (0, 120, True),
        (0, 120.1, False),
    ],
)
def test_matches_can_follow_each_other_at_thirty_metres_a_second(off_m, after_s, can):
    assert can_follow(make_match(0.0, 50.0), make_match(off_m, 50.0 + after_s)) is can, "each is good to 1 m"
