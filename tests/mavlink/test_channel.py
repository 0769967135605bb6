"""The channel by which an autopilot is told positions: asked for over a real link, and chosen."""

import struct

import pytest
from fakes import FakeClock
from mavlink_peers import Peer, link_to, wait_until

from edgevpr.core.types import Position
from edgevpr.mavlink.address import parse_link
from edgevpr.mavlink.channel import Answers, Channel, Kind, ardupilot_choice, kind_of, px4_can_fuse, px4_choice
from edgevpr.mavlink.conversation import LinkSettings
from edgevpr.mavlink.link import Link
from edgevpr.mavlink.peer import NoListener
from edgevpr.mavlink.positions import MotionState
from edgevpr.mavlink.wire import mavlink

ARDUPILOT, PX4 = mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA, mavlink.MAV_AUTOPILOT_PX4
STATE = MotionState(
    t_mono_s=0.0,
    lat_deg=47.0,
    lon_deg=8.0,
    alt_m=500.0,
    velocity_m_s=(1.0, 2.0, 0.0),
    accuracy_m=3.0,
    alt_accuracy_m=3.0,
    speed_accuracy_m_s=0.5,
    attitude=(0.0, 0.0, 0.5),
)


def asked(kind=Kind.PLANE, version=(4, 7), **parameters):
    return Answers(kind=kind, version=version, parameters=parameters)


@pytest.mark.parametrize(
    ("kind", "parameters", "channel"),
    [
        (Kind.PLANE, {}, Channel.COMMAND),
        (Kind.PLANE, {"GPS1_TYPE": 1, "GPS2_TYPE": 0, "VISO_TYPE": 0}, Channel.COMMAND),
        (Kind.COPTER, {"GPS1_TYPE": 1, "GPS2_TYPE": 14}, Channel.GPS_INPUT),
        (Kind.COPTER, {"GPS_TYPE": 14}, Channel.GPS_INPUT),
        (Kind.COPTER, {"GPS1_TYPE": 1, "VISO_TYPE": 1}, Channel.ODOMETRY),
        (Kind.ROVER, {"GPS1_TYPE": 1, "VISO_TYPE": 2}, Channel.COMMAND),
    ],
)
def test_an_ardupilot_gets_what_its_operator_has_set_up_else_single_fixes(kind, parameters, channel):
    assert ardupilot_choice(asked(kind, **parameters)).channel is channel


def test_the_receiver_is_the_one_that_is_ours_and_as_late_as_it_is_taken_to_be():
    second = ardupilot_choice(asked(Kind.COPTER, GPS1_TYPE=1, GPS2_TYPE=14, GPS2_DELAY_MS=0))
    assert (second.receiver, second.lag_s) == (1, 0.2)
    first = ardupilot_choice(asked(Kind.COPTER, GPS_TYPE=14, GPS_TYPE2=1, GPS_DELAY_MS=60))
    assert (first.receiver, first.lag_s) == (0, 0.06)


def test_a_copter_with_nothing_set_up_is_told_what_to_set():
    assert "GPS2_TYPE=14" in ardupilot_choice(asked(Kind.COPTER, GPS1_TYPE=1)).reason
    assert "GPS_TYPE2=14" in ardupilot_choice(asked(Kind.ROVER, GPS_TYPE=1, GPS_TYPE2=0)).reason
    assert "GPS2_TYPE" not in ardupilot_choice(asked(Kind.PLANE, GPS1_TYPE=1)).reason


def test_a_px4_gets_the_sensor_s_message_where_it_fuses_it():
    assert px4_choice(asked(version=(1, 17), EKF2_AGP0_CTRL=1)).channel is Channel.SENSOR
    assert px4_choice(asked(version=(1, 17), EKF2_AGP0_CTRL=2)).channel is Channel.COMMAND
    assert px4_choice(asked(version=(1, 16), EKF2_AGP0_CTRL=1)).channel is Channel.COMMAND
    assert px4_choice(asked(version=None)).channel is Channel.COMMAND
    assert px4_choice(asked(version=None, EKF2_AGP0_CTRL=3)).channel is Channel.SENSOR


