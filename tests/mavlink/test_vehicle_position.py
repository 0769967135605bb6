"""Where the autopilot says it is: from the pinned autopilot only, only while fresh, and never at 0, 0."""

import math

import pytest
from fakes import FakeClock
from mavlink_peers import Peer, UdpPort, link_to, wait_until

from edgevpr.core.geodesy import offset_m
from edgevpr.core.types import Vehicle
from edgevpr.mavlink.wire import mavlink


@pytest.fixture
def clock():
    return FakeClock()


@pytest.fixture
def link_and_peer(clock):
    port = UdpPort()
    with link_to(f"udpout:127.0.0.1:{port.number}", clock=clock) as link:
        peer = Peer(port, system_id=7)
        peer.expect("HEARTBEAT")
        yield link, peer
    port.close()


def fresh(link, clock):
    """What the autopilot has said within the last second."""
    vehicle = link.vehicle()
    return vehicle if vehicle and vehicle.is_fresh_at(clock.now_s) else None


def say(link, peer, lat_deg, lon_deg, hdg=9050, vx=0, vy=0, **sender):
    before = link.stats().received.get("GLOBAL_POSITION_INT", 0)
    peer.send(
        mavlink.MAVLink_global_position_int_message(
            0, round(lat_deg * 1e7), round(lon_deg * 1e7), 312_500, 80_000, vx, vy, 0, hdg
        ),
        **sender,
    )
    wait_until(lambda: link.stats().received.get("GLOBAL_POSITION_INT", 0) == before + 1, "the message arrives")


def test_the_position_of_the_pinned_autopilot_is_known_while_it_is_fresh(link_and_peer, clock):
    link, peer = link_and_peer
    peer.heartbeat()
    wait_until(lambda: link.stats().autopilot_heard)
    assert fresh(link, clock) is None
    say(link, peer, 50.1234567, -14.5, vx=-300, vy=1250)
    expected = Vehicle(
        lat_deg=50.1234567,
        lon_deg=-14.5,
        alt_m=312.5,
        heading_deg=90.5,
        t_heard_s=clock.now_s,
        has_gps=False,
        height_m=80.0,
        velocity_m_s=(12.5, -3.0),
        sink_m_s=0.0,
    )
    assert wait_until(lambda: fresh(link, clock)) == expected
    clock.now_s += 1.0
    assert fresh(link, clock) == expected
    clock.now_s += 0.1
    assert fresh(link, clock) is None
    say(link, peer, 50.2, -14.5, hdg=65535)
    assert wait_until(lambda: fresh(link, clock)).heading_deg is None


def test_at_the_time_of_a_frame_it_is_where_its_velocity_takes_it(link_and_peer, clock):
    link, peer = link_and_peer
    peer.heartbeat()
    wait_until(lambda: link.stats().autopilot_heard)
    say(link, peer, 50.0, 8.0, vx=2000, vy=-1000)
    now_s = wait_until(lambda: fresh(link, clock)).t_heard_s
    for seconds in (-0.4, 0.25):
        there = link.vehicle_at(now_s + seconds)
        assert offset_m(50.0, 8.0, there.lat_deg, there.lon_deg) == pytest.approx(
            (-10 * seconds, 20 * seconds), abs=1e-6
        )
    old = link.vehicle_at(now_s + 1.5)
    assert (old.lat_deg, old.lon_deg) == (50.0, 8.0), "nobody knows"


def test_a_velocity_that_no_small_aircraft_has_is_unknown(link_and_peer, clock):
    link, peer = link_and_peer
    peer.heartbeat()
    wait_until(lambda: link.stats().autopilot_heard)
    say(link, peer, 50.0, 8.0, vx=32_767, vy=32_767)
    assert wait_until(lambda: fresh(link, clock)).velocity_m_s is None


def test_nobody_else_says_where_we_are(link_and_peer, clock):
    link, peer = link_and_peer
    another = {"system_id": 9, "component_id": 1}
    peer.send(mavlink.MAVLink_global_position_int_message(0, 1, 1, 0, 0, 0, 0, 0, 0), **another)
    peer.heartbeat()
    wait_until(lambda: link.stats().autopilot_heard)
    say(link, peer, 1.0, 1.0, **another)
    say(link, peer, 2.0, 2.0, component_id=190)  # a ground station's component
    say(link, peer, 3.0, 3.0)
    assert wait_until(lambda: fresh(link, clock)).lat_deg == 3.0
    say(link, peer, 4.0, 4.0, **another)
    say(link, peer, 5.0, 5.0, component_id=190)
    say(link, peer, 3.0, 3.0)  # messages are counted before they are heard: the last but one has been by now
    assert fresh(link, clock).lat_deg == 3.0


