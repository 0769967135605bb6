"""The simulated flight controller and a real ArduPilot do the same: the same tests fly both.

The real one takes part where EDGEVPR_ARDUPILOT names the folder of a built ArduPilot with build/sitl/bin/arduplane and
arducopter, which takes some minutes.
"""

import math
import statistics
from itertools import pairwise

import pytest
from pilots import ARDUPILOT, FIX, pilot_of, state_at

from edgevpr.core.geodesy import moved
from edgevpr.mavlink import messages
from edgevpr.mavlink.wire import mavlink

ACCEPTED, DENIED, FAILED, UNSUPPORTED = (
    getattr(mavlink, f"MAV_RESULT_{name}") for name in ("ACCEPTED", "DENIED", "FAILED", "UNSUPPORTED")
)
TAKEOFF_MODE, GUIDED = 13, 4
ATTITUDE, VERSION, NO_MESSAGE = 30, 148, 60_000

without = pytest.mark.skipif(not ARDUPILOT, reason="EDGEVPR_ARDUPILOT names no built ArduPilot")


def flies(kind: str, **parameters: float):
    """Let a test have a `pilot` at a vehicle of a kind, simulated and real. All tests of a kind are one flight."""
    named = tuple(parameters.items())
    params = [("simulated", kind, named), pytest.param(("real", kind, named), marks=without)]
    return pytest.mark.parametrize("pilot", params, ids=["simulated", "real"], indirect=True)


plane = flies("plane")
copter = flies("copter", GPS2_TYPE=14, GPS_AUTO_SWITCH=1)


@pytest.fixture(scope="module")
def pilot(request, tmp_path_factory):
    """A plane that circles, or a copter on the ground whose second GPS comes over the link."""
    which, kind, parameters = request.param
    pilot = pilot_of(which, f"ardu{kind}", dict(parameters), tmp_path_factory.mktemp(kind))
    try:
        pilot.wait_ready()
        if kind == "plane":
            pilot.arm(TAKEOFF_MODE)
            pilot.wait_height(40)
        yield pilot
    finally:
        pilot.close()


@plane
def test_heartbeat_and_version_name_the_firmware(pilot):
    assert pilot.last["HEARTBEAT"].autopilot == mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA
    assert pilot.last["HEARTBEAT"].type == mavlink.MAV_TYPE_FIXED_WING
    assert pilot.command(512, VERSION) == ACCEPTED
    version = pilot.until(lambda: pilot.last.get("AUTOPILOT_VERSION"), "the version").flight_sw_version
    assert (version >> 24, version >> 16 & 255) == (4, 7)
    assert pilot.command(512, NO_MESSAGE) == FAILED


@plane
def test_message_interval_sets_the_rate_of_a_message(pilot):
    for interval_s in (0.2, 0.1):
        assert pilot.command(511, ATTITUDE, interval_s * 1e6) == ACCEPTED
        pilot.next("ATTITUDE")
        times_ms = [pilot.next("ATTITUDE").time_boot_ms for _ in range(15)]
        steps_ms = [after - before for before, after in pairwise(times_ms)]
        assert statistics.median(steps_ms) == pytest.approx(1000 * interval_s, rel=0.3)
    assert pilot.command(511, ATTITUDE, -1) == ACCEPTED
    pilot.wait(1)
    before = sum(message.get_type() == "ATTITUDE" for message in pilot.heard)
    pilot.wait(2)
    assert sum(message.get_type() == "ATTITUDE" for message in pilot.heard) == before
    assert pilot.command(511, NO_MESSAGE, 100_000) == DENIED


@plane
def test_parameters_are_read_and_set(pilot):
    assert pilot.get("SIM_GPS1_ENABLE") == 1
    pilot.set("SIM_WIND_DIR", 270)
    assert pilot.get("SIM_WIND_DIR") == 270
    pilot.send(mavlink.MAVLink_param_request_read_message(1, 1, b"NO_SUCH_NAME", -1))
    pilot.send(mavlink.MAVLink_param_request_read_message(1, 1, b"", 0))
    first = pilot.next("PARAM_VALUE", lambda said: said.param_index == 0)
    assert first.param_count > 10
    assert "NO_SUCH_NAME" not in {each.param_id for each in pilot.heard if each.get_type() == "PARAM_VALUE"}


@plane
def test_timesync_is_answered(pilot):
    pilot.send(mavlink.MAVLink_timesync_message(0, 12_345))
    assert pilot.next("TIMESYNC", lambda said: said.ts1 == 12_345).tc1 > 0


@plane
def test_fix_of_the_wrong_form_is_denied(pilot):
    assert pilot.fix(*pilot.true_place, frame=3) == DENIED, "relative to home"
    assert pilot.fix(*pilot.true_place, frame=6) == DENIED
    assert pilot.fix(*pilot.true_place, z=100.0) == DENIED
    assert pilot.fix(*pilot.true_place, frame=5) == FAILED, "the form is right, the time is not"


