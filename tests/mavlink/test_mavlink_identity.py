"""Which autopilot is ours: the one kept, others refused, and the rule by which one takes the place of another."""

import logging
import socket

import pytest
from fakes import FakeClock
from mavlink_peers import Peer, TcpServer, UdpPort, free_port, link_to, wait_until

from edgevpr.mavlink.link import Link
from edgevpr.mavlink.messages import Fix
from edgevpr.mavlink.peer import Identity, Speaker
from edgevpr.mavlink.wire import mavlink

OURS, FOREIGN = Speaker(1, None), Speaker(2, None)
HERE, THERE = ("127.0.0.1", 1000), ("127.0.0.1", 2000)


def beat(identity: Identity, speaker: Speaker, *times_s: float) -> list[bool]:
    return [identity.admits(speaker, True, t_s) for t_s in times_s]


def seconds(first: float, last: float) -> list[float]:
    """Every second from `first` to `last`."""
    return [first + count for count in range(round(last - first) + 1)]


def test_the_first_autopilot_heard_is_kept_while_it_speaks(caplog):
    identity = Identity()
    assert not identity.admits(OURS, False, 0.0), "what is no heartbeat makes nobody ours"
    for t_s in seconds(0, 100):
        assert identity.admits(OURS, True, t_s)
        assert not identity.admits(FOREIGN, True, t_s + 0.5)
        assert not identity.admits(FOREIGN, False, t_s + 0.6)
    assert identity.foreign_messages == 202
    for t_s in seconds(101, 400):
        assert not identity.admits(FOREIGN, True, t_s), "another system is never taken"
    assert identity.kept == OURS
    assert caplog.text.count("another autopilot, system 2") == 1


def test_the_same_system_from_elsewhere_is_taken_after_thirty_seconds_of_silence(caplog):
    identity = Identity()
    beat(identity, Speaker(1, HERE), 0.0)
    for t_s in seconds(20, 40):
        assert beat(identity, Speaker(7, THERE), t_s) == [False]
        assert beat(identity, Speaker(1, THERE), t_s + 0.5) == [t_s >= 30]
        assert identity.has_moved == (t_s == 30)
    assert "for 30 s" in caplog.text
    assert beat(identity, Speaker(1, HERE), 41.0) == [False]


def test_a_configured_system_is_never_given_up_but_may_come_from_elsewhere(caplog):
    identity = Identity(system_id=1)
    assert not any(beat(identity, Speaker(2, HERE), *seconds(0, 99)))
    assert identity.foreign_messages == 100
    assert caplog.text.count("fixes go to system 1 only") == 1
    assert beat(identity, Speaker(1, HERE), 100.0) == [True]
    assert not any(beat(identity, Speaker(2, HERE), *seconds(101, 200)))
    assert beat(identity, Speaker(1, THERE), 129.0, 130.0) == [False, True]
    assert identity.kept == Speaker(1, THERE)


@pytest.fixture
def listening(clock):
    """A link that listens, and a call that makes an autopilot at a port of its own."""
    number, ports = free_port(), []

    def autopilot(system_id: int) -> Peer:
        ports.append(UdpPort(to=number))
        return Peer(ports[-1], system_id)

    with link_to(f"udpin:127.0.0.1:{number}", clock=clock) as link:
        yield link, autopilot
    for port in ports:
        port.close()


def speak(link: Link, peer: Peer, clock: FakeClock, beats: int, **sender: int) -> None:
    """Let an autopilot send a heartbeat a second."""
    for _ in range(beats):
        clock.now_s += 1.0
        before = link.stats().received.get("HEARTBEAT", 0)
        peer.heartbeat(**sender)
        wait_until(lambda before=before: link.stats().received.get("HEARTBEAT", 0) > before, "the heartbeat")