@pytest.mark.parametrize("nowhere", [(0.0, 0.0), (91.0, 8.0), (50.0, 181.0)])
def test_a_position_lost_is_not_remembered(link_and_peer, clock, nowhere):
    link, peer = link_and_peer
    peer.heartbeat()
    wait_until(lambda: link.stats().autopilot_heard)
    say(link, peer, 50.0, 8.0)
    wait_until(lambda: fresh(link, clock))
    say(link, peer, *nowhere)
    wait_until(lambda: fresh(link, clock) is None)


def say_gps(link, peer, fix_type, message="GPS_RAW_INT", lat_deg=50.0):
    before = link.stats().received.get(message, 0)
    where = (round(lat_deg * 1e7), 80_000_000)
    if message == "GPS_RAW_INT":
        peer.send(mavlink.MAVLink_gps_raw_int_message(0, fix_type, *where, 0, 80, 120, 0, 0, 14))
    else:
        peer.send(mavlink.MAVLink_gps2_raw_message(0, fix_type, *where, 0, 80, 120, 0, 0, 14, 0, 0))
    wait_until(lambda: link.stats().received.get(message, 0) == before + 1, "the report arrives")


@pytest.mark.parametrize("message", ["GPS_RAW_INT", "GPS2_RAW"])
def test_a_position_says_whether_gps_stands_behind_it(link_and_peer, clock, message):
    link, peer = link_and_peer
    peer.heartbeat()
    wait_until(lambda: link.stats().autopilot_heard)

    def has_gps(lat_deg):
        say(link, peer, lat_deg, 8.0)
        wait_until(lambda: fresh(link, clock) and fresh(link, clock).lat_deg == lat_deg)
        return fresh(link, clock).has_gps

    say_gps(link, peer, mavlink.GPS_FIX_TYPE_2D_FIX, message)
    assert not has_gps(50.0)
    say_gps(link, peer, mavlink.GPS_FIX_TYPE_3D_FIX, message)
    assert has_gps(50.0003), "33 m flown since its last report"
    assert not has_gps(50.001), "it does not follow its receiver: jammed, deceived or switched off"
    say_gps(link, peer, mavlink.GPS_FIX_TYPE_3D_FIX, message, lat_deg=50.001)
    assert has_gps(50.0011)
    say_gps(link, peer, mavlink.GPS_FIX_TYPE_NO_FIX, message)
    assert not has_gps(50.0012), "it reckons where it is, and goes on saying so"
    say_gps(link, peer, mavlink.GPS_FIX_TYPE_3D_FIX, message, lat_deg=50.0012)
    clock.now_s += 3.0
    peer.heartbeat()
    assert not has_gps(50.00121), "its receiver has fallen silent"


def test_a_silent_autopilot_is_asked_where_it_is_until_it_says_so(link_and_peer, clock):
    link, peer = link_and_peer
    peer.heartbeat()
    wait_until(lambda: link.stats().autopilot_heard)
    assert link.stats().sent.get("COMMAND_LONG", 0) == 0, "nobody wants to know"
    link.want_position()
    version, *asked = [peer.expect("COMMAND_LONG") for _ in range(7)]
    assert (version.command, version.param1) == (mavlink.MAV_CMD_REQUEST_MESSAGE, 148)
    assert {command.command for command in asked} == {mavlink.MAV_CMD_SET_MESSAGE_INTERVAL}
    intervals_us = {int(command.param1): command.param2 for command in asked}
    assert intervals_us == {33: 100_000, 30: 100_000, 24: 200_000} | dict.fromkeys((132, 136, 193), 500_000)
    assert all(command.target_system == 7 for command in asked)
    say_attitude(link, peer)
    say(link, peer, 50.0, 8.0)
    for _ in range(2):  # what is heard needs no asking
        clock.now_s += 4.0
        peer.heartbeat()
        say_attitude(link, peer)
        say(link, peer, 50.0, 8.0)
    assert link.stats().sent["COMMAND_LONG"] == 6 + 3, "and the version, which it does not say, each time"
    clock.now_s += 6.0  # it has started anew
    peer.heartbeat()
    wait_until(lambda: link.stats().sent["COMMAND_LONG"] == 6 + 4 + 6)


def test_an_autopilot_that_says_no_attitude_is_asked_for_it_again(link_and_peer, clock):
    link, peer = link_and_peer
    link.want_position()
    peer.heartbeat()
    for _ in range(7):
        peer.expect("COMMAND_LONG")
    for _ in range(2):
        say(link, peer, 50.0, 8.0)
        clock.now_s += 4.0
        peer.heartbeat()
    wait_until(lambda: link.stats().sent["COMMAND_LONG"] == 12 + 3)


