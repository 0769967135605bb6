"""The simulated flight controller and a real ArduPilot do the same: the same tests fly both.

The real one takes part where EDGEVPR_ARDUPILOT names the folder of a built ArduPilot with build/sitl/bin/arduplane and
arducopter, which takes some minutes.
"""

import math
import statistics

import pytest
from pilots import ARDUPILOT, pilot_of

from edgevpr.geodesy import moved
from edgevpr.mavlink.wire import mavlink

ACCEPTED, DENIED, FAILED = (getattr(mavlink, f"MAV_RESULT_{name}") for name in ("ACCEPTED", "DENIED", "FAILED"))
TAKEOFF_MODE, GUIDED, LAND = 13, 4, 9
ATTITUDE, VERSION, NO_MESSAGE = 30, 148, 60_000

without = pytest.mark.skipif(not ARDUPILOT, reason="EDGEVPR_ARDUPILOT names no built ArduPilot")
both = pytest.fixture(scope="module", params=["simulated", pytest.param("real", marks=without)])


@both
def plane(request, tmp_path_factory):
    """A plane that circles."""
    pilot = pilot_of(request.param, "plane", {"SIM_WIND_SPD": 0}, tmp_path_factory.mktemp("plane"))
    try:
        pilot.wait_ready()
        pilot.arm(TAKEOFF_MODE)
        pilot.wait_height(40)
        yield pilot
    finally:
        pilot.close()


@both
def copter(request, tmp_path_factory):
    """A copter on the ground, whose second GPS comes over the link."""
    pilot = pilot_of(request.param, "copter", {"GPS2_TYPE": 14, "GPS_AUTO_SWITCH": 1}, tmp_path_factory.mktemp("copter"))
    try:
        pilot.wait_ready()
        yield pilot
    finally:
        pilot.close()


def test_it_says_what_it_is(plane):
    assert plane.last["HEARTBEAT"].autopilot == mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA
    assert plane.last["HEARTBEAT"].type == mavlink.MAV_TYPE_FIXED_WING
    assert plane.command(512, VERSION) == ACCEPTED
    version = plane.until(lambda: plane.last.get("AUTOPILOT_VERSION"), "the version").flight_sw_version
    assert (version >> 24, version >> 16 & 255) == (4, 7)
    assert plane.command(512, NO_MESSAGE) == FAILED


def test_a_message_comes_at_the_interval_that_was_asked_for(plane):
    for interval_s in (0.2, 0.1):
        assert plane.command(511, ATTITUDE, interval_s * 1e6) == ACCEPTED
        plane.next("ATTITUDE")
        times_ms = [plane.next("ATTITUDE").time_boot_ms for _ in range(15)]
        steps_ms = [after - before for before, after in zip(times_ms, times_ms[1:], strict=False)]
        assert statistics.median(steps_ms) == pytest.approx(1000 * interval_s, rel=0.3)
    assert plane.command(511, ATTITUDE, -1) == ACCEPTED
    plane.wait(1)
    before = sum(message.get_type() == "ATTITUDE" for message in plane.heard)
    plane.wait(2)
    assert sum(message.get_type() == "ATTITUDE" for message in plane.heard) == before
    assert plane.command(511, NO_MESSAGE, 100_000) == DENIED


def test_parameters_can_be_read_and_set(plane):
    assert plane.get("SIM_GPS1_ENABLE") == 1
    plane.set("SIM_WIND_DIR", 270)
    assert plane.get("SIM_WIND_DIR") == 270
    plane.send(mavlink.MAVLink_param_request_read_message(1, 1, b"NO_SUCH_NAME", -1))
    plane.send(mavlink.MAVLink_param_request_read_message(1, 1, b"", 0))
    first = plane.next("PARAM_VALUE", lambda said: said.param_index == 0)
    assert first.param_count > 10
    assert "NO_SUCH_NAME" not in {each.param_id for each in plane.heard if each.get_type() == "PARAM_VALUE"}


def test_time_is_told(plane):
    plane.send(mavlink.MAVLink_timesync_message(0, 12_345))
    assert plane.next("TIMESYNC", lambda said: said.ts1 == 12_345).tc1 > 0


def test_with_gps_no_fix_is_taken(plane):
    assert plane.fix(*plane.true_place) == FAILED
    assert plane.error_m < 5


def test_a_fix_of_the_wrong_form_is_denied(plane):
    assert plane.fix(*plane.true_place, frame=3) == DENIED, "relative to home"
    assert plane.fix(*plane.true_place, frame=6) == DENIED
    assert plane.fix(*plane.true_place, z=100.0) == DENIED
    assert plane.fix(*plane.true_place, frame=5) == FAILED, "the form is right, the time is not"


def test_a_glitch_moves_what_gps_says(plane):
    def north_of_truth_deg():
        seen = plane.next("GPS_RAW_INT", lambda gps: gps.fix_type >= 3)
        return seen.lat / 1e7 - plane.true_place[0]

    assert abs(north_of_truth_deg()) < 2e-4
    plane.set("SIM_GPS1_GLTCH_X", 0.001)
    plane.wait(1)
    assert north_of_truth_deg() == pytest.approx(0.001, abs=2e-4)
    plane.set("SIM_GPS1_GLTCH_X", 0)
    plane.until(lambda: plane.error_m < 5, "the right place again")


