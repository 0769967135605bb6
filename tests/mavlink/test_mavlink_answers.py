"""Fixes that nobody answers: five stop the sending, one now and then asks again, and both ends of it are said."""

import socket
from contextlib import closing

import pytest
from fakes import FakeClock
from mavlink_peers import Peer, TcpServer, UdpPort, free_port, link_to, wait_until

from edgevpr.mavlink.fixes import FixAnswer, Fixes, Sending
from edgevpr.mavlink.messages import Fix
from edgevpr.mavlink.readiness import AutopilotState
from edgevpr.mavlink.wire import mavlink

UNANSWERED = "not sent: five fixes in a row had no answer"
STOPPED, ANSWERED = "edgevpr: fixes unanswered: signing? system id?", "edgevpr: fixes are answered again"


def sending_of(t_s):
    return Sending(Fix(50.0, 8.0, 20.0, t_s), t_s + 1)


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


def beat(link, peer):
    before = link.stats().received.get("HEARTBEAT", 0)
    peer.heartbeat()
    wait_until(lambda: link.stats().received.get("HEARTBEAT", 0) > before and link.listens())


def fly(link, peer, clock, fixes, every_s=1.0):
    """Send a fix every so often to an autopilot that is there; returns what became of each, with its time."""
    became = []
    for _ in range(fixes):
        clock.now_s += every_s
        beat(link, peer)
        sending = link.send_fix(Fix(50.0, 8.0, 20.0, clock.now_s))
        sending.wait(60)
        became.append((clock.now_s, sending))
    return became


def answer(link, peer, result=mavlink.MAV_RESULT_ACCEPTED):
    before = sum(link.stats().acks.values())
    peer.answer_fix(result)
    wait_until(lambda: sum(link.stats().acks.values()) > before)


def test_five_unanswered_fixes_stop_the_sending_and_one_in_ten_seconds_asks_again(link_and_peer, clock):
    link, peer = link_and_peer
    became = fly(link, peer, clock, 40)
    sent_s = [t_s - became[0][0] for t_s, sending in became if sending.sent]
    assert sent_s == [0, 1, 2, 3, 4, 14, 24, 34]
    assert {sending.why for _, sending in became if not sending.sent} == {UNANSWERED}
    assert (link.stats().fixes_sent, link.stats().withheld_fixes) == (8, 32)


def test_the_stop_and_the_recovery_are_said_once_each(link_and_peer, clock, caplog):
    link, peer = link_and_peer
    fly(link, peer, clock, 30)
    peer.expect_text(STOPPED)
    answer(link, peer)
    before = [message.text for message in peer.expect_text(ANSWERED) if message.get_type() == "STATUSTEXT"]
    assert before == [], "the stop was said twice"
    assert caplog.text.count("five fixes in a row had no answer") == 1
    assert caplog.text.count("position fixes are answered again") == 1


def test_one_answer_of_any_kind_lets_the_fixes_go_on(link_and_peer, clock):
    link, peer = link_and_peer
    fly(link, peer, clock, 8)
    answer(link, peer, mavlink.MAV_RESULT_FAILED)
    assert [sending.sent for _, sending in fly(link, peer, clock, 7)] == [True] * 5 + [False] * 2


def test_a_missing_answer_now_and_then_stops_nothing(link_and_peer, clock):
    link, peer = link_and_peer
    for _ in range(10):
        assert all(sending.sent for _, sending in fly(link, peer, clock, 4))
        answer(link, peer)
    assert link.stats().withheld_fixes == 0


def test_late_answers_to_the_fixes_of_before_do_not_pass_for_one_to_a_new_fix(link_and_peer, clock):
    link, peer = link_and_peer
    became = fly(link, peer, clock, 6)
    last = became[4][1]
    wait_until(lambda: link.stats().unanswered_fixes >= 4)
    clock.now_s += 0.1
    answer(link, peer)
    ((_, held),) = fly(link, peer, clock, 1, every_s=0.4)
    assert (held.sent, held.why) == (False, "not sent: the autopilot has only just begun to answer again")
    for _ in range(4):
        answer(link, peer, mavlink.MAV_RESULT_DENIED)
    ((_, new),) = fly(link, peer, clock, 1, every_s=0.6)
    assert (new.sent, new.answer) == (True, None)
    assert last.outcome == FixAnswer(None, "it had no answer within 1 s", None)
    assert link.stats().unanswered_fixes == 5


