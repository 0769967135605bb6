"""Whole flights with the simulated flight controller, which is as strict as ArduPilot, over a real link."""

import pytest
from controlled import Controlled

from edgevpr.core.reasons import ReasonCode
from edgevpr.mavlink.wire import mavlink

pytestmark = pytest.mark.slow

FIX = mavlink.MAV_CMD_EXTERNAL_POSITION_ESTIMATE
HAS_POSITION = mavlink.EKF_POS_HORIZ_REL | mavlink.EKF_POS_HORIZ_ABS
OUR_GPS = {"GPS2_TYPE": 14, "GPS_AUTO_SWITCH": 1}


def hovers_without_gps(flown, checks=True):
    """Let a copter take off, and lose GPS at 20 m."""
    if checks:
        flown.until(lambda: flown.controller.why_not_arm() is None)
    else:
        flown.fly(10)
    flown.controller.arm()
    flown.motion.take_off(20)
    flown.fly(10)
    flown.controller.set("SIM_GPS1_ENABLE", 0)
    return flown.now_s


def test_a_copter_whose_second_receiver_we_are_loses_gps_and_flies_on():
    with Controlled("arducopter", **OUR_GPS) as flown:
        lost_s = hovers_without_gps(flown)
        flown.fly(40)
        assert flown.controller.error_m < 4
        assert flown.brain.flags() & HAS_POSITION, "without it a copter lands"
        heard = flown.heard_of("GPS_INPUT", lost_s)
        assert len(heard) == pytest.approx(400, abs=8), "ten a second"
        assert {(each.gps_id, each.fix_type) for each in heard} == {(1, mavlink.GPS_FIX_TYPE_3D_FIX)}
        assert all(t_s < 5 for t_s, _ in flown.commands(FIX)), "none since it is known which channel it has"
        flown.sees = False
        flown.fly(75)
        assert flown.heard_of("GPS_INPUT")[-1].fix_type == mavlink.GPS_FIX_TYPE_NO_FIX, "a minute without a match"
        assert not flown.brain.flags() & HAS_POSITION


def test_a_plane_gets_single_fixes_after_the_loss_only_and_takes_them():
    with Controlled("arduplane") as flown:
        flown.sees = False  # on the ground
        flown.until(lambda: flown.controller.why_not_arm() is None)
        flown.controller.arm()
        flown.sees = True
        flown.fly(30)
        assert not flown.commands(FIX)
        assert flown.reports[-1].why.code is ReasonCode.HAS_GPS
        flown.controller.set("SIM_GPS1_ENABLE", 0)
        flown.controller.set("SIM_WIND_SPD", 6)
        lost_s = flown.now_s
        flown.fly(15)
        errors_m = []
        for _ in range(45):
            flown.fly(1)
            errors_m.append(flown.controller.error_m)
        assert max(errors_m) < 15
        sent = flown.commands(FIX)
        assert len(sent) > 30
        assert sent[0][0] > lost_s
        assert flown.controller.answers.count(mavlink.MAV_RESULT_ACCEPTED) > 0.9 * len(sent)
        assert not flown.heard_of("GPS_INPUT")
        flown.sees = False
        flown.fly(20)
        assert flown.controller.error_m < 40, "the wind that matches have shown carries on"
        flown.fly(60)
        assert flown.controller.error_m > 50, "alone it drifts away"
