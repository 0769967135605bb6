"""Requests to this companion over a real link: what is answered, field by field, what is obeyed, and what is not."""

import math

import pytest
from fakes import FakeClock
from mavlink_peers import Peer, UdpPort, free_port, link_to, wait_until

from edgevpr.mavlink.messages import Fix, Health, Severity, computer_status, query_figures, status_text
from edgevpr.mavlink.requests import ANSWERED_MAX, Wish
from edgevpr.mavlink.wire import mavlink

STATION = {"system_id": 255, "component_id": 190}
US = (7, 197)
STATUS, NAMED = 390, 251


@pytest.fixture
def clock():
    return FakeClock()


@pytest.fixture
def port():
    port = UdpPort()
    yield port
    port.close()


@pytest.fixture
def link(port, clock):
    with link_to(f"udpout:127.0.0.1:{port.number}", clock=clock) as link:
        yield link


@pytest.fixture
def peer(port, link):
    """An autopilot, system 7, through which a ground station speaks as well."""
    peer = Peer(port, system_id=7)
    peer.expect("HEARTBEAT")
    peer.heartbeat()
    wait_until(link.listens)
    return peer


def command_long(number, p1=0.0, p2=0.0, to=US):
    return mavlink.MAVLink_command_long_message(*to, number, 0, p1, p2, 0, 0, 0, 0, 0)


def command_int(number, p1=0.0, p2=0.0, to=US):
    return mavlink.MAVLink_command_int_message(*to, 0, number, 0, 0, p1, p2, 0, 0, 0, 0, 0)


def answered(peer, message):
    """The result that the ground station gets for a command."""
    peer.send(message, **STATION)
    ack = peer.expect("COMMAND_ACK")
    assert (ack.get_srcSystem(), ack.get_srcComponent()) == US
    assert (ack.command, ack.target_system, ack.target_component) == (message.command, 255, 190)
    assert (ack.progress, ack.result_param2) == (0, 0)
    return mavlink.enums["MAV_RESULT"][ack.result].name.removeprefix("MAV_RESULT_")


def before_mark(peer, link):
    """All that has arrived so far."""
    link.send(status_text(Severity.INFO, "mark"))
    return peer.expect_text("mark")


def unanswered(peer, link, *messages, sender=None):
    """Send messages that are to have no answer; return what came all the same."""
    before = sum(link.stats().received.values())
    for message in messages:
        peer.send(message, **(sender or STATION))
    wait_until(lambda: sum(link.stats().received.values()) == before + len(messages))
    # The first mark may overtake the answer to the last message; not so the second.
    came = before_mark(peer, link) + before_mark(peer, link)
    return [each.get_type() for each in came if each.get_type() != "HEARTBEAT"]


def test_a_ping_to_all_is_answered_to_its_sender_with_its_number_and_time(peer):
    peer.send(
        mavlink.MAVLink_ping_message(time_usec=2**60 + 1, seq=4711, target_system=0, target_component=0), **STATION
    )
    pong = peer.expect("PING")
    assert (pong.get_srcSystem(), pong.get_srcComponent()) == US
    assert (pong.time_usec, pong.seq) == (2**60 + 1, 4711)
    assert (pong.target_system, pong.target_component) == (255, 190)


def test_an_answer_to_a_ping_is_not_answered(peer, link):
    assert (
        unanswered(peer, link, mavlink.MAVLink_ping_message(1, 2, *US), mavlink.MAVLink_ping_message(1, 2, 255, 0))
        == []
    )


def test_a_request_for_the_time_is_answered_by_the_clock_that_stamps_the_messages(peer, clock):
    clock.now_s = 1234.5
    peer.send(mavlink.MAVLink_timesync_message(tc1=0, ts1=987_654_321_012))
    answer = peer.expect("TIMESYNC")
    assert (answer.tc1, answer.ts1) == (1_234_500_000_000, 987_654_321_012)


def test_an_answer_with_the_time_is_not_answered(peer, link):
    assert unanswered(peer, link, mavlink.MAVLink_timesync_message(tc1=5, ts1=6)) == []


@pytest.mark.parametrize("form", [command_long, command_int])
def test_the_heartbeat_can_be_asked_for(peer, link, form):
    link.set_health(Health.STANDBY)
    assert answered(peer, form(512, 0.0)) == "ACCEPTED"
    beat = peer.expect("HEARTBEAT")
    assert (beat.type, beat.autopilot, beat.system_status) == (18, 8, mavlink.MAV_STATE_STANDBY)


def test_the_version_can_be_asked_for(peer, monkeypatch):
    monkeypatch.setattr("edgevpr.mavlink.requests.__version__", "1.22.3.dev4")
    assert answered(peer, command_long(512, 148.0)) == "ACCEPTED"
    version = peer.expect("AUTOPILOT_VERSION")
    assert version.flight_sw_version == 0x01160300
    assert (
        version.capabilities == mavlink.MAV_PROTOCOL_CAPABILITY_MAVLINK2 | mavlink.MAV_PROTOCOL_CAPABILITY_COMMAND_INT
    )
    assert version.uid == 0