def test_a_px4_can_be_told_to_fuse_where_it_has_the_parameter():
    assert px4_can_fuse(asked(version=(1, 17), EKF2_AGP0_CTRL=0))
    assert not px4_can_fuse(asked(version=(1, 17)))
    assert not px4_can_fuse(asked(version=(1, 16), EKF2_AGP0_CTRL=0))


def test_kinds():
    assert kind_of(mavlink.MAV_TYPE_HEXAROTOR) is Kind.COPTER
    assert kind_of(mavlink.MAV_TYPE_FIXED_WING) is Kind.PLANE
    assert kind_of(mavlink.MAV_TYPE_VTOL_TILTROTOR) is Kind.PLANE
    assert kind_of(mavlink.MAV_TYPE_SURFACE_BOAT) is Kind.ROVER
    assert kind_of(mavlink.MAV_TYPE_SUBMARINE) is Kind.OTHER


class Ear(NoListener):
    def __init__(self):
        self.channels, self.forces, self.state, self.asked_for = [], [], STATE, []

    def hear_channel(self, channel):
        self.channels.append(channel)

    def hear_force(self, t_s, force_m_s2, attitude):
        self.forces.append((force_m_s2, attitude.roll_deg))

    def state_at(self, t_s):
        self.asked_for.append(t_s)
        return self.state


class Questioned(Peer):
    """An autopilot that answers what it is asked, but for parameters that it does not have."""

    def __init__(self, port, firmware, parameters, mav_type=mavlink.MAV_TYPE_QUADROTOR):
        super().__init__(port)
        self.firmware, self.parameters, self.mav_type = firmware, parameters, mav_type

    def heartbeat(self, **sender):
        self.send(mavlink.MAVLink_heartbeat_message(self.mav_type, self.firmware, 1, 0, 4, 3), **sender)

    def answer(self):
        """Read up to the next heartbeat, which comes before all else that is sent in its second, and answer."""
        beats = False
        while not beats:
            self.read()
            for message in self.seen:
                beats |= message.get_type() == "HEARTBEAT"
                if message.get_type() == "COMMAND_LONG" and message.command == mavlink.MAV_CMD_REQUEST_MESSAGE:
                    version = 1 << 24 | 17 << 16
                    self.send(mavlink.MAVLink_autopilot_version_message(0, version, 0, 0, 0, *[bytes(8)] * 3, 0, 0, 0))
                if message.get_type() == "PARAM_REQUEST_READ" and message.param_id in self.parameters:
                    value, kind = self.parameters[message.param_id]
                    self.send(mavlink.MAVLink_param_value_message(message.param_id.encode(), value, kind, 1, 0))
            self.seen.clear()


def opened(port, clock, ear, firmware, parameters):
    link = link_to(f"udpout:127.0.0.1:{port.number}", clock=clock, listener=ear)
    link.want_position()
    link.start()
    peer = Questioned(port, firmware, parameters)
    peer.expect("HEARTBEAT")
    return link, peer


def told(peer, clock, until):
    """Let the autopilot beat and answer, a second of the link's clock after the other, until it is so."""
    for _ in range(100):
        clock.now_s += 1.0  # so that the link's heartbeat is due
        peer.heartbeat()
        peer.answer()
        if until():
            return
    raise AssertionError("it did not come true")


