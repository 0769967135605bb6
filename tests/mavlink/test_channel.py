"""The channel by which an autopilot is told positions: asked for, chosen, and used."""

from dataclasses import replace

import numpy as np
import pytest
from scripted_autopilot import ARMED, STATE, Autopilot, RecordingListener
from simulated.firmware import ARDUPILOT as ARDUPILOT_PARAMETERS
from simulated.firmware import PX4 as PX4_PARAMETERS

from edgevpr.core.geodesy import offset_m
from edgevpr.core.reasons import ReasonCode
from edgevpr.core.types import Position
from edgevpr.mavlink.ardupilot_parameters import choose_ardupilot_channel
from edgevpr.mavlink.channel import Channel, VehicleKind
from edgevpr.mavlink.messages import Fix
from edgevpr.mavlink.wire import mavlink

ARDUPILOT = mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA
PX4 = mavlink.MAV_AUTOPILOT_PX4


def test_choose_ardupilot_channel_uses_our_receiver_and_its_configured_delay():
    second = choose_ardupilot_channel(VehicleKind.COPTER, {"GPS1_TYPE": 1, "GPS2_TYPE": 14, "GPS2_DELAY_MS": 0})
    assert (second.receiver, second.lag_s) == (1, 0.2)
    needed = choose_ardupilot_channel(VehicleKind.COPTER, {"GPS1_TYPE": 1}).reason
    assert (needed.code, needed.parameters["change"]) == (ReasonCode.COMMAND_NEEDS_FLOW, "GPS2_TYPE=14")
    first = choose_ardupilot_channel(VehicleKind.COPTER, {"GPS_TYPE": 14, "GPS_TYPE2": 1, "GPS_DELAY_MS": 60})
    assert (first.receiver, first.lag_s) == (0, 0.06)


def interview(firmware=ARDUPILOT, seconds=3, *, origin=None, **parameters):
    """An autopilot with `parameters` beside those of its firmware, once it has answered; and the listener."""
    ear = RecordingListener()
    autopilot = Autopilot(firmware, listener=ear, origin=origin)
    autopilot.conversation.request_position()
    for _ in range(seconds * 4):
        autopilot.wait(0.25)
        autopilot.beat()
        autopilot.reply((PX4_PARAMETERS if firmware == PX4 else ARDUPILOT_PARAMETERS) | parameters)
    return autopilot, ear


def collect(autopilot, name, seconds=1.0):
    """The messages of this name that are sent meanwhile."""
    messages = []
    for _ in range(round(seconds * 40)):
        autopilot.wait(0.025)
        messages += [message for message in autopilot.take_sent() if message.get_type() == name]
    return messages


def test_copter_with_our_receiver_gets_ten_positions_a_second():
    autopilot, ear = interview(GPS2_TYPE=14)
    assert ear.channels == [Channel.NONE, Channel.GPS_INPUT]
    positions = collect(autopilot, "GPS_INPUT", 2.0)
    assert len(positions) == pytest.approx(20, abs=1)
    assert {(each.gps_id, each.lat, each.time_week, each.fix_type) for each in positions} == {(1, 470_000_000, 0, 3)}
    autopilot.send(mavlink.MAVLink_system_time_message(1_700_000_000_000_000, 0))
    ear.state = None
    last = collect(autopilot, "GPS_INPUT")[-1]
    assert (last.fix_type, last.time_week) == (mavlink.GPS_FIX_TYPE_NO_FIX, 2288)
    # What the receiver says that is us is no GPS; what the other says is.
    autopilot.gps(message=mavlink.MAVLink_gps2_raw_message)
    assert not autopilot.position().has_gps
    autopilot.gps()
    assert autopilot.position().has_gps


def test_odometry_waits_for_an_origin_and_sets_one_if_allowed():
    autopilot, ear = interview(VISO_TYPE=1, EK3_SRC2_POSXY=6, origin=Position(46.5, 7.5, 400.0))
    assert ear.channels == [Channel.NONE, Channel.ODOMETRY]
    assert collect(autopilot, "ODOMETRY", 2.0) == []
    for _ in range(2):
        autopilot.beat()
        collect(autopilot, "ODOMETRY", 4.0)
    assert autopilot.conversation.sent["SET_GPS_GLOBAL_ORIGIN"] == 2, "the first one may be too early"
    autopilot.send(mavlink.MAVLink_gps_global_origin_message(465_000_000, 75_000_000, 400_000))
    autopilot.beat()
    assert len(collect(autopilot, "ODOMETRY")) == pytest.approx(10, abs=1)
    assert autopilot.conversation.sent["SET_GPS_GLOBAL_ORIGIN"] == 2


