"""Which fix an answer belongs to, what becomes of those without one, and what is said of both: over real links."""

import logging
import math
import socket
from contextlib import closing

import pytest
from fakes import FakeClock
from mavlink_peers import Peer, TcpServer, UdpPort, free_port, link_to, wait_until

from edgevpr.mavlink import readiness as reasons
from edgevpr.mavlink.fixes import FixAnswer, Fixes, Sending
from edgevpr.mavlink.messages import Fix
from edgevpr.mavlink.readiness import GPS_IN_USE, AutopilotState
from edgevpr.mavlink.wire import mavlink

ACCEPTED, FAILED, IN_PROGRESS = mavlink.MAV_RESULT_ACCEPTED, mavlink.MAV_RESULT_FAILED, mavlink.MAV_RESULT_IN_PROGRESS
LATE = FixAnswer(None, "it had no answer within 1 s", None)
ARMED = mavlink.MAV_MODE_FLAG_SAFETY_ARMED


def sent(fixes, t_s):
    sending = Sending(Fix(50.0, 8.0, 20.0, t_s), t_s + 1)
    fixes.note_sent(sending, t_s, has_answer=True)
    sending.settle(True)
    return sending


def test_one_fix_a_second_has_its_own_answer_though_some_are_lost():
    fixes, sendings = Fixes(), []
    for t_s in range(10):
        sendings.append(sent(fixes, t_s))
        if t_s not in (3, 4):
            fixes.hear("ACCEPTED" if t_s % 2 else "FAILED", AutopilotState(gps_age_s=0.0), t_s + 0.02)
    answers = [sending.answer for sending in sendings]
    assert answers == [None if t_s in (3, 4) else ("ACCEPTED" if t_s % 2 else "FAILED") for t_s in range(10)]
    assert sendings[3].outcome == sendings[4].outcome == LATE
    assert sendings[9].outcome == FixAnswer("ACCEPTED", None, pytest.approx(0.02))
    assert (fixes.unanswered, len(fixes), fixes.refusal) == (2, 0, GPS_IN_USE)


def test_of_several_fixes_under_way_the_oldest_is_answered():
    fixes = Fixes()
    first, second, third = (sent(fixes, t_s) for t_s in (0.0, 0.2, 0.4))
    assert fixes.hear("FAILED", AutopilotState(), 0.5) is first
    assert fixes.hear("ACCEPTED", AutopilotState(), 0.6) is second
    assert third.outcome is None
    assert len(fixes) == 1


def test_an_answer_that_is_late_or_one_too_many_belongs_to_no_fix():
    fixes = Fixes()
    late = sent(fixes, 0.0)
    assert fixes.hear("FAILED", AutopilotState(), 1.1) is None
    assert late.outcome == LATE
    new = sent(fixes, 2.0)
    assert fixes.hear("FAILED", AutopilotState(), 2.1) is new
    assert fixes.hear("FAILED", AutopilotState(), 2.1) is None
    assert fixes.unanswered == 1


def test_a_fix_may_be_in_the_position_unless_it_was_refused():
    fixes = Fixes()
    assert fixes.t_fix_s == -math.inf
    sent(fixes, 10.0)
    assert fixes.t_fix_s == 10.0, "it may be taken before the answer comes"
    fixes.hear("FAILED", AutopilotState(), 10.1)
    assert fixes.t_fix_s == -math.inf
    sent(fixes, 11.0)
    fixes.hear("ACCEPTED", AutopilotState(), 11.1)
    assert fixes.t_fix_s == 11.1
    sent(fixes, 12.0)
    fixes.hear("DENIED", AutopilotState(), 12.1)
    assert fixes.t_fix_s == 11.1
    sent(fixes, 13.0)
    fixes.time_out(14.1)
    assert fixes.t_fix_s == 13.0, "only the answer may have been lost"
    sent(fixes, 15.0)
    fixes.break_off("the link was lost")
    assert fixes.t_fix_s == 15.0
    fixes.hear("ACCEPTED", AutopilotState(), 17.0)
    assert fixes.t_fix_s == 17.0, "a fix was taken, whichever it was"


