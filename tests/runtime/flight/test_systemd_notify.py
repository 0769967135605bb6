"""sd_notify on real sockets: one in the file system, one in the abstract namespace."""

import os
import socket
from contextlib import suppress

import pytest

from edgevpr.runtime.flight.systemd import notify, watchdog_interval_s


@pytest.fixture
def manager(tmp_path, monkeypatch):
    """A bound datagram socket in the place of systemd's."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as receiver:
        receiver.settimeout(5)
        receiver.bind(str(tmp_path / "notify"))
        monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
        yield receiver


def test_notify_sends_all_assignments_in_one_datagram_to_an_abstract_socket(monkeypatch):
    name = f"edgevpr-test-{os.getpid()}"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as receiver:
        receiver.settimeout(5)
        receiver.bind("\0" + name)
        monkeypatch.setenv("NOTIFY_SOCKET", "@" + name)
        notify(READY=1, STATUS="240 places of cohog")
        assert receiver.recv(4096) == b"READY=1\nSTATUS=240 places of cohog"


@pytest.mark.parametrize(
    ("status", "sent"),
    [
        ("no camera\nSTOPPING=1\r\n", b"STATUS=no camera STOPPING=1"),
        ("rtsp://pilot:secret@cam \x1b[31m lost", b"STATUS=rtsp://pilot:***@cam \\x1b[31m lost"),
    ],
)
def test_notify_escapes_status_values(manager, status, sent):
    notify(STATUS=status)
    assert manager.recv(4096) == sent


@pytest.mark.parametrize("address", ["/nowhere/notify", "vsock:2:1234", "/" + "x" * 200, "@" + "x" * 200])
def test_notify_ignores_an_unreachable_address(monkeypatch, address):
    monkeypatch.setenv("NOTIFY_SOCKET", address)
    notify(WATCHDOG=1)


@pytest.mark.slow
def test_notify_never_blocks_on_a_manager_that_does_not_read(manager):
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as other:
        other.setblocking(False)
        with suppress(BlockingIOError):
            while True:
                other.sendto(b"x", manager.getsockname())
    notify(WATCHDOG=1)


@pytest.mark.parametrize(
    ("timeout_us", "pid_ahead", "interval_s"),
    [
        ("30000000", None, 15.0),
        ("30000000", 0, 15.0),
        ("30000000", 1, None),
        (None, None, None),
        ("soon", None, None),
        ("0", None, None),
        ("-5", None, None),
    ],
)
def test_watchdog_interval_s_is_half_the_timeout_of_this_process(monkeypatch, timeout_us, pid_ahead, interval_s):
    pid = None if pid_ahead is None else os.getpid() + pid_ahead
    for name, value in (("WATCHDOG_USEC", timeout_us), ("WATCHDOG_PID", pid)):
        monkeypatch.delenv(name, raising=False)
        if value is not None:
            monkeypatch.setenv(name, str(value))
    assert watchdog_interval_s() == interval_s
