"""`edgevpr run --tlog`: the packets of a flight, whatever ends it."""

import signal
import subprocess
import sys
from contextlib import closing
from pathlib import Path

import pytest
from flight_process import start
from loopback import wait_until
from mavlink_peers import Peer, UdpPort

from edgevpr.mavlink.wire import mavlink

pytestmark = pytest.mark.process

MAVLOGDUMP = Path(sys.prefix) / "bin" / "mavlogdump.py"


@pytest.fixture
def fly(recording, tmp_path):
    def started(*flags, **environment):
        place_map, pictures = recording / "cohog.gpkg", recording / "blind" / "images"
        return start(place_map, pictures, tmp_path / "log", "--rate-hz", "60", *flags, **environment)

    return started


def dumped(path: Path) -> str:
    command = [sys.executable, MAVLOGDUMP, "--show-source", path]
    return subprocess.run(command, check=True, capture_output=True, text=True, timeout=60).stdout


def test_tlog_of_a_killed_flight_can_be_read(fly, tmp_path):
    path = tmp_path / "flight.tlog"
    with closing(UdpPort()) as port:
        heartbeat = mavlink.MAVLink_heartbeat_message(2, mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA, 1, 0, 4, 3)
        heard = bytes(heartbeat.pack(mavlink.MAVLink(None, 1, 1)))
        flight = fly("--link", f"udpout:127.0.0.1:{port.number}", "--tlog", path, "--rate-hz", "2")
        Peer(port).expect("HEARTBEAT")
        port.send(heard)
        wait_until(lambda: heard in (written := path.read_bytes()) and b"vpr_mah" in written)
        flight.send_signal(signal.SIGKILL)
        flight.communicate()
    said = dumped(path)
    assert "HEARTBEAT {type : 2" in said, "heard"
    assert "vpr_mah" in said, "sent"
    assert "BAD_DATA" not in said
