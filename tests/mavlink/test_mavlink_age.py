"""No fix leaves a buffer late, be it the link's, the system's or the serial driver's."""

import os
import pty
import socket
import termios
import time
import tty
from contextlib import closing

import pytest
from mavlink_peers import Peer, TcpServer, UdpPort, free_port, link_to, wait_until

from edgevpr.mavlink.address import parse_link
from edgevpr.mavlink.fixes import Sending
from edgevpr.mavlink.messages import Fix, Severity, status_text
from edgevpr.mavlink.ports import Line, open_port
from edgevpr.mavlink.wire import mavlink

pytestmark = [pytest.mark.network, pytest.mark.slow]

THROWN_AWAY = "the link was lost before it had left"


@pytest.fixture
def narrow_server():
    """A TCP server that takes few bytes unless it reads."""
    server = TcpServer(free_port(socket.SOCK_STREAM))
    server._listener.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2048)
    with closing(server):
        yield server


@pytest.fixture
def line(narrow_server, clock):
    """A line over TCP, and the other end of it."""
    port = narrow_server._listener.getsockname()[1]
    line = Line(open_port(parse_link(f"tcp:127.0.0.1:{port}")), clock)
    yield line, narrow_server.accept()
    line.port.close()


def sending(clock):
    return Sending(Fix(50.0, 8.0, 20.0, clock.now_s), clock.now_s + 1.0)


def hold_up(line) -> None:
    """Write until the system holds bytes that the other end does not take."""
    while line.port.unsent() < 2000:
        line.put(bytes(100), None)
        line.write()
        assert not line.unsent


def drained(port: socket.socket) -> bytes:
    got = b""
    try:
        while data := port.recv(65_536):
            got += data
    except ConnectionResetError:
        pass
    return got


def test_over_tcp_a_fix_has_left_when_the_other_end_has_it(line, clock):
    line, far = line
    fix = sending(clock)
    line.put(b"the fix", fix)
    line.write()
    wait_until(lambda: line.departed() == [fix], "the confirmation")
    assert fix.sent
    assert far.recv(100) == b"the fix"


def test_a_fix_that_the_system_still_holds_when_it_is_due_is_thrown_away_with_the_connection(line, clock):
    line, far = line
    hold_up(line)
    fix = sending(clock)
    line.put(b"the fix", fix)
    line.write()
    assert not line.unsent
    clock.now_s += 0.99
    assert line.departed() == []
    clock.now_s += 0.02
    with pytest.raises(ConnectionError, match="too long"):
        line.departed()
    assert line.close() == 1
    assert (fix.sent, fix.why) == (False, THROWN_AWAY)
    got = drained(far)
    assert got
    assert b"the fix" not in got, "closing throws away what cannot leave"


def test_a_tcp_peer_that_reads_late_finds_no_fix_that_was_called_unsent(narrow_server):
    number = narrow_server._listener.getsockname()[1]
    with link_to(f"tcp:127.0.0.1:{number}", max_fix_age_s=0.2) as link:
        far = narrow_server.accept()
        peer = Peer(far, 7)
        peer.heartbeat()
        peer.synchronise(link)
        # So much text that the fixes behind it cannot leave.
        wait_until(lambda: (link.send(*[status_text(Severity.INFO, "x" * 50)] * 9), _held(link))[1], "filling the line")
        fixes = []
        while link.stats().trouble is None:
            fixes.append(link.send_fix(Fix(10.0 + len(fixes), 8.0, 20.0, time.monotonic())))
            time.sleep(0.01)
        assert link.stats().trouble in ("a position fix has waited too long in it", "the port takes no more bytes")
        for each in fixes:
            each.wait(60)
        found = set()
        for message in peer.receiver.feed(drained(far)):
            if message.get_type() == "COMMAND_INT":
                found.add(message.x / 1e7)
        assert found <= {each.fix.lat_deg for each in fixes if each.sent}
        assert not all(each.sent for each in fixes)
        assert link.stats().fixes_sent == sum(each.sent for each in fixes)
        unanswered = link._conversation.fixes._row
        assert unanswered == link.stats().fixes_sent, "what was thrown away waits for no answer"


def _held(link) -> bool:
    line = link._line
    return line is None or line.port.unsent() > 4000


@pytest.mark.parametrize(("max_age_s", "leaves"), [(0.3, False), (0.6, True)])
def test_the_longest_wait_is_the_configurations(clock, max_age_s, leaves):
    with (
        closing(UdpPort()) as port,
        link_to(f"udpout:127.0.0.1:{port.number}", clock=clock, max_fix_age_s=max_age_s) as link,
    ):
        peer = Peer(port)
        peer.expect("HEARTBEAT")
        fix = link.send_fix(Fix(50.0, 8.0, 20.0, clock.now_s))
        clock.now_s += 0.5
        peer.heartbeat()
        peer.synchronise(link)
        wait_until(lambda: fix.sent is not None)
        assert fix.sent is leaves
        if not leaves:
            assert "0.3 s" in fix.why


def test_a_serial_line_that_is_held_up_gives_no_old_fix_when_it_goes_on():
    master, slave = pty.openpty()
    tty.setraw(slave)
    peer = Peer(_Terminal(master), 7)
    with link_to(f"serial:{os.ttyname(slave)}:57600", max_fix_age_s=0.2) as link:
        peer.heartbeat()
        peer.synchronise(link)
        termios.tcflow(slave, termios.TCOOFF)
        fix = link.send_fix(Fix(50.0, 8.0, 20.0, time.monotonic()))
        wait_until(lambda: fix.sent is not None, "giving up the fix")
        assert (fix.sent, fix.why) == (False, THROWN_AWAY)
        termios.tcflow(slave, termios.TCOON)
        peer.seen.clear()
        link.send(status_text(Severity.INFO, "goes on"))
        before = [message.get_type() for message in peer.expect_text("goes on")]
        assert mavlink.MAVLink_command_int_message.msgname not in before
        assert link.stats().fixes_sent == 0
    os.close(master)
    os.close(slave)


class _Terminal:
    """A terminal with a socket's names."""

    def __init__(self, number: int) -> None:
        self._number = number

    def recv(self, size: int) -> bytes:
        return os.read(self._number, size)

    def send(self, data: bytes) -> int:
        return os.write(self._number, data)
