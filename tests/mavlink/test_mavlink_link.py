"""One link, real sockets, and an autopilot worked by hand at the other end."""

import errno
import math
import os
import threading
from contextlib import closing

import pytest
from loopback import free_port, wait_until
from mavlink_peers import Peer, TcpServer, UdpPort, make_link

from edgevpr.mavlink.conversation import MAX_MESSAGES
from edgevpr.mavlink.link import Link
from edgevpr.mavlink.messages import Fix, Health, Severity, make_named_values, make_status_text
from edgevpr.mavlink.wire import mavlink

pytestmark = pytest.mark.network


def make_fix(t_frame_s: float, lat_deg: float = 50.0) -> Fix:
    return Fix(lat_deg, 14.0, 25.0, t_frame_s)


def connect_autopilot(link: Link, peer: Peer) -> None:
    peer.heartbeat()
    wait_until(lambda: link.stats().autopilot_heard, "hearing the autopilot")


def make_text(words: str):
    return make_status_text(Severity.INFO, words)


def test_link_sends_a_heartbeat_with_the_current_health_each_second(link, peer, clock):
    link.set_health(Health.ACTIVE)
    clock.now_s += 0.9
    link.send(make_text("not yet"))
    assert peer.expect_text("not yet") == []
    clock.now_s += 0.2
    assert peer.expect("HEARTBEAT").system_status == mavlink.MAV_STATE_ACTIVE
    clock.now_s += 0.8  # 1.9: the beat keeps its step
    link.send(make_text("nor now"))
    assert peer.expect_text("nor now") == []
    clock.now_s += 0.1
    peer.expect("HEARTBEAT")
    clock.now_s += 8.1  # the main loop has fallen silent
    assert peer.expect("HEARTBEAT").system_status == mavlink.MAV_STATE_CRITICAL
    link.set_health(Health.ACTIVE)
    clock.now_s += 1.0
    assert peer.expect("HEARTBEAT").system_status == mavlink.MAV_STATE_ACTIVE


def test_link_uses_and_addresses_the_autopilots_system_id(link, peer, clock):
    link.send(make_text("before"))
    assert peer.expect("STATUSTEXT").get_srcSystem() == 1
    connect_autopilot(link, peer)
    link.send_fix(make_fix(clock.now_s - 0.5, 50.1234567))
    fix = peer.expect("COMMAND_INT")
    assert (fix.get_srcSystem(), fix.get_srcComponent()) == (7, 197)
    assert (fix.target_system, fix.target_component) == (7, 1)
    assert (fix.x, math.isnan(fix.z)) == (501234567, True)
    assert (fix.param1, fix.param2) == (pytest.approx(clock.now_s), 0.5)


def test_link_never_sends_an_outdated_fix_or_one_to_a_silent_autopilot(link, peer, clock):
    connect_autopilot(link, peer)
    link.send_fix(make_fix(clock.now_s - 5.1, 1.0))
    link.send_fix(make_fix(clock.now_s - 4.9, 2.0))
    assert peer.expect("COMMAND_INT").x == 20_000_000
    assert link.stats().dropped_stale_fixes == 1
    clock.now_s += 5.1
    link.send_fix(make_fix(clock.now_s))  # the autopilot has fallen silent
    link.send(make_text("end"))
    assert "COMMAND_INT" not in [m.get_type() for m in peer.expect_text("end")]
    assert not link.stats().autopilot_heard


def test_link_drops_only_a_message_whose_value_does_not_fit(link, peer, clock, caplog):
    link.send(*make_named_values(clock.now_s, vpr_place=2**40, vpr_score=0.5), make_text("next"))
    assert [m.name for m in peer.expect_text("next")] == ["vpr_score"]
    assert "NAMED_VALUE_INT" in caplog.text


def test_udpout_link_accepts_only_its_peer(clock):
    with (
        closing(UdpPort()) as port,
        closing(UdpPort()) as stranger,
        make_link(f"udpout:127.0.0.1:{port.number}", clock=clock) as link,
    ):
        peer = Peer(port)
        peer.expect("HEARTBEAT")
        stranger.to = port.to
        Peer(stranger, 7).heartbeat()
        stranger.send(b"hello")
        connect_autopilot(link, peer)
        stats = link.stats()
        assert (stats.received, stats.bad_bytes, stats.foreign_messages) == ({"HEARTBEAT": 1}, 0, 0)


