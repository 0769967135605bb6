"""A flight beside other programs on the only port of the flight controller: the routers themselves, configured as
docs/how-to/run-with-other-software.md says, with the ports and addresses of the test put in."""

import re
import shlex
import shutil
import signal
import subprocess
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path

import pytest
from flight_process import start
from flights import select
from ground_stations import start_mavproxy
from loopback import free_port, wait_until
from mavlink_peers import AutopilotThread, Peer, SerialCable, UdpPort

from edgevpr.mavlink.wire import mavlink
from edgevpr.runtime.flight.flightlog import read_log

pytestmark = [pytest.mark.process, pytest.mark.network]

PAGE = Path(__file__).parents[3] / "docs/how-to/run-with-other-software.md"
EDGEVPR = 197
needs_router = pytest.mark.skipif(
    shutil.which("mavlink-routerd") is None,
    reason="mavlink-routerd is not installed (github.com/mavlink-router/mavlink-router)",
)


def read_code_block(section: str, language: str) -> str:
    """The block of this language under a heading of the page."""
    text = PAGE.read_text().split(f"## {section}\n")[1].split("\n## ")[0]
    return re.search(rf"```{language}\n(.*?)```", text, re.DOTALL)[1]


@contextmanager
def mavlink_router(put, folder):
    settings = folder / "main.conf"
    settings.write_text("[General]\nTcpServerPort = 0\n\n" + put(read_code_block("mavlink-router owns it", "ini")))
    router = subprocess.Popen(["mavlink-routerd", "-c", settings], stderr=subprocess.DEVNULL)
    try:
        yield
    finally:
        router.kill()
        router.wait()


@contextmanager
def mavproxy(put, folder):
    _, *flags = shlex.split(put(read_code_block("MAVProxy owns it", "sh")))
    with start_mavproxy(folder, *flags):
        yield


@pytest.mark.parametrize(
    ("owner", "section", "is_shown"),  # is the flight shown to the ground station behind the same program
    [
        pytest.param(mavlink_router, "mavlink-router owns it", True, id="mavlink-router", marks=needs_router),
        pytest.param(mavproxy, "MAVProxy owns it", False, id="MAVProxy"),
    ],
)
def test_run_survives_a_router_killed_in_flight(recording, tmp_path, owner, section, is_shown):
    cable, log = SerialCable(tmp_path), tmp_path / "flight.jsonl"
    with ExitStack() as stack:
        station_port = stack.enter_context(closing(UdpPort()))
        replaced = {
            "/dev/ttyAMA0": str(cable.ends[1]),
            "192.168.1.10": "127.0.0.1",
            "14560": str(free_port()),
            "14550": str(station_port.number),
            "14540": str(free_port()),
        }

        def put(text):
            return re.sub("|".join(replaced), lambda found: replaced[found[0]], text)

        cable.plug()
        stack.callback(cable.unplug)
        pilot = AutopilotThread(f"serial:{cable.ends[0]}:921600")
        stack.callback(pilot.finish)  # before its cable is unplugged, whatever fails
        config = tmp_path / "config.yaml"
        config.write_text(put(read_code_block(section, "yaml")))
        images = recording / "blind" / "images"
        flight = start(recording / "cohog.gpkg", images, log, "--config", config, "--rate-hz", "1")
        stack.callback(flight.communicate)
        stack.callback(flight.send_signal, signal.SIGTERM)

        def count_accepted():
            assert flight.poll() is None, flight.communicate()[1]
            answers = select(read_log(log), "answer") if log.exists() else []
            return sum(line["result"] == "ACCEPTED" for line in answers)

        station = Peer(station_port, system_id=255)

        def receives(name, component_id, **fields):
            message = station.expect(name)
            return message.get_srcComponent() == component_id and fields.items() <= message.to_dict().items()

        def is_answered():
            station.send(mavlink.MAVLink_param_request_read_message(1, 1, b"EK3_ENABLE", -1), component_id=190)
            return receives("PARAM_VALUE", 1, param_id="EK3_ENABLE")

        with owner(put, tmp_path):  # after the flight
            wait_until(count_accepted, "a fix was taken")
            for name in ("HEARTBEAT", "STATUSTEXT", "NAMED_VALUE_FLOAT") if is_shown else ():
                wait_until(lambda name=name: receives(name, EDGEVPR), f"{name} of the flight")
            wait_until(lambda: receives("HEARTBEAT", 1), "HEARTBEAT of the autopilot")
            wait_until(is_answered, "the autopilot's answer")
        before = count_accepted()
        with owner(put, tmp_path):
            wait_until(lambda: count_accepted() > before, "a fix was taken again")
        flight.send_signal(signal.SIGTERM)
        assert flight.wait(timeout=60) == 0
        seen = pilot.finish()
    assert seen.companion == f"1/{EDGEVPR}"
    assert (seen.fixes_denied, seen.fixes_failed) == (0, 0)