def test_the_state_of_the_computer_can_be_asked_for_once_there_is_one(peer, link, clock):
    assert answered(peer, command_long(512, STATUS)) == "TEMPORARILY_REJECTED"
    link.send(computer_status(clock.now_s, [0.5], 1 << 20, 2 << 20))
    peer.expect("ONBOARD_COMPUTER_STATUS")
    assert answered(peer, command_int(512, STATUS)) == "ACCEPTED"
    assert peer.expect("ONBOARD_COMPUTER_STATUS").cpu_cores[0] == 50


@pytest.mark.parametrize("number", [396.0, 33.0, -1.0, 0.5, math.nan, math.inf])
def test_any_other_message_that_is_asked_for_is_unsupported(peer, number):
    assert answered(peer, command_long(512, number)) == "UNSUPPORTED"


def statuses(peer, link, clock, count=10, step_s=1.0):
    """The seconds of so many states of the computer that arrive."""
    for _ in range(count):
        link.send(computer_status(clock.now_s, [0.5], 1 << 20, 2 << 20))
        arrived = [each for each in before_mark(peer, link) if each.get_type() == "ONBOARD_COMPUTER_STATUS"]
        yield len(arrived)
        clock.now_s += step_s


def test_a_stream_can_be_thinned_switched_off_and_left_as_it_was(peer, link, clock):
    assert answered(peer, command_long(511, STATUS, 3_000_000)) == "ACCEPTED"
    assert list(statuses(peer, link, clock)) == [1, 0, 0, 1, 0, 0, 1, 0, 0, 1]
    assert answered(peer, command_int(511, STATUS, -1)) == "ACCEPTED"
    assert sum(statuses(peer, link, clock)) == 0
    assert answered(peer, command_long(511, STATUS, 1_000_000)) == "ACCEPTED"
    assert sum(statuses(peer, link, clock, step_s=0.98)) == 10, "one that comes a little early is not left out"
    assert answered(peer, command_long(511, STATUS, 0)) == "ACCEPTED"
    assert sum(statuses(peer, link, clock, step_s=0.1)) == 10


def test_the_interval_of_named_values_is_that_of_each_name(peer, link, clock):
    assert answered(peer, command_long(511, NAMED, 2_000_000)) == "ACCEPTED"
    arrived = []
    for _ in range(4):
        link.send(*query_figures(clock.now_s, 0.5, 1.0))
        arrived.append([each.name for each in before_mark(peer, link) if each.get_type() == "NAMED_VALUE_FLOAT"])
        clock.now_s += 1.0
    assert arrived == [["vpr_cpu", "vpr_mah"], [], ["vpr_cpu", "vpr_mah"], []]


@pytest.mark.parametrize(
    ("message", "interval_us", "result"),
    [
        (STATUS, 999_000, "DENIED"),
        (STATUS, 3_600_000_001_000, "DENIED"),
        (STATUS, -2, "DENIED"),
        (STATUS, math.nan, "DENIED"),
        (NAMED, 99_000, "DENIED"),
        (NAMED, 100_000, "ACCEPTED"),
        (0, 1_000_000, "UNSUPPORTED"),
        (math.nan, 1_000_000, "UNSUPPORTED"),
    ],
)
def test_an_interval_out_of_bounds_is_denied(peer, message, interval_us, result):
    assert answered(peer, command_long(511, message, interval_us)) == result


@pytest.mark.parametrize("form", [command_long, command_int])
@pytest.mark.parametrize("wish", list(Wish))
def test_a_wish_that_can_be_fulfilled_is_accepted_and_handed_on(peer, link, form, wish):
    link.offer(tuple(Wish))
    assert answered(peer, form(31010, wish)) == "ACCEPTED"
    (wished,) = link.take_wishes()
    assert (wished.wish, wished.sender) == (wish, "255/190")
    assert link.take_wishes() == ()
    assert link.stats().commands == {"ACCEPTED": 1}


def test_a_wish_is_rejected_for_the_time_being_where_nobody_flies_or_learns(peer, link):
    assert answered(peer, command_long(31010, 1)) == "TEMPORARILY_REJECTED"
    link.offer((Wish.PAUSE, Wish.RESUME))
    assert answered(peer, command_long(31010, 3)) == "TEMPORARILY_REJECTED"
    assert answered(peer, command_long(31010, 2)) == "ACCEPTED"
    assert [each.wish for each in link.take_wishes()] == [Wish.RESUME]


@pytest.mark.parametrize("value", [0.0, 5.0, 1.5, -1.0, math.nan, math.inf])
def test_a_wrong_value_is_denied(peer, link, value):
    link.offer(tuple(Wish))
    assert answered(peer, command_long(31010, value)) == "DENIED"
    assert link.take_wishes() == ()


def test_of_wishes_that_contradict_each_other_the_newest_is_left_and_others_stay(peer, link):
    link.offer(tuple(Wish))
    for wish in (Wish.LEARN_NOTHING, Wish.PAUSE, Wish.RESUME, Wish.PAUSE):
        assert answered(peer, command_long(31010, wish)) == "ACCEPTED"
    assert {each.wish for each in link.take_wishes()} == {Wish.LEARN_NOTHING, Wish.PAUSE}


