"""The people on the ground: requests to this companion, each with an answer that can be sent, and texts for them."""

import itertools
import math

import pytest

from edgevpr.core.reasons import ReasonCode
from edgevpr.mavlink.ground import MAX_ANSWERS_PER_S, Requests, Texts, UserCommand
from edgevpr.mavlink.messages import Severity, make_status_text
from edgevpr.mavlink.wire import mavlink

US = (7, 197)
STATION = (255, 190)
ODD = (math.nan, math.inf, -math.inf, -0.0, -1.0, 1e-45, 0.5, 1.0, 3.0, 4.5, 148.0, 251.0, 390.0, 1e6, 2.0**64, 3e38)


def make_command_long(number, p1=0.0, p2=0.0, to=US):
    return mavlink.MAVLink_command_long_message(*to, number, 0, p1, p2, 0, 0, 0, 0, 0)


def make_command_int(number, p1=0.0, p2=0.0, to=US):
    return mavlink.MAVLink_command_int_message(*to, 0, number, 0, 0, p1, p2, 0, 0, 0, 0, 0)


def collect_replies(autopilot, *messages, sender=STATION):
    """What comes for messages of the ground station."""
    autopilot.take_sent()
    for message in messages:
        autopilot.send(message, *sender)
    return autopilot.take_sent()


def read_result(autopilot, message):
    """The result that the ground station gets for a command."""
    (ack,) = collect_replies(autopilot, message)
    assert (ack.get_type(), ack.get_srcSystem(), ack.get_srcComponent()) == ("COMMAND_ACK", *US)
    assert (ack.command, ack.target_system, ack.target_component) == (message.command, *STATION)
    assert (ack.progress, ack.result_param2) == (0, 0)
    return mavlink.enums["MAV_RESULT"][ack.result].name.removeprefix("MAV_RESULT_")


@pytest.fixture
def requests(autopilot):
    autopilot.conversation.requests.is_flying = True
    return autopilot.conversation.requests


def test_timesync_request_is_answered_by_the_clock_of_the_timestamps(autopilot):
    autopilot.clock.now_s = 1234.5
    (answer,) = collect_replies(autopilot, mavlink.MAVLink_timesync_message(tc1=0, ts1=987_654_321_012))
    assert (answer.tc1, answer.ts1) == (1_234_500_000_000, 987_654_321_012)
    assert collect_replies(autopilot, mavlink.MAVLink_timesync_message(tc1=5, ts1=6)) == [], "an answer is not answered"


@pytest.mark.parametrize("form", [make_command_long, make_command_int])
@pytest.mark.parametrize("wish", list(UserCommand))
def test_user_command_is_accepted_and_passed_on(autopilot, requests, form, wish):
    assert read_result(autopilot, form(31010, wish)) == "ACCEPTED"
    assert requests.take() == (wish, "255/190")
    assert requests.take() is None


def test_pause_acknowledged_stops_all_fixes(autopilot, requests):
    assert read_result(autopilot, make_command_long(31010, 1)) == "ACCEPTED"
    held = autopilot.put_fix()
    assert (held.sent, held.why.code) == (False, ReasonCode.PAUSED)
    assert read_result(autopilot, make_command_long(31010, 2)) == "ACCEPTED"
    assert autopilot.put_fix().sent


@pytest.mark.parametrize("to", [(0, 0), (7, 0), (0, 197), (7, 1), (8, 197), (7, 191)])
def test_commands_to_another_address_are_ignored(autopilot, requests, to):
    commands = make_command_long(31010, 1, to=to), make_command_int(31010, 1, to=to), make_command_long(400, 1, to=to)
    assert collect_replies(autopilot, *commands) == []
    assert requests.take() is None


def test_requests_that_claim_our_own_address_get_no_answer(autopilot):
    messages = mavlink.MAVLink_timesync_message(tc1=0, ts1=1), make_command_long(512, 148)
    assert collect_replies(autopilot, *messages, sender=US) == []