def test_tcp_link_reconnects_to_a_restarted_server_without_old_fixes(clock):
    number = free_port()
    server = TcpServer(number)
    with make_link(f"tcp:127.0.0.1:{number}", clock=clock) as link:
        peer = Peer(server.accept())
        peer.expect("HEARTBEAT")
        connect_autopilot(link, peer)
        peer.synchronise(link)
        peer.port.send(b"\xfd\xff\x00")  # dies in the middle of a message
        server.close()
        wait_until(lambda: not link.stats().connected, "noticing the loss")
        assert "closed" in link.stats().trouble
        link.send_fix(make_fix(clock.now_s, 1.0))
        clock.now_s += 0.8
        link.send_fix(make_fix(clock.now_s, 2.0))
        clock.now_s += 0.8
        server = TcpServer(number)
        peer = Peer(server.accept())
        peer.heartbeat()
        assert peer.expect("COMMAND_INT").x == 20_000_000  # the one of 1.6 s ago is gone, that of 0.8 s is not
        assert peer.receiver.bad_bytes == 0
        wait_until(lambda: link.stats().received["HEARTBEAT"] == 2, "a message after the one that was cut")
        assert link.stats().trouble is None
        assert (link.stats().dropped_stale_fixes, link.stats().bad_bytes) == (1, 0)
    server.close()


def test_tcp_link_waits_for_an_absent_server_with_the_newest_messages(clock):
    number = free_port()
    with make_link(f"tcp:127.0.0.1:{number}", clock=clock) as link:
        assert not link.stats().connected
        assert link.stats().trouble == "Connection refused"
        for count in range(MAX_MESSAGES + 36):
            link.send(make_text(f"{count}"))
        server = TcpServer(number)
        peer = Peer(server.accept())
        texts = [m.text for m in peer.expect_text(f"{MAX_MESSAGES + 35}") if m.get_type() == "STATUSTEXT"]
        assert texts == [f"{count}" for count in range(36, MAX_MESSAGES + 35)]
    server.close()


def test_tcp_link_is_never_blocked_by_a_peer_that_does_not_read(clock):
    number = free_port()
    server = TcpServer(number)
    with make_link(f"tcp:127.0.0.1:{number}", clock=clock) as link:
        server.accept()

        def is_stuck() -> bool:
            link.send(*[make_text("x" * 50)] * MAX_MESSAGES)
            clock.now_s += 0.01
            return link.stats().trouble is not None

        wait_until(is_stuck, "filling the line")
        trouble = link.stats().trouble
        assert trouble == os.strerror(errno.ETIMEDOUT) or "more bytes" in trouble
        peer = Peer(server.accept())
        peer.expect("STATUSTEXT")
        assert peer.receiver.bad_bytes == 0  # the rest of a message cut in two went with the old connection
    server.close()


def test_link_sends_nothing_once_closed_and_can_be_closed_twice(port, clock):
    link = make_link(f"udpout:127.0.0.1:{port.number}", clock=clock)
    link.start()
    link.send(make_text("last"))
    link.close()
    assert len(Peer(port).expect_text("last")) == 1  # the heartbeat
    link.send(make_text("late"))
    link.close()
    assert not link.stats().connected
    make_link("udpout:127.0.0.1:14550").close()  # never started


def test_link_waits_for_the_last_answer_while_closing(link, peer, clock):
    connect_autopilot(link, peer)
    peer.synchronise(link)
    link.send_fix(make_fix(clock()))
    closing_link = threading.Thread(target=link.close)
    closing_link.start()
    peer.expect("COMMAND_INT")
    closing_link.join(0.1)
    assert closing_link.is_alive()
    peer.answer_fix(mavlink.MAV_RESULT_ACCEPTED)
    closing_link.join()
    assert link.stats().acks == {"ACCEPTED": 1}
