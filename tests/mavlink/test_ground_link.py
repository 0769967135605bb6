"""Two links: what the ground station hears on its own one, and what it can do with it, which is nothing."""

from contextlib import closing

import pytest
from loopback import free_port, wait_until
from mavlink_peers import Peer, UdpPort, link_to

from edgevpr.mavlink.address import parse_link
from edgevpr.mavlink.groundlink import GroundLink
from edgevpr.mavlink.messages import (
    Fix,
    Health,
    Severity,
    make_computer_status,
    make_named_values,
    make_position_fix,
    make_status_text,
)
from edgevpr.mavlink.signing import GCS_LINK_ID, Signing, TimeStamps
from edgevpr.mavlink.wire import mavlink

pytestmark = pytest.mark.network


@pytest.fixture
def two(clock):
    """The link to the flight controller, the autopilot, the link to the ground, the ground station."""
    with closing(UdpPort()) as port, closing(UdpPort()) as ground_port:
        flight = link_to(f"udpout:127.0.0.1:{port.number}", component_id=191, clock=clock)
        ground = GroundLink(parse_link(f"udpout:127.0.0.1:{ground_port.number}"), flight)
        with flight, ground:
            autopilot, station = Peer(port, system_id=7), Peer(ground_port, system_id=255)
            autopilot.expect("HEARTBEAT")
            station.expect("HEARTBEAT")
            autopilot.heartbeat()
            wait_until(flight.listens, "hearing the autopilot")
            yield flight, autopilot, ground, station


def text(words: str):
    return make_status_text(Severity.INFO, words)


def test_the_ground_hears_what_is_for_people_and_no_fix_and_no_request(two, clock):
    flight, autopilot, _, station = two
    flight.send_fix(Fix(50.0, 14.0, 25.0, clock()))
    autopilot.expect("COMMAND_INT")
    flight.request_position()
    flight.send(text("wake up"))
    autopilot.expect("COMMAND_LONG")
    station.expect_text("wake up")
    figures = make_named_values(1.0, vpr_place=5, vpr_score=0.5, vpr_cpu=0.5, vpr_mah=2.0)
    flight.send(*figures, make_computer_status(1.0, [0.5], 2**20, 2**30, None))
    flight.send(make_position_fix(Fix(1.0, 2.0, 3.0, clock()), clock(), 7))  # not even where it is queued as a message
    flight.send(text("end"))
    mirrored = ["NAMED_VALUE_INT", *["NAMED_VALUE_FLOAT"] * 3, "ONBOARD_COMPUTER_STATUS"]
    assert [message.get_type() for message in station.expect_text("end")] == mirrored
    names = [message.get_type() for message in autopilot.expect_text("end")]
    assert names.count("COMMAND_INT") == 1


def test_both_ends_hear_the_same_vehicle_component_and_health(two, clock):
    flight, autopilot, _, station = two
    flight.set_health(Health.ACTIVE)
    clock.now_s += 1.0
    flight.send(text("wake up"))
    for peer in (autopilot, station):
        heartbeat = peer.expect("HEARTBEAT")
        assert (heartbeat.get_srcSystem(), heartbeat.get_srcComponent()) == (7, 191)
        assert heartbeat.system_status == Health.ACTIVE
    clock.now_s += 11.0
    flight.send(text("wake up"))
    assert station.expect("HEARTBEAT").system_status == Health.CRITICAL


def test_nobody_on_the_ground_is_taken_for_the_autopilot_and_nothing_is_forwarded(two, clock):
    flight, autopilot, ground, station = two
    station.heartbeat(system_id=7)
    station.send(mavlink.MAVLink_global_position_int_message(1, 50 * 10**7, 14 * 10**7, 1, 1, 1, 1, 1, 1), system_id=7)
    station.send(mavlink.MAVLink_command_long_message(7, 1, 400, 0, 1, 21196, 0, 0, 0, 0, 0))
    station.answer_fix(0, to=191, system_id=7)
    wait_until(lambda: "COMMAND_ACK" in ground.stats().received, "hearing the ground")
    assert (flight.vehicle(), flight.stats().acks) == (None, {})
    assert not ground.listens()
    autopilot.send(mavlink.MAVLink_global_position_int_message(1, 50 * 10**7, 14 * 10**7, 1, 1, 1, 1, 1, 1))
    wait_until(flight.vehicle, "hearing the autopilot's position")
    flight.send(text("end"))
    assert autopilot.expect_text("end") == []
    assert station.expect_text("end") == []


def test_a_ground_station_that_is_lost_holds_up_no_fix(two, clock):
    flight, autopilot, _, station = two
    station.port.close()
    for number in range(20):
        flight.send(text("to nobody"))
        assert autopilot.expect("STATUSTEXT").text == "to nobody"
        sending = flight.send_fix(Fix(50.0 + number, 14.0, 25.0, clock()))
        wait_until(lambda sending=sending: sending.sent)
        autopilot.expect("COMMAND_INT")
        autopilot.answer_fix(0, to=191)
        wait_until(lambda sending=sending: sending.answer)


def test_of_two_stations_at_a_listening_port_the_one_that_beat_last_is_answered(clock):
    number = free_port()
    flight = link_to("udpout:127.0.0.1:9", clock=clock)
    ground = GroundLink(parse_link(f"udpin:127.0.0.1:{number}"), flight)
    beat = mavlink.MAVLink_heartbeat_message(mavlink.MAV_TYPE_GCS, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, 4, 3)
    with closing(UdpPort(to=number)) as one, closing(UdpPort(to=number)) as other, flight, ground:
        first, second = Peer(one, 255), Peer(other, 254)
        for count, peer in enumerate((first, second), 1):
            peer.send(beat)
            wait_until(lambda count=count: ground.stats().received.get("HEARTBEAT") == count)
            flight.send(text(f"{count}"))
            peer.expect_text(f"{count}")


def test_the_ground_is_spoken_to_with_the_same_key_and_another_link_id(clock, tmp_path):
    signing = Signing(bytes(32), TimeStamps(tmp_path / "time"))
    with closing(UdpPort()) as port:
        flight = link_to("udpout:127.0.0.1:9", clock=clock, signing=signing)
        with flight, GroundLink(parse_link(f"udpout:127.0.0.1:{port.number}"), flight):
            peer = Peer(port)
            peer.receiver._find_parser(None).signing.secret_key = bytes(32)
            heartbeat = peer.expect("HEARTBEAT")
            assert (heartbeat.get_signed(), heartbeat.get_link_id()) == (True, GCS_LINK_ID)
