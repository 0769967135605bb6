"""What the autopilot and its GPS receivers report of the vehicle: heard from the pinned autopilot only, while fresh."""

import math

import pytest
from scripted_autopilot import ABS

from edgevpr.core.geodesy import offset_m
from edgevpr.core.types import Vehicle
from edgevpr.mavlink.receivers import DEFAULT_GPS_SD_M
from edgevpr.mavlink.vehicle import DRIFT_M_S
from edgevpr.mavlink.wire import mavlink

REL = mavlink.EKF_POS_HORIZ_REL
CONST_POS = mavlink.EKF_CONST_POS_MODE
ACCEPTED = mavlink.MAV_RESULT_ACCEPTED
FAILED = mavlink.MAV_RESULT_FAILED
FIX_2D = mavlink.GPS_FIX_TYPE_2D_FIX


def test_position_is_known_while_it_is_fresh(autopilot):
    assert autopilot.vehicle is None
    vehicle = autopilot.position(50.1234567, -14.5, vx=-300, vy=1250)
    assert vehicle == Vehicle(
        lat_deg=50.1234567,
        lon_deg=-14.5,
        alt_m=312.5,
        heading_deg=90.5,
        t_received_s=autopilot.clock.now_s,
        has_gps=False,
        height_m=80.0,
        velocity_m_s=(12.5, -3.0),
        sink_m_s=0.0,
    )
    assert [vehicle.is_fresh(autopilot.clock.now_s + after_s) for after_s in (1.0, 1.1)] == [True, False]
    assert autopilot.position(hdg=65535).heading_deg is None
    assert autopilot.position(vx=32_767, vy=32_767).velocity_m_s is None, "no small aircraft has it"


def test_position_at_a_frame_time_is_extrapolated_with_the_velocity(autopilot):
    now_s = autopilot.position(vx=2000, vy=-1000).t_received_s
    for seconds in (-0.4, 0.25):
        there = autopilot.predict(now_s + seconds)
        off_m = offset_m(50.0, 8.0, there.lat_deg, there.lon_deg)
        assert off_m == pytest.approx((-10 * seconds, 20 * seconds), abs=1e-6)
    old = autopilot.predict(now_s + 1.5)
    assert (old.lat_deg, old.lon_deg) == (50.0, 8.0), "nobody knows"


@pytest.mark.parametrize("sender", [{"system_id": 9}, {"component_id": 190}])
def test_position_of_other_senders_is_ignored(autopilot, sender):
    assert autopilot.position(1.0, 1.0, **sender) is None
    autopilot.position(3.0, 3.0)
    assert autopilot.position(4.0, 4.0, **sender).lat_deg == 3.0


@pytest.mark.parametrize("nowhere", [(0.0, 0.0), (91.0, 8.0), (50.0, 181.0)])
def test_position_lost_is_not_kept(autopilot, nowhere):
    assert autopilot.position()
    assert autopilot.position(*nowhere) is None


@pytest.mark.parametrize("message", [mavlink.MAVLink_gps_raw_int_message, mavlink.MAVLink_gps2_raw_message])
def test_position_reports_whether_gps_supports_it(autopilot, message):
    autopilot.gps(FIX_2D, message=message)
    assert not autopilot.position().has_gps
    autopilot.gps(message=message)
    assert autopilot.position(50.0003).has_gps, "33 m flown since its last report"
    assert not autopilot.position(50.001).has_gps, "it does not follow its receiver: jammed, deceived or switched off"
    autopilot.gps(message=message, lat_deg=50.001)
    assert autopilot.position(50.0011).has_gps
    autopilot.gps(mavlink.GPS_FIX_TYPE_NO_FIX, message=message)
    assert not autopilot.position(50.0012).has_gps, "it reckons where it is, and goes on saying so"
    autopilot.gps(message=message, lat_deg=50.0012)
    autopilot.wait(3.0)
    assert not autopilot.position(50.00121).has_gps, "its receiver has fallen silent"


def test_position_is_requested_until_it_arrives(autopilot):
    assert autopilot.questions() == [], "nobody wants to know"
    autopilot.conversation.request_position()
    version, *requests = autopilot.questions()
    assert (version.command, version.param1) == (mavlink.MAV_CMD_REQUEST_MESSAGE, 148)
    assert {command.command for command in requests} == {mavlink.MAV_CMD_SET_MESSAGE_INTERVAL}
    intervals_us = {int(command.param1): command.param2 for command in requests}
    slow_us = dict.fromkeys((132, 136, 193), 500_000)
    assert intervals_us == {33: 100_000, 30: 100_000, 24: 200_000, 124: 200_000} | slow_us
    assert all(command.target_system == 7 for command in requests)
    for _ in range(3):  # what is heard needs no asking, but the version, which it does not say
        autopilot.gps()
        autopilot.fly_on(seconds=4, attitude_hz=10)
        assert [each.command for each in autopilot.questions()] == [mavlink.MAV_CMD_REQUEST_MESSAGE]
    asked = []
    for _ in range(3):
        autopilot.wait(4.0)
        autopilot.beat()
        autopilot.position()
        asked += autopilot.questions()
    assert {int(each.param1) for each in asked} == set(intervals_us), "it says no attitude any more: it started anew"