def test_a_copter_with_our_receiver_gets_a_position_ten_times_a_second(port):
    clock, ear = FakeClock(), Ear()
    real = mavlink.MAV_PARAM_TYPE_INT8
    parameters = {"GPS1_TYPE": (1.0, real), "GPS2_TYPE": (14.0, real), "VISO_TYPE": (0.0, real)}
    link, peer = opened(port, clock, ear, ARDUPILOT, parameters)
    try:
        told(peer, clock, lambda: ear.channels)
        assert ear.channels == [Channel.GPS_INPUT]
        heard = peer.expect("GPS_INPUT")
        assert (heard.gps_id, heard.lat) == (1, 470_000_000)
        assert (heard.time_week, heard.fix_type) == (0, 3)
        peer.send(mavlink.MAVLink_system_time_message(1_700_000_000_000_000, 0))
        ear.state = None
        wait_until(lambda: link.stats().received.get("SYSTEM_TIME"))
        while not heard.time_week or heard.fix_type == mavlink.GPS_FIX_TYPE_3D_FIX:  # those that were on their way
            clock.now_s += 0.1
            peer.heartbeat()
            heard = peer.expect("GPS_INPUT")
        assert (heard.fix_type, heard.time_week) == (mavlink.GPS_FIX_TYPE_NO_FIX, 2288)
        # What the receiver says that is us is no GPS; what the other says is.
        for report, kind in ((mavlink.MAVLink_gps2_raw_message, 3), (mavlink.MAVLink_gps_raw_int_message, 1)):
            more = {"dgps_numch": 0, "dgps_age": 0} if kind == 3 else {}
            peer.send(report(0, kind, 470_000_000, 80_000_000, 0, 80, 80, 0, 0, 6, **more))
        peer.send(mavlink.MAVLink_global_position_int_message(0, 470_000_000, 80_000_000, 0, 80_000, 0, 0, 0, 0))
        assert wait_until(link.vehicle).has_gps is False
    finally:
        link.close()


def test_odometry_waits_for_an_origin_and_sets_one_where_it_may(port):
    clock, ear = FakeClock(), Ear()
    address = parse_link(f"udpout:127.0.0.1:{port.number}")
    link = Link(address, LinkSettings(clock=clock, listener=ear, origin=Position(46.5, 7.5, 400.0)))
    link.want_position()
    link.start()
    peer = Questioned(port, ARDUPILOT, {"VISO_TYPE": (1.0, mavlink.MAV_PARAM_TYPE_INT8)})
    try:
        peer.expect("HEARTBEAT")
        told(peer, clock, lambda: ear.channels)
        assert ear.channels == [Channel.ODOMETRY]
        told(peer, clock, lambda: link.stats().sent.get("SET_GPS_GLOBAL_ORIGIN"))
        assert "ODOMETRY" not in link.stats().sent
        peer.send(mavlink.MAVLink_gps_global_origin_message(465_000_000, 75_000_000, 400_000))
        told(peer, clock, lambda: link.stats().sent.get("ODOMETRY", 0) > 3)
        assert link.stats().sent["SET_GPS_GLOBAL_ORIGIN"] == 1
    finally:
        link.close()


def test_what_the_accelerometers_feel_is_heard_with_the_attitude(port):
    clock, ear = FakeClock(), Ear()
    link, peer = opened(port, clock, ear, ARDUPILOT, {})
    try:
        peer.heartbeat()
        peer.send(mavlink.MAVLink_scaled_imu_message(0, 0, 0, -1000, 0, 0, 0, 0, 0, 0))
        wait_until(lambda: link.stats().received.get("SCALED_IMU"))
        peer.send(mavlink.MAVLink_attitude_message(0, 0.5, 0, 0, 0, 0, 0))
        peer.send(mavlink.MAVLink_scaled_imu_message(0, 100, 0, -1000, 0, 0, 0, 0, 0, 0))
        wait_until(lambda: ear.forces)
        ((force, roll_deg),) = ear.forces
        assert force == pytest.approx((0.980665, 0.0, -9.80665))
        assert roll_deg == pytest.approx(28.65, abs=0.01)
    finally:
        link.close()


def test_a_px4_says_whole_numbers_as_the_bytes_of_a_float(port):
    clock, ear = FakeClock(), Ear()
    one = struct.unpack("<f", struct.pack("<i", 1))[0]
    link, peer = opened(port, clock, ear, PX4, {"EKF2_AGP0_CTRL": (one, mavlink.MAV_PARAM_TYPE_INT32)})
    try:
        told(peer, clock, lambda: link.channel is Channel.SENSOR)
    finally:
        link.close()


def test_an_autopilot_that_answers_nothing_gets_single_fixes(port, caplog):
    clock, ear = FakeClock(), Ear()
    caplog.set_level("INFO")
    link, peer = opened(port, clock, ear, ARDUPILOT, {})
    try:
        told(peer, clock, lambda: "positions go to it by command 43003" in caplog.text)
        assert link.channel is Channel.COMMAND
    finally:
        link.close()
