"""Links that are held up, cut or pulled out: no fix leaves a buffer late, and a device that comes back is opened."""

import os
import pty
import socket
import termios
import time
import tty
from contextlib import closing
from functools import partial
from types import SimpleNamespace

import pytest
import serial
from loopback import free_port, wait_until
from mavlink_peers import AutopilotThread, Peer, SerialCable, TcpServer, make_link

from edgevpr.core.reasons import Reason, ReasonCode
from edgevpr.mavlink.address import parse_link
from edgevpr.mavlink.fixes import FixTransmission
from edgevpr.mavlink.messages import Fix, Severity, make_status_text
from edgevpr.mavlink.ports import PacketWriter, open_port
from edgevpr.mavlink.wire import mavlink

pytestmark = [pytest.mark.network, pytest.mark.slow]

DROPPED = Reason(ReasonCode.LINK_LOST)


@pytest.fixture
def narrow_server():
    """A TCP server that takes few bytes unless it reads."""
    server = TcpServer(free_port())
    server._listener.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2048)
    with closing(server):
        yield server


@pytest.fixture
def line(narrow_server, clock):
    """A line over TCP, and the other end of it."""
    port = narrow_server._listener.getsockname()[1]
    line = PacketWriter(open_port(parse_link(f"tcp:127.0.0.1:{port}")), clock)
    yield line, narrow_server.accept()
    line.port.close()


def fill_system_buffer(line) -> None:
    """Write until the system holds bytes that the other end does not take."""
    while line.port.unsent() < 2000:
        line.put(bytes(100), None)
        line.write()
        assert not line.unsent


def drain(port: socket.socket) -> bytes:
    got = b""
    try:
        while data := port.recv(65_536):
            got += data
    except ConnectionResetError:
        pass
    return got


def test_tcp_link_closes_with_an_outdated_fix_in_the_system_buffer(line, clock):
    line, far = line
    fill_system_buffer(line)
    fix = FixTransmission(Fix(50.0, 8.0, 20.0, clock.now_s), clock.now_s + 1.0)
    line.put(b"the fix", fix)
    line.write()
    assert not line.unsent
    clock.now_s += 0.99
    assert line.take_sent_fixes() == []
    clock.now_s += 0.02
    with pytest.raises(ConnectionError, match="too long"):
        line.take_sent_fixes()
    assert line.close() == 1
    assert (fix.sent, fix.why) == (False, DROPPED)
    got = drain(far)
    assert got
    assert b"the fix" not in got, "closing throws away what cannot leave"


def test_serial_link_drops_outdated_fixes_after_a_stall():
    master, slave = pty.openpty()
    tty.setraw(slave)
    peer = Peer(SimpleNamespace(recv=partial(os.read, master), send=partial(os.write, master)), 7)
    with make_link(f"serial:{os.ttyname(slave)}:57600", max_fix_age_s=0.2) as link:
        peer.heartbeat()
        peer.synchronise(link)
        termios.tcflow(slave, termios.TCOOFF)
        fix = link.send_fix(Fix(50.0, 8.0, 20.0, time.monotonic()))
        wait_until(lambda: fix.sent is not None, "giving up the fix")
        assert (fix.sent, fix.why) == (False, DROPPED)
        termios.tcflow(slave, termios.TCOON)
        peer.seen.clear()
        link.send(make_status_text(Severity.INFO, "goes on"))
        before = [message.get_type() for message in peer.expect_text("goes on")]
        assert mavlink.MAVLink_command_int_message.msgname not in before
        assert link.stats().fixes_sent == 0
    os.close(master)
    os.close(slave)


BEAT = mavlink.MAVLink_heartbeat_message(2, mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA, 1, 0, 4, 3)


def count_losses(caplog) -> int:
    told = [record.getMessage() for record in caplog.records if record.name == "edgevpr.mavlink.driver"]
    return sum("the device was disconnected" in message for message in told)


def test_serial_link_reopens_a_replugged_cable(tmp_path, caplog):
    cable = SerialCable(tmp_path)
    here, there = (f"serial:{end}:57600" for end in cable.ends)
    with make_link(here) as link:
        assert link.stats().trouble  # absent at the start: no error
        for times in (1, 2):
            cable.plug()
            autopilot = AutopilotThread(there)
            wait_until(lambda: link.stats().autopilot_heard and link.stats().trouble is None, "hearing the autopilot")
            beats = link.stats().sent["HEARTBEAT"]
            wait_until(lambda beats=beats: link.stats().sent["HEARTBEAT"] > beats, "a heartbeat as its companion")
            link.send_fix(Fix(50.0, 14.0, 25.0, time.monotonic()))
            wait_until(lambda times=times: link.stats().acks == {"ACCEPTED": times}, "the answer to the fix")
            cable.unplug()
            wait_until(lambda times=times: count_losses(caplog) == times, "noticing the loss")
            summary = autopilot.join()  # a cut line ends it
            assert (summary.companion, summary.fixes_accepted) == ("1/197", 1)
            assert (summary.bad_bytes, summary.lost_packets) == (0, 0)
        assert link.stats().bad_bytes == 0


def test_serial_link_opens_later_if_another_program_probes_the_device(tmp_path):
    """A modem manager opens what is plugged in: at the start that is said, in flight it is waited for."""
    device = tmp_path / "ttyACM0"
    with make_link(f"serial:{device}:57600") as link:
        assert link.stats().trouble
        master, slave = pty.openpty()
        tty.setraw(slave)
        with serial.Serial(os.ttyname(slave), exclusive=True):
            device.symlink_to(os.ttyname(slave))
            wait_until(lambda: "in use by another program" in link.stats().trouble, "finding it in use")
        wait_until(lambda: link.stats().connected, "opening it")
        os.write(master, BEAT.pack(mavlink.MAVLink(None, 7, 1)))
        wait_until(link.is_alive, "hearing the autopilot")
        assert link.stats().trouble is None
    os.close(master)
    os.close(slave)