@plane
def test_fix_as_command_long_is_unsupported_as_is_an_unknown_command(pilot):
    assert pilot.command(FIX, 0, 0, 5, 0, *pilot.true_place) == UNSUPPORTED
    assert pilot.command(31_999) == UNSUPPORTED


@plane
def test_glitch_moves_the_position_of_gps(pilot):
    def north_of_truth_deg():
        seen = pilot.next("GPS_RAW_INT", lambda gps: gps.fix_type >= 3)
        return seen.lat / 1e7 - pilot.true_place[0]

    assert abs(north_of_truth_deg()) < 2e-4
    pilot.set("SIM_GPS1_GLTCH_X", 0.001)
    pilot.wait(1)
    assert north_of_truth_deg() == pytest.approx(0.001, abs=2e-4)
    pilot.set("SIM_GPS1_GLTCH_X", 0)
    pilot.until(lambda: pilot.error_m < 5, "the right place again")


@plane
def test_plane_without_gps_drifts_with_the_wind_and_a_fix_brings_it_back(pilot):
    pilot.set("SIM_GPS1_ENABLE", 0)
    pilot.set("SIM_WIND_SPD", 6)
    pilot.wait(25)
    assert pilot.flags & mavlink.EKF_POS_HORIZ_REL
    assert not pilot.flags & mavlink.EKF_POS_HORIZ_ABS
    assert not pilot.flags & mavlink.EKF_CONST_POS_MODE
    assert pilot.next("GPS_RAW_INT").fix_type < 3
    pilot.wait(20)
    assert pilot.error_m > 20
    assert pilot.fix(*pilot.true_place, param3=math.nan) == ACCEPTED, "an accuracy may be missing"
    assert pilot.fix(*pilot.true_place) == ACCEPTED
    pilot.next("GLOBAL_POSITION_INT")
    pilot.next("GLOBAL_POSITION_INT")
    assert pilot.error_m < 8
    pilot.wait(10)
    assert pilot.error_m > 5, "it drifts on"


@plane
def test_fix_that_is_late_is_brought_forward(pilot):
    pilot.wait(3)
    then_s, *place = next(each for each in pilot.truths if each[0] >= pilot.now_s - 2)
    assert pilot.fix(*place, age_s=pilot.now_s - then_s) == ACCEPTED
    pilot.next("GLOBAL_POSITION_INT")
    pilot.next("GLOBAL_POSITION_INT")
    assert pilot.error_m < 30, "the plane has flown 44 m since, on a curve and in the wind"


@plane
def test_gps_that_is_back_is_used_again(pilot):
    pilot.set("SIM_GPS1_ENABLE", 1)
    pilot.until(lambda: pilot.flags & mavlink.EKF_POS_HORIZ_ABS and pilot.error_m < 5, "the right place again")
    pilot.wait(1)
    assert pilot.fix(*pilot.true_place) == FAILED


@copter
def test_second_gps_takes_over(pilot):
    pilot.on_truth = lambda truth: _play_gps(pilot, truth)
    pilot.wait(10)
    pilot.arm(GUIDED)
    assert pilot.command(mavlink.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, 20) == ACCEPTED
    pilot.wait_height(18)
    pilot.set("SIM_GPS1_ENABLE", 0)
    pilot.wait(25)
    assert pilot.error_m < 3
    assert pilot.flags & mavlink.EKF_POS_HORIZ_ABS


@copter
def test_second_gps_that_jumps_is_not_followed_at_once(pilot):
    pilot.on_truth = lambda truth: _play_gps(pilot, truth, east_m=25.0)
    pilot.wait(4)
    assert pilot.error_m < 8
    assert pilot.last["EKF_STATUS_REPORT"].pos_horiz_variance > 1
    pilot.on_truth = lambda truth: _play_gps(pilot, truth)
    pilot.wait(5)
    assert pilot.last["EKF_STATUS_REPORT"].pos_horiz_variance < 1


@copter
def test_copter_without_any_gps_loses_its_position_in_spite_of_a_fix(pilot):
    pilot.on_truth = None
    begin_s, has_position = pilot.now_s, mavlink.EKF_POS_HORIZ_REL | mavlink.EKF_POS_HORIZ_ABS
    pilot.wait(4)
    assert pilot.fix(*pilot.true_place) == ACCEPTED
    pilot.until(lambda: not pilot.flags & has_position, "the end of the position", patience_s=20)
    assert pilot.now_s - begin_s < 16
    pilot.until(lambda: pilot.flags & mavlink.EKF_CONST_POS_MODE, "the end of aiding", patience_s=20)
    assert pilot.fix(*pilot.true_place) == FAILED
    pilot.next("GLOBAL_POSITION_INT")


def _play_gps(pilot, truth, east_m: float = 0.0) -> None:
    """Send the true position as a second GPS would."""
    at = *moved(truth.lat_int / 1e7, truth.lon_int / 1e7, east_m, 0.0), truth.alt
    message = messages.gps_input(state_at(pilot.now_s, *at, (truth.ve, truth.vn, truth.vd)), 1, pilot.now_s, 1.7e9)
    message.satellites_visible = 12
    pilot.send(message)