def test_no_fix_leaves_once_a_pause_is_acknowledged(peer, link, clock):
    link.offer(tuple(Wish))
    assert answered(peer, command_long(31010, 1)) == "ACCEPTED"
    sending = link.send_fix(Fix(50.0, 14.0, 25.0, clock.now_s))
    wait_until(lambda: sending.sent is not None)
    assert (sending.sent, sending.why) == (False, "not sent: paused by the ground")
    assert answered(peer, command_long(31010, 2)) == "ACCEPTED"
    link.send_fix(Fix(51.0, 14.0, 25.0, clock.now_s))
    assert peer.expect("COMMAND_INT").x == 510_000_000


@pytest.mark.parametrize("to", [(0, 0), (7, 0), (0, 197), (7, 1), (8, 197), (7, 191)])
def test_what_is_not_addressed_to_exactly_this_companion_is_not_obeyed(peer, link, to):
    link.offer(tuple(Wish))
    told = unanswered(
        peer, link, command_long(31010, 1, to=to), command_int(31010, 1, to=to), command_long(400, 1, to=to)
    )
    assert told == []
    assert link.take_wishes() == ()
    assert link.stats().commands == {}


@pytest.mark.parametrize("number", [400, 176, 246, 42007, 43003, 520, 0, 65_535])
def test_any_other_command_is_unsupported(peer, link, number):
    assert answered(peer, command_long(number, 1)) == "UNSUPPORTED"
    assert answered(peer, command_int(number, 1)) == "UNSUPPORTED"
    assert link.stats().commands == {"UNSUPPORTED": 2}


def test_all_else_that_is_for_us_is_ignored_and_counted(peer, link):
    told = unanswered(
        peer,
        link,
        mavlink.MAVLink_param_request_list_message(*US),
        mavlink.MAVLink_param_request_read_message(*US, b"X", -1),
        mavlink.MAVLink_param_set_message(*US, b"X", 1.0, 9),
        mavlink.MAVLink_mission_request_list_message(*US),
        mavlink.MAVLink_setup_signing_message(*US, [1] * 32, 5),
        mavlink.MAVLink_file_transfer_protocol_message(0, *US, [0] * 251),
        mavlink.MAVLink_command_ack_message(511, 0, 0, 0, *US),  # an answer to us is no request
        mavlink.MAVLink_param_request_list_message(7, 1),  # and this is not for us
    )
    assert told == []
    assert link.stats().ignored_requests == 6


def test_nothing_is_answered_that_claims_to_come_from_us(peer, link):
    sender = {"system_id": 7, "component_id": 197}
    assert unanswered(peer, link, mavlink.MAVLink_ping_message(1, 2, 0, 0), command_long(512), sender=sender) == []


def test_a_flood_of_requests_is_answered_in_part_and_does_not_push_out_what_we_say(peer, link, clock):
    pings = [mavlink.MAVLink_ping_message(1, number, 0, 0) for number in range(3 * ANSWERED_MAX)]
    assert unanswered(peer, link, *pings).count("PING") == ANSWERED_MAX
    assert link.stats().ignored_requests == 2 * ANSWERED_MAX
    assert link.stats().dropped_queue_full == 0
    clock.now_s += 1.0
    assert answered(peer, command_long(512, 0)) == "ACCEPTED"


def test_over_a_port_that_listens_only_the_autopilots_address_commands(clock):
    number = free_port()
    with link_to(f"udpin:127.0.0.1:{number}", clock=clock) as link:
        port, stranger = UdpPort(to=number), UdpPort(to=number)
        peer, other = Peer(port, system_id=7), Peer(stranger, system_id=255)
        peer.heartbeat()
        wait_until(link.listens)
        link.offer(tuple(Wish))
        other.send(command_long(31010, 1), component_id=190)
        wait_until(lambda: link.stats().foreign_messages == 1)
        assert link.take_wishes() == ()
        assert answered(peer, command_long(31010, 1)) == "ACCEPTED"
        port.close()
        stranger.close()


def test_pymavlinks_own_connection_pauses_the_flight(monkeypatch, clock):
    monkeypatch.setenv("MAVLINK20", "1")
    from pymavlink import mavutil

    number = free_port()
    station = mavutil.mavlink_connection(f"udpin:127.0.0.1:{number}", dialect="all", source_system=255)
    with link_to(f"udpout:127.0.0.1:{number}", clock=clock) as link:
        link.offer(tuple(Wish))
        beat = station.recv_match(type="HEARTBEAT", blocking=True, timeout=60)
        us = beat.get_srcSystem(), beat.get_srcComponent()
        assert us == (1, 197), "before an autopilot is heard"
        station.mav.command_long_send(*us, mavutil.mavlink.MAV_CMD_USER_1, 0, 1, 0, 0, 0, 0, 0, 0)
        ack = station.recv_match(type="COMMAND_ACK", blocking=True, timeout=60)
        assert (ack.command, ack.result, ack.target_system) == (31010, mavutil.mavlink.MAV_RESULT_ACCEPTED, 255)
        assert [each.wish for each in link.take_wishes()] == [Wish.PAUSE]
    station.close()