def test_origin_from_the_pressure_in_flight_has_the_altitude_of_the_ground():
    autopilot, _ = interview(VISO_TYPE=1, seconds=6, origin=Position(46.5, 7.5))
    autopilot.locate((0.0, 0.0), 0.0, 100.0)
    autopilot.send(mavlink.MAVLink_scaled_pressure_message(0, 945.0, 0, 2000))
    origins = []
    for _ in range(12):
        autopilot.beat()
        origins += [message.altitude / 1e3 for message in collect(autopilot, "SET_GPS_GLOBAL_ORIGIN")]
    assert {round(alt_m) for alt_m in origins} == {484}


def test_origin_without_altitude_uses_the_pressure_altitude():
    autopilot, ear = interview(VISO_TYPE=1, seconds=6, origin=Position(46.5, 7.5))
    asked = mavlink.MAVLINK_MSG_ID_SCALED_PRESSURE
    for _ in range(4):
        autopilot.beat()
        requests = [message for message in collect(autopilot, "COMMAND_LONG", 4.0) if message.param1 == asked]
    assert requests
    assert "SET_GPS_GLOBAL_ORIGIN" not in autopilot.conversation.sent
    autopilot.send(mavlink.MAVLink_scaled_pressure_message(0, 945.0, 0, 2000))
    origins, texts = [], []
    for _ in range(12):
        autopilot.beat()
        autopilot.wait(1.0)
        told = autopilot.take_sent()
        origins += [message.altitude / 1e3 for message in told if message.get_type() == "SET_GPS_GLOBAL_ORIGIN"]
        texts += [message.text for message in told if message.get_type() == "STATUSTEXT"]
    assert {round(alt_m) for alt_m in origins} == {584}
    assert [text[-6:] for text in texts] == [" 584 m"]
    # Whatever that altitude is: positions and heights of ours are the same.
    ear.state = replace(STATE, alt_m=700.0)
    for off_m in (0.0, 500.0):
        autopilot.send(mavlink.MAVLink_gps_global_origin_message(465_000_000, 75_000_000, round(1e3 * (584 + off_m))))
        autopilot.locate((46.5, 7.5), 700.0 + off_m, 116.0)
        assert autopilot.vehicle.height_m == 116.0
        ear.state = replace(STATE, alt_m=autopilot.vehicle.alt_m)
        autopilot.beat()
        assert collect(autopilot, "ODOMETRY")[-1].z == pytest.approx(-116.0, abs=0.01)


def test_conversation_reads_accelerations_together_with_the_attitude():
    autopilot, ear = interview()
    autopilot.send(mavlink.MAVLink_scaled_imu_message(autopilot.boot_ms, 0, 0, -1000, 0, 0, 0, 0, 0, 0))
    assert ear.forces == []
    autopilot.attitude(roll_deg=28.65)
    autopilot.send(mavlink.MAVLink_scaled_imu_message(autopilot.boot_ms, 100, 0, -1000, 0, 0, 0, 0, 0, 0))
    ((force, roll_deg),) = ear.forces
    assert force == pytest.approx((0.980665, 0.0, -9.80665))
    assert roll_deg == pytest.approx(28.65, abs=0.01)


def test_px4_gets_ten_positions_a_second_and_none_if_unknown():
    autopilot, ear = interview(PX4)
    said = collect(autopilot, "GLOBAL_POSITION_SENSOR", 3.0)
    assert len(said) == pytest.approx(30, abs=1)
    assert said[0].lat == round(STATE.lat_deg * 1e7)
    ear.state = None
    assert collect(autopilot, "GLOBAL_POSITION_SENSOR", 3.0) == []


def test_ardupilot_with_odometry_is_asked_for_its_origin_until_it_arrives():
    autopilot, _ = interview(VISO_TYPE=1, EK3_SRC2_POSXY=6)
    asks = []
    for _ in range(12):
        autopilot.beat()
        asks += [said.param1 for said in collect(autopilot, "COMMAND_LONG") if said.command == 512]
    assert asks.count(mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN) > 1


def test_px4_with_odometry_is_asked_for_its_origin_and_sent_positions_relative_to_it():
    autopilot, _ = interview(PX4, EKF2_AGP0_CTRL=0, EKF2_EV_CTRL=1, origin=Position(46.5, 7.5, 400.0))
    assert collect(autopilot, "ODOMETRY", 3.0) == []
    assert "SET_GPS_GLOBAL_ORIGIN" not in autopilot.conversation.sent
    wanted = mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN
    asks = []
    for _ in range(6):
        autopilot.beat()
        asks += [said.param1 for said in collect(autopilot, "COMMAND_LONG") if said.command == 512]
    assert wanted in asks
    autopilot.send(mavlink.MAVLink_gps_global_origin_message(465_000_000, 75_000_000, 400_000))
    autopilot.beat()
    said = collect(autopilot, "ODOMETRY", 3.0)
    assert len(said) == pytest.approx(30, abs=1)
    east_m, north_m = offset_m(46.5, 7.5, STATE.lat_deg, STATE.lon_deg)
    assert (said[0].x, said[0].y, said[0].z) == pytest.approx((north_m, east_m, 400 - STATE.alt_m), rel=1e-5)
    assert said[0].frame_id == mavlink.MAV_FRAME_LOCAL_NED
    assert said[0].pose_covariance[0] == said[0].pose_covariance[6] == pytest.approx(STATE.accuracy_m**2)
    assert np.isnan([*said[0].q, said[0].vx, said[0].vy, said[0].vz]).all(), "its own are better"
    for flags in (GLOBAL | mavlink.ESTIMATOR_PRED_POS_HORIZ_REL, GLOBAL):
        collect(autopilot, "ODOMETRY", 0.5)
        autopilot.px4_filter(2.0, flags)
    assert autopilot.conversation.autopilot.px4.used_share == 0.5