def became_of_a_fix(link: Link, clock: FakeClock) -> bool:
    """Send a fix; tell whether it left."""
    sending = link.send_fix(Fix(50.0, 8.0, 20.0, clock.now_s))
    if not link.listens():
        clock.now_s += 1.1
        wait_until(lambda: sending.sent is not None, "giving up the fix")
    sending.wait(60)
    return bool(sending.sent)


def names(peer: Peer) -> list[str]:
    """Names of all messages that have come by now."""
    peer.port._sock.setblocking(False)
    try:
        while True:
            peer.read()
    except BlockingIOError:
        return [message.get_type() for message in peer.seen]


@pytest.mark.network
def test_a_second_socket_with_our_autopilots_number_gets_no_fix_while_ours_speaks(listening, clock, caplog):
    link, autopilot = listening
    ours, thief = autopilot(1), autopilot(1)
    speak(link, ours, clock, 1)
    ours.synchronise(link)
    for _ in range(40):
        speak(link, thief, clock, 1)
        thief.answer_fix(mavlink.MAV_RESULT_ACCEPTED)
        speak(link, ours, clock, 1)
        assert became_of_a_fix(link, clock)
        assert ours.expect("COMMAND_INT").target_system == 1
        ours.answer_fix(mavlink.MAV_RESULT_FAILED)
    wait_until(lambda: link.stats().acks.get("FAILED") == 40)
    assert names(thief) == []
    assert link.stats().acks == {"FAILED": 40}, "nor is it believed"
    assert link.stats().foreign_messages == 80
    assert caplog.text.count("another autopilot, system 1") == 1


@pytest.mark.network
def test_an_autopilot_that_comes_back_from_elsewhere_is_taken_and_the_ground_is_told(listening, clock):
    link, autopilot = listening
    before = autopilot(1)
    speak(link, before, clock, 2)
    before.synchronise(link)
    assert became_of_a_fix(link, clock)
    clock.now_s += 20.0
    after = autopilot(1)
    speak(link, after, clock, 7)
    assert not became_of_a_fix(link, clock)
    speak(link, after, clock, 7)
    after.synchronise(link)
    assert became_of_a_fix(link, clock)
    after.expect_text("edgevpr: autopilot has another address")
    assert after.expect("COMMAND_INT").target_system == 1
    assert names(before).count("COMMAND_INT") == 1


@pytest.mark.network
def test_the_configured_system_is_our_own_number_from_the_start_and_the_only_one_sent_to(clock):
    number = free_port()
    with link_to(f"udpin:127.0.0.1:{number}", clock=clock, system_id=5) as link:
        port = UdpPort(to=number)
        peer = Peer(port, system_id=9)
        speak(link, peer, clock, 40)
        assert peer.expect("HEARTBEAT").get_srcSystem() == 5
        assert not became_of_a_fix(link, clock)
        assert link.stats().autopilot_system_id is None
        speak(link, peer, clock, 1, system_id=5)
        peer.synchronise(link)
        assert became_of_a_fix(link, clock)
        assert peer.expect("COMMAND_INT").target_system == 5
        port.close()


@pytest.mark.network
def test_after_a_reconnection_no_fix_leaves_before_ours_has_spoken(clock, caplog):
    caplog.set_level(logging.INFO, "edgevpr.mavlink")
    number = free_port(socket.SOCK_STREAM)
    server = TcpServer(number)
    with link_to(f"tcp:127.0.0.1:{number}", clock=clock) as link:
        ours = Peer(server.accept(), 1)
        speak(link, ours, clock, 1)
        ours.synchronise(link)
        server.close()
        wait_until(lambda: not link.stats().connected, "noticing the loss")
        server = TcpServer(number)
        stranger = Peer(server.accept(), 2)
        speak(link, stranger, clock, 3)
        assert not became_of_a_fix(link, clock), "ours was heard 4 s ago, but over another connection"
        speak(link, stranger, clock, 1, system_id=1)
        stranger.synchronise(link)
        assert became_of_a_fix(link, clock)
    server.close()
