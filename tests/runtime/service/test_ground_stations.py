"""The example with MAVSDK, a real ground station, beside a flight behind a router."""

import signal
import threading
from contextlib import ExitStack, suppress

import pytest
from flight_process import start
from ground_stations import start_mavsdk_example
from loopback import free_port
from mavlink_peers import AutopilotThread, UdpPort

pytestmark = pytest.mark.process


def route(stack: ExitStack, station: int) -> tuple[int, int]:
    """Pass packets between two ends, with a copy of each to the station; return the ports to which the ends send."""
    ends = UdpPort(), UdpPort()
    copy = UdpPort(to=station)
    for end in (*ends, copy):
        stack.callback(end.close)

    def forward_packets(source: UdpPort, target: UdpPort) -> None:
        with suppress(OSError):  # closed at the end
            while data := source.recv(65_536):
                copy.send(data)
                if target.to:
                    target.send(data)

    for pair in (ends, ends[::-1]):
        threading.Thread(target=forward_packets, args=pair, daemon=True).start()
    return ends[0].number, ends[1].number


def test_mavsdk_example_reports_whether_the_place_is_recognised(recording, tmp_path):
    ground = free_port()
    with ExitStack() as stack:
        station = stack.enter_context(start_mavsdk_example(ground, tmp_path))
        autopilot, companion = route(stack, ground)
        pilot = AutopilotThread(f"udpout:127.0.0.1:{autopilot}")
        stack.callback(pilot.finish)
        station.wait_for("the place is not known")
        flags = "--link", f"udpout:127.0.0.1:{companion}", "--rate-hz", "4"
        flight = start(recording / "cohog.gpkg", recording / "blind" / "images", tmp_path / "log", *flags)
        stack.callback(flight.communicate)
        stack.callback(flight.send_signal, signal.SIGTERM)
        station.wait_for("the place is known")
        station.wait_for("text edgevpr: started")
        assert station.wait_for_end() == 0
    assert "not known" in station.said[-1]