ATTITUDE = mavlink.ESTIMATOR_ATTITUDE
GLOBAL = mavlink.EKF_POS_HORIZ_ABS
FUSES = mavlink.ESTIMATOR_PRED_POS_HORIZ_ABS


def test_px4_receiver_that_is_not_used_does_not_count_as_gps():
    """With EKF2_GPS_CTRL=0 the receiver goes on, near where the aircraft is."""
    autopilot, ear = interview(PX4)
    ear.state = None

    def report_gps(seconds, flags):
        for _ in range(seconds * 5):
            autopilot.wait(0.2)
            autopilot.beat()
            autopilot.gps(h_acc=800)
            autopilot.px4_filter(2.0, flags)
        return autopilot.position().has_gps

    assert report_gps(8, GLOBAL | FUSES)
    assert report_gps(1, GLOBAL), "it may just have begun"
    assert not report_gps(3, GLOBAL)
    assert report_gps(1, GLOBAL | FUSES), "it uses it again"
    assert not report_gps(4, GLOBAL)
    ear.state = STATE
    collect(autopilot, "GLOBAL_POSITION_SENSOR")
    assert not report_gps(3, GLOBAL | FUSES), "what it fuses is ours"


def test_conversation_sends_a_fix_between_matches_after_half_a_second():
    autopilot, ear = interview()
    assert collect(autopilot, "COMMAND_INT", 3.0) == []
    ear.between = Fix(47.0, 8.0, 9.0, 0.0)
    autopilot.beat()
    assert [each.x for each in collect(autopilot, "COMMAND_INT", 1.8)] == [470_000_000] * 4
    assert len(autopilot.conversation.take_interim_fixes()) == 4
    assert autopilot.conversation.take_interim_fixes() == []
    autopilot.beat()
    autopilot.conversation.send_fix(Fix(50.0, 8.0, 9.0, autopilot.clock.now_s))
    assert [each.x for each in collect(autopilot, "COMMAND_INT", 0.4)] == [500_000_000], "a match has just been sent"
    autopilot, ear = interview(PX4, EKF2_AGP0_CTRL=0)
    ear.between = Fix(47.0, 8.0, 9.0, 0.0)
    autopilot.beat()
    assert collect(autopilot, "COMMAND_INT", 4.0) == [], "its velocity follows a fix"


@pytest.mark.parametrize(("base_mode", "advice"), [(0, ": reboot it"), (ARMED, "")])
def test_ardupilot_that_does_not_report_our_receiver_is_to_be_rebooted(base_mode, advice):
    """A new GPS2_TYPE is used after a reboot only; a receiver that is used is reported (real ArduPilot 4.7-dev). Later
    its reports may be lost."""
    autopilot, _ = interview(GPS2_TYPE=14)
    texts = []
    for second in range(50):
        autopilot.beat(base_mode)
        if 20 <= second < 30:
            autopilot.gps(message=mavlink.MAVLink_gps2_raw_message)
        texts += [said.text.removeprefix("edgevpr: ") for said in collect(autopilot, "STATUSTEXT")]
    assert [text for text in texts if "GPS_INPUT" in text] == [
        f"autopilot ignores GPS_INPUT{advice}",
        "autopilot uses GPS_INPUT",
    ]


def test_autopilot_that_has_restarted_is_not_to_be_rebooted_again():
    autopilot, _ = interview(GPS2_TYPE=14)
    texts = []

    def fly(seconds):
        for _ in range(seconds):
            autopilot.beat()
            autopilot.gps(message=mavlink.MAVLink_gps2_raw_message)
            texts.extend(said.text for said in collect(autopilot, "STATUSTEXT"))

    fly(15)
    autopilot.reboot()
    for _ in range(12):
        autopilot.wait(0.25)
        autopilot.beat()
        autopilot.reply(ARDUPILOT_PARAMETERS | {"GPS2_TYPE": 14})
    fly(15)
    assert autopilot.conversation.channel is Channel.GPS_INPUT
    assert not [text for text in texts if "ignores" in text or "uses" in text]
