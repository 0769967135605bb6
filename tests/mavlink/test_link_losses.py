"""Losses as they happen with pymavlink's connections at the other end, or with other programs at the device."""

import os
import pty
import socket
import tty

import pytest
import serial
from mavlink_peers import free_port, link_to, wait_until

from edgevpr.mavlink.link import Link
from edgevpr.mavlink.wire import mavlink

pytestmark = [pytest.mark.network, pytest.mark.slow]

BEAT = mavlink.MAVLink_heartbeat_message(2, mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA, 1, 0, 4, 3)


@pytest.fixture
def mavutil(monkeypatch):
    monkeypatch.setenv("MAVLINK20", "1")
    from pymavlink import mavutil

    return mavutil


def beat_until_heard(other, link: Link, beats: int) -> None:
    """Let pymavlink's end beat until the link has heard it so often, and read a heartbeat of the link."""

    def heard() -> bool:
        other.recv_match(blocking=False)
        other.mav.heartbeat_send(2, mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA, 1, 0, 4)
        return link.stats().received.get("HEARTBEAT", 0) >= beats and link.stats().autopilot_heard

    wait_until(heard, "hearing pymavlink")


def test_a_tcp_server_of_pymavlink_closes_refuses_and_comes_back(mavutil):
    url = f"tcpin:127.0.0.1:{free_port(socket.SOCK_STREAM)}"
    other = mavutil.mavlink_connection(url, dialect="all", source_system=7, source_component=1)
    with link_to(url.replace("tcpin", "tcp")) as link:
        for times in (1, 2, 3):
            beat_until_heard(other, link, beats=link.stats().received.get("HEARTBEAT", 0) + 1)
            other.close()
            other.listen.close()
            wait_until(lambda: link.stats().trouble == "Connection refused", "being refused")
            assert not link.listens(), "no fix must leave for who answers next"
            other = mavutil.mavlink_connection(url, dialect="all", source_system=7, source_component=1)
            wait_until(lambda times=times: link.stats().reopened == times, "coming back")
    other.close()
    other.listen.close()


def test_a_device_that_another_program_probes_when_it_appears_is_opened_later(tmp_path):
    """A modem manager opens what is plugged in: at the start that is said, in flight it is waited for."""
    device = tmp_path / "ttyACM0"
    with link_to(f"serial:{device}:57600") as link:
        assert link.stats().trouble
        master, slave = pty.openpty()
        tty.setraw(slave)
        with serial.Serial(os.ttyname(slave), exclusive=True):
            device.symlink_to(os.ttyname(slave))
            wait_until(lambda: "in use by another program" in link.stats().trouble, "finding it in use")
        wait_until(lambda: link.stats().connected, "opening it")
        os.write(master, BEAT.pack(mavlink.MAVLink(None, 7, 1)))
        wait_until(link.listens, "hearing the autopilot")
        assert link.stats().trouble is None
    os.close(master)
    os.close(slave)
