"""A serial link over a cable of pseudo terminals, pulled out and put back."""

import os
import pty
import select
import threading
import time

import pytest
from fakes import FakeClock
from mavlink_peers import AutopilotThread, SerialCable, link_to, wait_until

from edgevpr.core.errors import LinkError
from edgevpr.mavlink.messages import Fix, Severity, status_text
from edgevpr.mavlink.wire import PacketReader

pytestmark = [pytest.mark.network, pytest.mark.slow]


@pytest.fixture
def line():
    """The other end of a serial device, which nobody reads unless the test does, and the device."""
    master, slave = pty.openpty()
    yield master, os.ttyname(slave)
    os.close(master)
    os.close(slave)


@pytest.fixture
def terminal(line):
    return line[1]


def losses_told(caplog) -> int:
    told = [record.getMessage() for record in caplog.records if record.name == "edgevpr.mavlink.link"]
    return sum("the device is gone" in message for message in told)


def test_an_unplugged_cable_is_found_again_when_it_is_plugged_in(tmp_path, caplog):
    cable = SerialCable(tmp_path)
    here, there = (f"serial:{end}:57600" for end in cable.ends)
    with link_to(here) as link:
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
            wait_until(lambda times=times: losses_told(caplog) == times, "noticing the loss")
            summary = autopilot.join()  # a cut line ends it
            assert (summary.companion, summary.fixes_accepted) == ("1/197", 1)
            assert (summary.bad_bytes, summary.lost_packets) == (0, 0)
        assert link.stats().reopened == 2
        assert link.stats().bad_bytes == 0


def test_closing_sends_what_waits(line):
    master, terminal = line
    link = link_to(f"serial:{terminal}:57600", clock=FakeClock())
    link.start()

    def full() -> bool:
        link.send(status_text(Severity.INFO, "x" * 50))
        return link.stats().dropped_queue_full > 0

    wait_until(full, "filling the line and the queue, which never blocks")
    link.send(status_text(Severity.INFO, "last"))
    texts, receiver = [], PacketReader()

    def read() -> None:
        while "last" not in texts and select.select([master], [], [], 1)[0]:
            texts.extend(m.text for m in receiver.feed(os.read(master, 65_536)) if m.get_type() == "STATUSTEXT")

    reader = threading.Timer(0.02, read)
    reader.start()
    link.close()
    reader.join()
    assert texts[-1] == "last"
    assert receiver.bad_bytes == 0


def test_a_device_that_this_user_may_not_open_is_said_at_the_start(terminal):
    os.chmod(terminal, 0)
    user = os.geteuid()
    if user == 0:
        os.seteuid(65_534)  # root may open everything
    try:
        with pytest.raises(LinkError, match="dialout"):
            link_to(f"serial:{terminal}:57600").start()
    finally:
        os.seteuid(user)
