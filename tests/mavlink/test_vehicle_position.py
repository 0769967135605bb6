"""Where the autopilot says it is: from the pinned autopilot only, only while fresh, and never at 0, 0."""

import pytest
from fakes import FakeClock
from mavlink_peers import Peer, UdpPort, wait_until

from edgevpr.mavlink.address import parse_link
from edgevpr.mavlink.link import Link
from edgevpr.mavlink.wire import mavlink
from edgevpr.types import Vehicle


@pytest.fixture
def clock():
    return FakeClock()


@pytest.fixture
def link_and_peer(clock):
    port = UdpPort()
    with Link(parse_link(f"udpout:127.0.0.1:{port.number}"), clock=clock) as link:
        peer = Peer(port, system_id=7)
        peer.expect("HEARTBEAT")
        yield link, peer
    port.close()


def fresh(link, clock):
    """What the autopilot has said within the last second."""
    vehicle = link.vehicle()
    return vehicle if vehicle and vehicle.is_fresh_at(clock.now_s) else None


def say(link, peer, lat_deg, lon_deg, hdg=9050, **sender):
    before = link.stats().received.get("GLOBAL_POSITION_INT", 0)
    peer.send(
        mavlink.MAVLink_global_position_int_message(
            0, round(lat_deg * 1e7), round(lon_deg * 1e7), 312_500, 80_000, 0, 0, 0, hdg
        ),
        **sender,
    )
    wait_until(lambda: link.stats().received.get("GLOBAL_POSITION_INT", 0) == before + 1, "the message arrives")


def test_the_position_of_the_pinned_autopilot_is_known_while_it_is_fresh(link_and_peer, clock):
    link, peer = link_and_peer
    peer.heartbeat()
    wait_until(lambda: link.stats().autopilot_heard)
    assert fresh(link, clock) is None
    say(link, peer, 50.1234567, -14.5)
    expected = Vehicle(
        lat_deg=50.1234567, lon_deg=-14.5, alt_m=312.5, heading_deg=90.5, t_heard_s=clock.now_s, has_gps=False
    )
    assert wait_until(lambda: fresh(link, clock)) == expected
    clock.now_s += 1.0
    assert fresh(link, clock) == expected
    clock.now_s += 0.1
    assert fresh(link, clock) is None
    say(link, peer, 50.2, -14.5, hdg=65535)
    assert wait_until(lambda: fresh(link, clock)).heading_deg is None


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
    asked = [peer.expect("COMMAND_LONG") for _ in range(2)]
    assert {command.command for command in asked} == {mavlink.MAV_CMD_SET_MESSAGE_INTERVAL}
    assert {(command.param1, command.param2) for command in asked} == {(33, 200_000), (24, 500_000)}
    assert all(command.target_system == 7 for command in asked)
    say(link, peer, 50.0, 8.0)
    for _ in range(2):  # what is heard needs no asking
        clock.now_s += 4.0
        peer.heartbeat()
        say(link, peer, 50.0, 8.0)
    assert link.stats().sent["COMMAND_LONG"] == 2
    clock.now_s += 6.0  # it has started anew
    peer.heartbeat()
    assert peer.expect("COMMAND_LONG").param1 in (24, 33)