def test_position_is_requested_again_after_a_change_of_rates(autopilot):
    autopilot.conversation.request_position()
    autopilot.questions()
    for attitude_hz, has_to_ask in ((10, False), (4, True), (10, False), (5, False)):
        autopilot.fly_on(seconds=5, attitude_hz=attitude_hz)
        asked = [each.param1 for each in autopilot.questions() if each.command == mavlink.MAV_CMD_SET_MESSAGE_INTERVAL]
        assert (mavlink.MAVLINK_MSG_ID_ATTITUDE in asked) is has_to_ask, attitude_hz


def test_gps_reports_that_have_stopped_are_requested_again(autopilot):
    autopilot.conversation.request_position()
    autopilot.gps()
    autopilot.questions()
    autopilot.fly_on(seconds=5, attitude_hz=10)
    asked = {each.param1 for each in autopilot.questions() if each.command == mavlink.MAV_CMD_SET_MESSAGE_INTERVAL}
    assert asked == {mavlink.MAVLINK_MSG_ID_GPS_RAW_INT, mavlink.MAVLINK_MSG_ID_GPS2_RAW}


@pytest.mark.parametrize(
    ("reports", "number"),
    [
        ([mavlink.MAVLink_gps_raw_int_message], mavlink.MAVLINK_MSG_ID_EKF_STATUS_REPORT),
        ([mavlink.MAVLink_gps_raw_int_message, mavlink.MAVLink_gps2_raw_message], mavlink.MAVLINK_MSG_ID_GPS2_RAW),
    ],
    ids=["filter", "second receiver"],
)
def test_any_report_that_has_stopped_is_requested_again(autopilot, reports, number):
    autopilot.conversation.request_position()
    for report in reports:
        autopilot.gps(message=report)
    autopilot.fly_on(seconds=6, attitude_hz=10)
    autopilot.questions()
    for _ in range(6):
        autopilot.gps()
        autopilot.fly_on(1, 10, None if number == mavlink.MAVLINK_MSG_ID_EKF_STATUS_REPORT else 831)
    asked = {each.param1 for each in autopilot.questions() if each.command == mavlink.MAV_CMD_SET_MESSAGE_INTERVAL}
    assert number in asked


def test_vehicle_at_the_time_of_an_old_frame_is_that_of_then(autopilot):
    start_s = autopilot.clock.now_s
    for roll_deg in range(60):
        autopilot.attitude(roll_deg, 0, 90)
        autopilot.position(50.0 + 1e-5 * roll_deg)
        autopilot.wait(0.1)
    seen = autopilot.predict(start_s + 1.05)
    assert (seen.roll_deg, seen.lat_deg) == (pytest.approx(10.5), pytest.approx(50.0001, abs=1e-7))
    assert seen.t_received_s == pytest.approx(start_s + 1.0)


def test_attitude_is_that_of_the_frame_time(autopilot):
    start_s = autopilot.clock.now_s
    for attitude in ((-10, 4, 350), (10, 8, 10), (20, 0, 20)):
        autopilot.attitude(*attitude)
        autopilot.position()
        autopilot.wait(0.2)
    seen = autopilot.predict(start_s + 0.05)
    assert (seen.roll_deg, seen.pitch_deg, seen.heading_deg) == pytest.approx((-5, 5, 355), abs=1e-4)
    assert autopilot.predict(start_s + 0.1).heading_deg % 360 == pytest.approx(0, abs=1e-4), "the short way over north"
    last = autopilot.predict(start_s + 0.65)
    assert (last.roll_deg, last.heading_deg) == pytest.approx((20, 20), abs=1e-4), "the last one holds for 0.3 s"
    for away_s in (-0.35, 0.75):
        other = autopilot.predict(start_s + away_s)
        assert (other.roll_deg, other.pitch_deg, other.heading_deg) == (None, None, 90.5), "the report's own heading"
    assert autopilot.vehicle.roll_deg is None


@pytest.mark.parametrize(
    ("roll_deg", "pitch_deg_s", "yaw_deg_s", "step_deg"), [(0, 0, 0, 20), (0, 0, 100, 0), (60, 86.6, 50, 0)]
)
def test_heading_steps_where_the_gyros_do_not_turn(autopilot, roll_deg, pitch_deg_s, yaw_deg_s, step_deg):
    for yaw_deg in (350, 10):
        autopilot.attitude(roll_deg, 0, yaw_deg, pitch_deg_s, yaw_deg_s)
        autopilot.wait(0.2)
    assert autopilot.position().heading_step_deg == pytest.approx(step_deg, abs=0.1)