def test_answers_that_take_half_a_second_stop_no_quick_fixes_and_nothing_is_said():
    fixes, state, news, sent = Fixes(), AutopilotState(), [], 0
    due_s = []
    for step in range(1000):  # ten fixes a second, each answered after half a second
        now_s = step / 10
        while due_s and due_s[0] <= now_s:
            due_s.pop(0)
            fixes.hear("ACCEPTED", state, now_s)
        if fixes.why_not(now_s) is None:
            fixes.note_sent(sending_of(now_s), now_s, has_answer=True)
            due_s.append(now_s + 0.45)
            sent += 1
        news.append(fixes.news_of_silence(state, now_s))
    assert not any(news)
    assert sent > 900


def test_a_peer_that_stops_reading_for_a_minute_finds_a_few_fixes_and_not_all(clock):
    """The autopilot goes on beating, and its system takes what it does not read."""
    number = free_port(socket.SOCK_STREAM)
    with (
        closing(TcpServer(number)) as server,
        link_to(f"tcp:127.0.0.1:{number}", clock=clock) as link,
    ):
        peer = Peer(server.accept(), 7)
        start_s = clock.now_s
        became = fly(link, peer, clock, 180, every_s=1 / 3)
        assert clock.now_s == pytest.approx(start_s + 60)
        peer.port.settimeout(1.0)
        found = []
        try:
            while True:
                peer.read()
                found += [m.param1 for m in peer.seen if m.get_type() == "COMMAND_INT"]
                peer.seen.clear()
        except TimeoutError:
            pass
        sent = [t_s for t_s, sending in became if sending.sent]
        assert found == pytest.approx(sent, abs=0.01)
        assert len(found) == 10, "five, and one every ten seconds"


def test_another_autopilot_starts_with_a_clean_slate(link_and_peer, clock):
    link, peer = link_and_peer
    fly(link, peer, clock, 8)
    for _ in range(35):
        clock.now_s += 1.0
        before = link.stats().received["HEARTBEAT"]
        peer.heartbeat(system_id=9)
        wait_until(lambda before=before: link.stats().received["HEARTBEAT"] > before)
    assert link.stats().autopilot_system_id == 9
    for _ in range(5):
        sending = link.send_fix(Fix(50.0, 8.0, 20.0, clock.now_s))
        sending.wait(60)
        assert sending.sent


def test_fixes_thrown_away_with_the_port_wait_for_no_answer_but_do_not_end_a_stop():
    fixes, state = Fixes(), AutopilotState()

    def note_sent(*times_s):
        for t_s in times_s:
            fixes.note_sent(sending_of(t_s), t_s, has_answer=True)

    note_sent(0, 1, 2, 3, 4)
    fixes.note_lost(3)
    assert (fixes._row, fixes.why_not(5.0)) == (2, None)
    note_sent(5, 6, 7)
    assert fixes.news_of_silence(state, 8.5)
    note_sent(17.5)
    fixes.note_lost(2)
    assert (fixes.why_not(20.0), fixes.news_of_silence(state, 20.0)) == (UNANSWERED, None)


def test_over_tcp_every_answer_is_that_of_its_fix(clock):
    number = free_port(socket.SOCK_STREAM)
    with (
        closing(TcpServer(number)) as server,
        link_to(f"tcp:127.0.0.1:{number}", clock=clock) as link,
    ):
        peer = Peer(server.accept(), 7)
        beat(link, peer)
        for turn in range(20):
            sending = link.send_fix(Fix(50.0, 8.0, 20.0, clock.now_s))
            peer.expect("COMMAND_INT")
            answer(link, peer, result=turn % 2)
            wait_until(lambda sending=sending: sending.answer, "the answer")
            assert sending.answer == ("ACCEPTED", "TEMPORARILY_REJECTED")[turn % 2]