def test_a_message_without_answers_is_waited_for_by_nobody_and_may_be_taken():
    fixes, sending = Fixes(), Sending(Fix(50.0, 8.0, 20.0, 5.0), 6.0)
    fixes.note_sent(sending, 5.0, has_answer=False)
    assert sending.outcome == FixAnswer(None, "its message has no answer", None)
    assert (len(fixes), fixes.unanswered, fixes.t_fix_s) == (0, 0, 5.0)


@pytest.fixture
def clock():
    return FakeClock()


@pytest.fixture
def link_and_peer(clock):
    with (
        closing(UdpPort()) as port,
        link_to(f"udpout:127.0.0.1:{port.number}", clock=clock) as link,
    ):
        peer = Peer(port, 7)
        peer.expect("HEARTBEAT")
        yield link, peer


def say(link, peer, message):
    """Let the autopilot say something, and wait until it is heard."""
    before = link.stats().received.get(message.get_type(), 0)
    peer.send(message)
    wait_until(lambda: link.stats().received.get(message.get_type(), 0) > before)


def beat(link, peer, base_mode=ARMED):
    say(link, peer, mavlink.MAVLink_heartbeat_message(2, mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA, base_mode, 0, 4, 3))


def gps(fix_type):
    return mavlink.MAVLink_gps_raw_int_message(0, fix_type, 0, 0, 0, 0, 0, 0, 0, 9)


def refused(link, peer, clock, result=FAILED, after_s=1.0):
    """Send a fix that is answered after 30 ms; give what became of it."""
    clock.now_s += after_s
    beat(link, peer)
    sending = link.send_fix(Fix(50.0, 8.0, 20.0, clock.now_s))
    peer.expect("COMMAND_INT")
    sending.wait(60)
    clock.now_s += 0.03
    peer.answer_fix(result)
    wait_until(lambda: sending.outcome, "the answer")
    return sending.outcome


def test_a_refused_fix_says_why_by_what_the_autopilot_has_said(link_and_peer, clock):
    link, peer = link_and_peer
    beat(link, peer)
    say(link, peer, gps(mavlink.GPS_FIX_TYPE_3D_FIX))
    assert refused(link, peer, clock) == FixAnswer("FAILED", GPS_IN_USE.sentence, pytest.approx(0.03))
    clock.now_s += 2
    say(link, peer, gps(mavlink.GPS_FIX_TYPE_NO_FIX))
    assert refused(link, peer, clock).why == reasons.UNKNOWN.sentence
    request = peer.expect("COMMAND_LONG")
    assert (request.command, request.param1) == (512, 49), "it is asked for its origin"
    assert refused(link, peer, clock, after_s=3.0).why == reasons.NO_ORIGIN.sentence
    say(link, peer, mavlink.MAVLink_gps_global_origin_message(1, 1, 1))
    say(link, peer, mavlink.MAVLink_ekf_status_report_message(mavlink.EKF_CONST_POS_MODE, 0, 0, 0, 0, 0))
    assert refused(link, peer, clock).why == reasons.NOT_RECKONING.sentence
    assert refused(link, peer, clock, ACCEPTED).why is None
    assert link.stats().acks == {"FAILED": 4, "ACCEPTED": 1}
    assert link.stats().refused_why == "nothing to reckon by"


def test_an_origin_is_asked_for_again_and_the_reason_does_not_change_meanwhile(link_and_peer, clock):
    link, peer = link_and_peer
    beat(link, peer)
    why = [refused(link, peer, clock).why for _ in range(25)]
    assert why[:2] == [reasons.UNKNOWN.sentence] * 2
    assert set(why[2:]) == {reasons.NO_ORIGIN.sentence}
    link.send(mavlink.MAVLink_statustext_message(6, b"end"))
    asked = [m for m in peer.expect_text("end") if m.get_type() == "COMMAND_LONG"]
    assert len(asked) <= 3


