"""The autopilot is asked for another set of sources (42007) where its operator allows it, once, over a real link."""

import math

import pytest
from controlled import Controlled

from edgevpr.core.config import SourceSetsConfig
from edgevpr.mavlink.wire import mavlink
from edgevpr.runtime.flight.autopilot import SourceSets

pytestmark = pytest.mark.slow

NEVER = -math.inf
ASK = mavlink.MAV_CMD_SET_EKF_SOURCE_SET
ALLOWED = SourceSetsConfig(gps=1, no_gps=2)


def asked(flown):
    return [int(each.param1) for _, each in flown.commands(ASK)]


def in_air(flown):
    flown.until(lambda: flown.controller.why_not_arm() is None)
    flown.controller.arm()
    return flown.fly(20)


def lose_and_find(flown):
    flown.controller.set("SIM_GPS1_ENABLE", 0)
    flown.fly(20)
    flown.controller.set("SIM_GPS1_ENABLE", 1)
    flown.fly(20)


def test_the_set_without_gps_is_asked_for_once_and_the_other_after_ten_seconds_of_gps():
    with Controlled("arduplane", source_sets=ALLOWED) as flown:
        in_air(flown)
        assert asked(flown) == []
        lost_s = flown.now_s
        flown.controller.set("SIM_GPS1_ENABLE", 0)
        flown.fly(20)
        assert asked(flown) == [2]
        assert flown.commands(ASK)[0][0] < lost_s + 6
        assert flown.brain._source_set == 2
        found_s = flown.now_s
        flown.controller.set("SIM_GPS1_ENABLE", 1)
        flown.fly(20)
        assert asked(flown) == [2, 1]
        assert flown.commands(ASK)[1][0] >= found_s + 10
        assert flown.brain._source_set == 1
        assert {(each.target_system, each.target_component) for _, each in flown.commands(ASK)} == {(1, 1)}


def test_a_receiver_that_is_wrong_counts_as_none():
    with Controlled("arduplane", source_sets=ALLOWED) as flown:
        in_air(flown)
        flown.autopilot.compare_gps(100.0, is_wrong=True, have_agreed=True)
        flown.fly(3)
        assert asked(flown) == [2]
        flown.autopilot.compare_gps(3.0, is_wrong=False, have_agreed=True)
        flown.fly(15)
        assert asked(flown) == [2, 1]


def test_a_receiver_that_never_agreed_with_the_map_stays_in_use():
    with Controlled("arduplane", source_sets=ALLOWED) as flown:
        in_air(flown)
        flown.autopilot.compare_gps(100.0, is_wrong=True, have_agreed=False)
        flown.fly(3)
        assert asked(flown) == []


@pytest.mark.parametrize(
    ("gps", "no_gps", "send_fixes"), [(None, None, True), (1, None, True), (None, 2, True), (1, 2, False)]
)
def test_without_both_numbers_and_in_a_dry_run_none_is_asked_for(gps, no_gps, send_fixes):
    with Controlled("arduplane", source_sets=SourceSetsConfig(gps, no_gps), send_fixes=send_fixes) as flown:
        in_air(flown)
        lose_and_find(flown)
        assert asked(flown) == []


def test_a_question_that_is_not_answered_is_asked_again():
    sets = SourceSets(ALLOWED)
    asked = [sets.wanted(t_s / 2, False, True, answered_s=5.1 if t_s > 10 else NEVER) for t_s in range(30)]
    assert [t_s / 2 for t_s, number in enumerate(asked) if number == 2] == [0, 2, 4]
    assert sets.wanted(40.0, True, True, answered_s=5.1) == 1, "GPS is good"
    assert sets.wanted(43.0, True, True, answered_s=5.1) == 1, "that answer was for the other one"


def test_without_a_position_of_ours_none_is_asked_for():
    sets = SourceSets(ALLOWED)
    assert sets.wanted(0.0, has_gps=False, has_own=False, answered_s=NEVER) is None
    assert sets.wanted(1.0, has_gps=False, has_own=True, answered_s=NEVER) == 2
    assert sets.wanted(2.0, has_gps=False, has_own=True, answered_s=1.1) is None