def told(link, peer, message):
    """Send a message, and wait until it has been heard: a second one after it has been counted."""
    for each in (message, mavlink.MAVLink_system_time_message(0, 0)):
        before = link.stats().received.get(each.get_type(), 0)
        peer.send(each)
        wait_until(lambda each=each, before=before: link.stats().received.get(each.get_type(), 0) == before + 1)


def say_attitude(link, peer, roll_deg=0.0, pitch_deg=0.0, yaw_deg=0.0):
    told(link, peer, mavlink.MAVLink_attitude_message(0, *map(math.radians, (roll_deg, pitch_deg, yaw_deg)), 0, 0, 0))


@pytest.fixture
def flying(link_and_peer):
    link, peer = link_and_peer
    peer.heartbeat()
    wait_until(lambda: link.stats().autopilot_heard)
    return link, peer


def test_the_attitude_is_that_of_the_frame_s_time(flying, clock):
    link, peer = flying
    start_s = clock.now_s
    for roll_deg, pitch_deg, yaw_deg in ((-10, 4, 350), (10, 8, 10), (20, 0, 20)):
        say_attitude(link, peer, roll_deg, pitch_deg, yaw_deg)
        say(link, peer, 50.0, 8.0)
        clock.now_s += 0.2
    seen = link.vehicle_at(start_s + 0.05)
    assert (seen.roll_deg, seen.pitch_deg, seen.heading_deg) == pytest.approx((-5, 5, 355), abs=1e-4)
    assert link.vehicle_at(start_s + 0.1).heading_deg % 360 == pytest.approx(0, abs=1e-4), "the short way over north"
    last = link.vehicle_at(start_s + 0.65)
    assert (last.roll_deg, last.heading_deg) == pytest.approx((20, 20), abs=1e-4), "the last one holds for 0.3 s"
    for away_s in (-0.35, 0.75):
        other = link.vehicle_at(start_s + away_s)
        assert (other.roll_deg, other.pitch_deg, other.heading_deg) == (None, None, 90.5), "the report's own heading"
    assert link.vehicle().roll_deg is None


def test_an_attitude_that_is_no_number_is_not_believed(flying, clock):
    link, peer = flying
    say_attitude(link, peer, roll_deg=math.nan)
    say(link, peer, 50.0, 8.0)
    assert link.vehicle_at(clock.now_s).roll_deg is None


def say_range(link, peer, distance_m, orientation=25, signal_quality=0):
    told(
        link,
        peer,
        mavlink.MAVLink_distance_sensor_message(
            0, 20, 10_000, round(distance_m * 100), 0, 0, orientation, 0, signal_quality=signal_quality
        ),
    )


def say_terrain(link, peer, height_m, spacing=100):
    told(link, peer, mavlink.MAVLink_terrain_report_message(500_000_000, 80_000_000, spacing, 0.0, height_m, 0, 9))


def height_m(link, peer):
    say(link, peer, 50.0, 8.0)
    told(link, peer, mavlink.MAVLink_system_time_message(0, 0))
    return link.vehicle().height_m


def test_the_best_height_is_taken(flying, clock):
    link, peer = flying
    assert height_m(link, peer) == 80.0, "over the take-off point"
    say_terrain(link, peer, 65.0)
    assert height_m(link, peer) == 65.0
    say_range(link, peer, 60.0)
    assert height_m(link, peer) == 60.0
    say_attitude(link, peer, roll_deg=60.0)
    say_range(link, peer, 60.0)
    assert height_m(link, peer) == pytest.approx(30.0, abs=0.01), "a range finder looks where the aircraft leans"
    clock.now_s += 1.1
    assert height_m(link, peer) == 65.0, "the range is old"
    clock.now_s += 2.0
    assert height_m(link, peer) == 80.0, "the terrain is old too"


@pytest.mark.parametrize(
    "wrong", [{"distance_m": 0.1}, {"distance_m": 120.0}, {"orientation": 0}, {"signal_quality": 1}]
)
def test_a_range_that_says_nothing_is_not_taken(flying, wrong):
    link, peer = flying
    say_range(link, peer, **{"distance_m": 60.0} | wrong)
    assert height_m(link, peer) == 80.0


@pytest.mark.parametrize("report", [(math.nan, 100), (0.0, 0)])
def test_a_terrain_that_is_unknown_is_not_taken(flying, report):
    link, peer = flying
    say_terrain(link, peer, *report)
    assert height_m(link, peer) == 80.0