def test_a_plane_without_gps_drifts_with_the_wind_and_a_fix_brings_it_back(plane):
    plane.set("SIM_GPS1_ENABLE", 0)
    plane.set("SIM_WIND_SPD", 6)
    plane.wait(25)
    assert plane.flags & mavlink.EKF_POS_HORIZ_REL
    assert not plane.flags & mavlink.EKF_POS_HORIZ_ABS
    assert not plane.flags & mavlink.EKF_CONST_POS_MODE
    assert plane.next("GPS_RAW_INT").fix_type < 3
    plane.wait(20)
    before_m = plane.error_m
    assert before_m > 20
    assert plane.fix(*plane.true_place) == ACCEPTED
    plane.next("GLOBAL_POSITION_INT")
    plane.next("GLOBAL_POSITION_INT")
    assert plane.error_m < 8
    plane.wait(10)
    assert plane.error_m > 5, "it drifts on"


def test_a_late_fix_is_brought_forward(plane):
    plane.wait(3)
    then_s, *place = next(each for each in plane.truths if each[0] >= plane.now_s - 2)
    assert plane.fix(*place, age_s=plane.now_s - then_s) == ACCEPTED
    plane.next("GLOBAL_POSITION_INT")
    plane.next("GLOBAL_POSITION_INT")
    assert plane.error_m < 15, "the plane has flown 40 m, on a curve"


def test_with_gps_again_all_is_well(plane):
    plane.set("SIM_GPS1_ENABLE", 1)
    plane.until(lambda: plane.flags & mavlink.EKF_POS_HORIZ_ABS and plane.error_m < 5, "the right place again")
    plane.wait(1)
    assert plane.fix(*plane.true_place) == FAILED


def test_a_second_gps_must_report_before_arming(copter):
    copter.command(mavlink.MAV_CMD_DO_SET_MODE, 1, GUIDED)
    copter.until(lambda: any("GPS 2: Bad fix" in text for text in copter.texts) or not _tried(copter), "GPS 2: Bad fix")


def _tried(copter) -> bool:
    """Try to arm; it must not."""
    assert copter.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1) == FAILED
    return False


def test_a_second_gps_takes_over(copter):
    copter.on_truth = lambda truth: _play_gps(copter, truth)
    copter.wait(10)
    copter.arm(GUIDED)
    assert copter.command(mavlink.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, 20) == ACCEPTED
    copter.wait_height(18)
    copter.set("SIM_GPS1_ENABLE", 0)
    copter.wait(25)
    assert copter.error_m < 3
    assert copter.flags & mavlink.EKF_POS_HORIZ_ABS
    assert copter.last["HEARTBEAT"].custom_mode == GUIDED


def test_a_jump_of_the_second_gps_is_not_followed_at_once(copter):
    copter.on_truth = lambda truth: _play_gps(copter, truth, east_m=25.0)
    copter.wait(4)
    assert copter.error_m < 8
    assert copter.last["EKF_STATUS_REPORT"].pos_horiz_variance > 1
    copter.on_truth = lambda truth: _play_gps(copter, truth)
    copter.wait(5)
    assert copter.last["EKF_STATUS_REPORT"].pos_horiz_variance < 1


def test_a_copter_without_any_gps_lands_and_no_fix_prevents_that(copter):
    copter.on_truth = None
    begin_s = copter.now_s
    copter.wait(4)
    assert copter.fix(*copter.true_place) == ACCEPTED
    copter.until(lambda: copter.last["HEARTBEAT"].custom_mode == LAND, "LAND", patience_s=20)
    assert copter.now_s - begin_s < 16
    assert any("EKF variance" in text for text in copter.texts)
    assert not copter.flags & (mavlink.EKF_POS_HORIZ_REL | mavlink.EKF_POS_HORIZ_ABS)
    copter.until(lambda: copter.flags & mavlink.EKF_CONST_POS_MODE, "the end of aiding", patience_s=20)
    assert copter.fix(*copter.true_place) == FAILED
    copter.next("GLOBAL_POSITION_INT")


def _play_gps(copter, truth, east_m: float = 0.0) -> None:
    """Send the true position as a second GPS would."""
    lat_deg, lon_deg = moved(truth.lat_int / 1e7, truth.lon_int / 1e7, east_m, 0.0)
    ms = round(copter.now_s * 1000)
    copter.send(
        mavlink.MAVLink_gps_input_message(
            time_usec=ms * 1000,
            gps_id=1,
            ignore_flags=0,
            time_week_ms=ms,
            time_week=2300,
            fix_type=3,
            lat=round(lat_deg * 1e7),
            lon=round(lon_deg * 1e7),
            alt=truth.alt,
            hdop=0.8,
            vdop=1.0,
            vn=truth.vn,
            ve=truth.ve,
            vd=truth.vd,
            speed_accuracy=0.3,
            horiz_accuracy=1.0,
            vert_accuracy=1.0,
            satellites_visible=12,
        )
    )
