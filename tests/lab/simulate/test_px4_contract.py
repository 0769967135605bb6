"""The simulated PX4 and a real one do the same on the pad: the same tests hold both. The rig flies a real one.

The real one takes part where EDGEVPR_PX4 names the folder of a built PX4 with bin/px4 (1.17.0 or 1.18.0-beta1).
"""

import math
import struct

import pytest
from pilots import PX4, pilot_of, state_at

from edgevpr.core.geodesy import distance_m, moved
from edgevpr.mavlink import messages
from edgevpr.mavlink.wire import mavlink, parameter_value

ACCEPTED, NOT_NOW = mavlink.MAV_RESULT_ACCEPTED, mavlink.MAV_RESULT_TEMPORARILY_REJECTED
VERSION, GPS, POSITION, ESTIMATOR, IMU = 148, 24, 33, 230, 26
KNOWN = mavlink.ESTIMATOR_ATTITUDE | mavlink.ESTIMATOR_POS_HORIZ_ABS
FUSES, FUSES_ANY = mavlink.ESTIMATOR_PRED_POS_HORIZ_ABS, mavlink.ESTIMATOR_PRED_POS_HORIZ_REL
AT_REST = mavlink.ESTIMATOR_CONST_POS_MODE

SET_UP = {"EKF2_AGP0_CTRL": 1, "EKF2_AGP0_ID": 1}  # a slot is opened at the start only

without = pytest.mark.skipif(not PX4, reason="EDGEVPR_PX4 names no built PX4")


@pytest.fixture(scope="module", params=["simulated", pytest.param("real", marks=without)])
def pilot(request, tmp_path_factory):
    """A copter on the pad that knows where it is by GPS."""
    pilot = pilot_of(request.param, "px4-copter", SET_UP, tmp_path_factory.mktemp("px4"))
    try:
        for number, rate_hz in ((GPS, 5), (POSITION, 10), (ESTIMATOR, 5), (IMU, 25)):
            assert pilot.command(511, number, 1e6 / rate_hz) == ACCEPTED
        pilot.until(lambda: flags(pilot) & (KNOWN | FUSES) == KNOWN | FUSES, "a position", patience_s=120)
        yield pilot
    finally:
        pilot.close()


def flags(pilot):
    said = pilot.last.get("ESTIMATOR_STATUS")
    return said.flags if said else 0


def place(pilot):
    said = pilot.next("GLOBAL_POSITION_INT")
    return said.lat / 1e7, said.lon / 1e7


def whole(pilot, name):
    pilot.send(mavlink.MAVLink_param_request_read_message(1, 1, name.encode(), -1))
    return parameter_value(pilot.next("PARAM_VALUE", lambda said: said.param_id == name), bytewise=True)


def set_whole(pilot, name, value):
    told = struct.unpack("<f", struct.pack("<i", value))[0]
    pilot.send(mavlink.MAVLink_param_set_message(1, 1, name.encode(), told, mavlink.MAV_PARAM_TYPE_INT32))
    pilot.until(lambda: whole(pilot, name) == value, name)


def version_of(pilot):
    assert pilot.command(512, VERSION) == ACCEPTED
    version = pilot.until(lambda: pilot.last.get("AUTOPILOT_VERSION"), "the version").flight_sw_version
    return version >> 24, version >> 16 & 255


def test_heartbeat_and_version_name_the_firmware(pilot):
    assert pilot.last["HEARTBEAT"].autopilot == mavlink.MAV_AUTOPILOT_PX4
    assert version_of(pilot) in ((1, 17), (1, 18))


def test_filter_on_the_pad_is_at_rest_and_fuses_gps(pilot):
    assert pilot.next("GPS_RAW_INT").fix_type >= mavlink.GPS_FIX_TYPE_3D_FIX
    assert flags(pilot) & (KNOWN | FUSES | AT_REST) == KNOWN | FUSES | AT_REST
    assert 0 < pilot.last["ESTIMATOR_STATUS"].pos_horiz_accuracy < 5


def test_scaled_imu_has_the_specific_force(pilot):
    felt = pilot.next("SCALED_IMU")
    assert felt.zacc == pytest.approx(-1000, abs=100)
    assert abs(felt.xacc) < 100


def test_fix_without_an_age_is_not_taken(pilot):
    assert pilot.fix(*place(pilot), param2=math.nan) == NOT_NOW


def test_fix_is_taken_with_gps_too(pilot):
    assert pilot.fix(*moved(*place(pilot), 0.5, 0.0)) == ACCEPTED


@pytest.fixture
def unused_gps(pilot):
    """The pilot at a vehicle that does not use its GPS until the end of the test."""
    set_whole(pilot, "EKF2_GPS_CTRL", 0)
    pilot.until(lambda: not flags(pilot) & FUSES, "no GPS in use")
    yield pilot
    set_whole(pilot, "EKF2_EV_CTRL", 0)
    set_whole(pilot, "EKF2_GPS_CTRL", 7)
    pilot.until(lambda: flags(pilot) & FUSES, "GPS in use again")


def test_flags_alone_show_a_receiver_that_is_not_used(unused_gps):
    """This is how edgevpr knows that it is to send."""
    assert unused_gps.next("GPS_RAW_INT").fix_type >= mavlink.GPS_FIX_TYPE_3D_FIX


def assert_fused_and_unanswered(pilot, make_message, fused):
    """Send positions 2 m north of the vehicle for 6 s: its flags say that they are fused, and it moves there."""
    pilot.wait(6)
    there = moved(*place(pilot), 0.0, 2.0)
    answered = sum(message.get_type() == "COMMAND_ACK" for message in pilot.heard)
    for _ in range(60):
        pilot.send(make_message(state_at(pilot.now_s, *there, alt_m=0.0)))
        pilot.wait(0.1)
    assert flags(pilot) & (FUSES | FUSES_ANY) == fused
    assert distance_m(*place(pilot), *there) < 1.5
    assert sum(message.get_type() == "COMMAND_ACK" for message in pilot.heard) == answered


def test_odometry_is_fused_by_another_flag_and_never_answered(unused_gps):
    pilot = unused_gps
    set_whole(pilot, "EKF2_EV_CTRL", 1)
    assert pilot.command(512, mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN) == ACCEPTED
    said = pilot.until(lambda: pilot.last.get("GPS_GLOBAL_ORIGIN"), "the origin")
    origin = said.latitude / 1e7, said.longitude / 1e7, said.altitude / 1e3
    assert_fused_and_unanswered(pilot, lambda state: messages.vision_position(state, origin), FUSES_ANY)
    pilot.until(lambda: not flags(pilot) & FUSES_ANY, "an end of it")


def test_message_296_is_fused_and_never_answered(unused_gps):
    if version_of(unused_gps) < (1, 18):
        pytest.skip("1.17.0 has no message 296")
    assert_fused_and_unanswered(unused_gps, messages.position_sensor, FUSES | FUSES_ANY)