def test_the_ground_station_hears_each_reason_once_and_that_fixes_are_taken_again(link_and_peer, clock, caplog):
    caplog.set_level(logging.INFO, "edgevpr.mavlink")
    link, peer = link_and_peer
    beat(link, peer)
    for result in (ACCEPTED, FAILED, FAILED, mavlink.MAV_RESULT_DENIED, ACCEPTED, ACCEPTED):
        clock.now_s += 5.0  # the ground is told one thing in five seconds
        say(link, peer, gps(mavlink.GPS_FIX_TYPE_3D_FIX))
        beat(link, peer)
        sending = link.send_fix(Fix(50.0, 8.0, 20.0, clock.now_s))
        sending.wait(60)
        peer.answer_fix(result)
        wait_until(lambda sending=sending: sending.outcome)
        beat(link, peer)
    link.send(mavlink.MAVLink_statustext_message(6, b"end"))
    texts = [(m.severity, m.text) for m in peer.expect_text("end") if m.get_type() == "STATUSTEXT"]
    assert texts == [
        (6, "edgevpr: fixes refused: GPS in use"),
        (4, "edgevpr: fixes refused: wrong form"),
        (6, "edgevpr: fixes are taken again"),
    ]
    assert caplog.text.count("the autopilot's answer to position fixes") == 4


def test_an_answer_in_progress_is_none_yet(link_and_peer, clock):
    link, peer = link_and_peer
    beat(link, peer)
    sending = link.send_fix(Fix(50.0, 8.0, 20.0, clock.now_s))
    sending.wait(60)
    before = link.stats().received.get("COMMAND_ACK", 0)
    peer.answer_fix(IN_PROGRESS)
    wait_until(lambda: link.stats().received.get("COMMAND_ACK", 0) > before)
    peer.answer_fix(ACCEPTED)
    wait_until(lambda: sending.outcome)
    assert (sending.answer, link.stats().acks) == ("ACCEPTED", {"ACCEPTED": 1})


def test_a_fix_that_nobody_answers_says_so_after_a_second(link_and_peer, clock):
    link, peer = link_and_peer
    beat(link, peer)
    sending = link.send_fix(Fix(50.0, 8.0, 20.0, clock.now_s))
    sending.wait(60)
    clock.now_s += 1.01
    beat(link, peer)
    wait_until(lambda: sending.outcome)
    assert sending.outcome == LATE
    assert link.stats().unanswered_fixes == 1


@pytest.mark.parametrize(("answers_others", "text"), [(False, "signing? system id?"), (True, "no command 43003?")])
def test_silence_to_five_fixes_says_whether_other_commands_are_answered(link_and_peer, clock, answers_others, text):
    link, peer = link_and_peer
    beat(link, peer)
    peer.answer_fix(ACCEPTED, command=511, to=191)
    if answers_others:
        peer.answer_fix(ACCEPTED, command=511)
    wait_until(lambda: link.stats().received.get("COMMAND_ACK") == 1 + answers_others)
    for _ in range(7):
        clock.now_s += 1.0
        beat(link, peer)
        link.send_fix(Fix(50.0, 8.0, 20.0, clock.now_s)).wait(60)
    peer.expect_text(f"edgevpr: fixes unanswered: {text}")


def test_a_link_that_is_lost_and_a_flight_that_ends_take_the_answers_along(clock):
    number = free_port(socket.SOCK_STREAM)
    with closing(TcpServer(number)) as server:
        with link_to(f"tcp:127.0.0.1:{number}", clock=clock) as link:
            for how in ("lost", "closed"):
                peer = Peer(server.accept(), 7)
                beat(link, peer)
                sending = link.send_fix(Fix(50.0, 8.0, 20.0, clock.now_s))
                peer.expect("COMMAND_INT")
                sending.wait(60)
                if how == "lost":
                    peer.port.close()
                    wait_until(lambda: sending.outcome)  # noqa: B023
                    assert sending.outcome == FixAnswer(None, "the link was lost before its answer came", None)
        assert sending.outcome == FixAnswer(None, "the flight ended before its answer came", None)


def test_the_report_of_the_vehicle_says_when_a_fix_may_have_come_into_it(link_and_peer, clock):
    link, peer = link_and_peer
    beat(link, peer)
    say(link, peer, mavlink.MAVLink_global_position_int_message(0, 500_000_000, 80_000_000, 300_000, 0, 0, 0, 0, 0))
    assert wait_until(lambda: link.vehicle_at(clock.now_s)).t_fix_s == -math.inf
    refused(link, peer, clock)
    assert link.vehicle_at(clock.now_s).t_fix_s == -math.inf
    refused(link, peer, clock, ACCEPTED)
    assert link.vehicle_at(clock.now_s).t_fix_s == clock.now_s