def test_height_uses_the_best_source(autopilot):
    assert autopilot.position().height_m == 80.0, "over the take-off point"
    autopilot.terrain(65.0)
    assert autopilot.position().height_m == 65.0
    autopilot.range(60.0)
    assert autopilot.position().height_m == 60.0
    autopilot.attitude(roll_deg=60.0)
    autopilot.range(60.0)
    assert autopilot.position().height_m == pytest.approx(30.0, abs=0.01), "a range finder looks where it leans"
    autopilot.wait(1.1)
    assert autopilot.position().height_m == 65.0, "the range is old"
    autopilot.wait(2.0)
    assert autopilot.position().height_m == 80.0, "the terrain is old too"
    for height_m, spacing in ((math.nan, 100), (0.0, 0)):
        autopilot.terrain(height_m, spacing)
        assert autopilot.position().height_m == 80.0, "it is not known there"


@pytest.mark.parametrize("bad", [{"distance_m": 0.1}, {"distance_m": 120.0}, {"orientation": 0}, {"signal_quality": 1}])
def test_height_ignores_an_invalid_range(autopilot, bad):
    autopilot.range(**{"distance_m": 60.0} | bad)
    assert autopilot.position().height_m == 80.0


@pytest.mark.parametrize("message", [mavlink.MAVLink_gps_raw_int_message, mavlink.MAVLink_gps2_raw_message])
@pytest.mark.parametrize(("h_acc", "sd_m"), [(1800, 1.8), (0, DEFAULT_GPS_SD_M), (2**32 - 1, DEFAULT_GPS_SD_M)])
def test_position_sd_with_gps_is_that_of_the_receiver(autopilot, message, h_acc, sd_m):
    autopilot.filter(ABS | REL)
    assert autopilot.sd_m() is None, "never known"
    autopilot.gps(h_acc=9000)
    autopilot.gps(h_acc=h_acc, message=message)
    assert autopilot.sd_m() == pytest.approx(sd_m), "the better one counts"


@pytest.mark.parametrize("flags", [0, CONST_POS, ABS | REL | CONST_POS, mavlink.EKF_ATTITUDE])
def test_position_sd_is_unknown_once_the_filter_has_no_position(autopilot, flags):
    autopilot.gps()
    autopilot.sd_m()
    autopilot.gps(fix_type=1)
    autopilot.filter(flags)
    assert autopilot.sd_m() is None
    autopilot.filter(REL)
    assert autopilot.sd_m() is None, "where it had stood still meanwhile, it does not know"
    autopilot.gps()
    assert autopilot.sd_m() == DEFAULT_GPS_SD_M


def test_position_sd_grows_from_an_accepted_fix(autopilot):
    autopilot.gps()
    autopilot.sd_m()
    autopilot.gps(fix_type=1)
    autopilot.wait(100.0)
    autopilot.take_fix(FAILED)
    assert autopilot.sd_m() > 200
    autopilot.take_fix(ACCEPTED, accuracy_m=12.0)
    assert autopilot.sd_m() == pytest.approx(12.0)
    autopilot.wait(4.0)
    assert autopilot.sd_m() == pytest.approx(math.hypot(12.0, DRIFT_M_S * 4))


def test_position_sd_is_that_of_the_filter_while_it_is_reported(autopilot):
    autopilot.gps(h_acc=3000)
    autopilot.sd_m()
    autopilot.gps(fix_type=1)
    autopilot.wait(10.0)
    for accuracy_m in (0.0, math.nan, math.inf):
        autopilot.px4_filter(accuracy_m)
        assert autopilot.sd_m() == pytest.approx(math.hypot(3.0, DRIFT_M_S * 10)), "it grows since GPS was lost"
    autopilot.px4_filter(14.0)
    assert autopilot.sd_m() == 14.0
    autopilot.wait(5.0)
    autopilot.filter(REL)
    assert autopilot.sd_m() == pytest.approx(math.hypot(3.0, DRIFT_M_S * 15)), "it says no accuracy, and reckons"


def test_vehicle_is_reset_for_another_autopilot(autopilot):
    autopilot.gps()
    assert autopilot.sd_m() == DEFAULT_GPS_SD_M
    for _ in range(5):
        autopilot.put_fix()
    autopilot.wait(30.0)
    elsewhere = {"address": ("127.0.0.1", 9)}
    for _ in range(6):
        autopilot.wait(1.0)
        autopilot.beat(**elsewhere)
    assert autopilot.vehicle is None
    assert autopilot.position(**elsewhere).position_sd_m is None
    assert autopilot.put_fix(**elsewhere).sent