def test_requests_in_a_flood_are_answered_in_part_and_do_not_displace_our_messages(autopilot, requests):
    flood = [mavlink.MAVLink_timesync_message(tc1=0, ts1=number) for number in range(3 * MAX_ANSWERS_PER_S)]
    autopilot.take_sent()
    autopilot.conversation.send(make_status_text(INFO, "ours"))
    for message in flood:
        autopilot.send(message, *STATION)
    ours, *answers = autopilot.take_sent()
    assert ours.text == "ours"
    assert [answer.ts1 for answer in answers] == list(range(MAX_ANSWERS_PER_S))
    autopilot.wait(1.0)
    assert read_result(autopilot, make_command_long(31010, 1)) == "ACCEPTED"


def react(message, sender=STATION):
    """The replies to a message, the requests that it has met, and the wish."""
    requests = Requests()
    requests.is_flying = True
    message._header.srcSystem, message._header.srcComponent = sender
    return requests.handle(message, US, 5.0), requests, requests.take()


def test_command_with_any_content_gets_exactly_one_answer():
    packer = mavlink.MAVLink(None, *US)
    for command, p1, p2, sender in itertools.product((31010, 511, 512), ODD, ODD, (STATION, (1, 1), (255, 0))):
        (ack,), _, wished = react(make_command_long(command, p1, p2), sender)
        assert ack.pack(packer)
        assert (ack.get_type(), ack.command) == ("COMMAND_ACK", command)
        assert (ack.target_system, ack.target_component) == sender
        assert bool(wished) == (command == 31010 and p1 in (1, 2))
        refusal = mavlink.MAV_RESULT_DENIED if command == 31010 else mavlink.MAV_RESULT_UNSUPPORTED
        assert ack.result == (mavlink.MAV_RESULT_ACCEPTED if wished else refusal)


WARNING = Severity.WARNING
INFO = Severity.INFO


@pytest.fixture
def texts():
    """Texts of which one has just been sent, at second 0."""
    texts = Texts()
    texts.put(INFO, "first")
    assert texts.next(0.0).text == "edgevpr: first"
    return texts


def collect(texts: Texts, from_s: float = 0.0) -> list[tuple[int, str]]:
    """All that is told from a moment on, asked ten times a second."""
    said = []
    for tenth in range(round(from_s * 10), 10 * 200):
        if message := texts.next(tenth / 10):
            said.append((tenth / 10, message.text.removeprefix("edgevpr: ")))
    return said


def test_text_queue_sends_one_text_in_five_seconds(texts):
    for name in "abc":
        texts.put(INFO, name)
    assert collect(texts) == [(5.0, "a"), (10.0, "b"), (15.0, "c")]
    texts.put(INFO, "late")
    assert texts.next(500.0).text == "edgevpr: late", "after a silence at once"


def test_text_queue_replaces_a_waiting_text_of_the_same_topic(texts):
    texts.put(WARNING, "camera lost", "camera")
    texts.put(WARNING, "map left", "map")
    texts.put(WARNING, "camera frozen", "camera")
    assert [text for _, text in collect(texts)] == ["camera frozen", "map left"]
    texts.put(INFO, "map found again", "map")
    texts.put(WARNING, "map left", "map")
    assert collect(texts, 100.0) == [], "what comes and goes again before its turn is no change"


def test_text_queue_drops_a_note_of_recovery_after_a_new_warning(texts):
    texts.put(WARNING, "camera lost", "camera")
    texts.put(INFO, "camera back", "camera")
    texts.put(WARNING, "camera frozen", "camera")
    assert [text for _, text in collect(texts)] == ["camera frozen"]
    texts.put(WARNING, "camera lost", "camera")
    texts.put(INFO, "camera back", "camera")
    assert [text for _, text in collect(texts, 100.0)] == ["camera lost", "camera back"], "a note hides no warning"
