"""The example with MAVSDK, a real ground station, beside a flight whose autopilot is behind MAVProxy."""

import signal
from contextlib import ExitStack

import pytest
from flight_process import start
from ground_stations import mavproxy_with, mavsdk_example
from loopback import free_port
from mavlink_peers import AutopilotThread

pytestmark = pytest.mark.process


def test_the_example_with_mavsdk_says_whether_the_place_is_known(recording, tmp_path):
    ground, autopilot, companion = free_port(), free_port(), free_port()
    outputs = f"--out=127.0.0.1:{ground}", f"--out=udpin:127.0.0.1:{companion}"
    config = tmp_path / "config.yaml"
    config.write_text(f"mavlink: {{ground: 'udpout:127.0.0.1:{ground}'}}")
    with ExitStack() as stack:
        station = stack.enter_context(mavsdk_example(ground, tmp_path))
        pilot = AutopilotThread(f"udpin:127.0.0.1:{autopilot}")
        stack.callback(pilot.finish)
        stack.enter_context(mavproxy_with(tmp_path, f"--master=udpout:127.0.0.1:{autopilot}", *outputs, "--daemon"))
        station.wait_for("the place is not known")
        flags = "--link", f"udpout:127.0.0.1:{companion}", "--config", config, "--rate-hz", "4"
        flight = start(recording / "cohog.gpkg", recording / "blind" / "images", tmp_path / "log", *flags)
        stack.callback(flight.communicate)
        stack.callback(flight.send_signal, signal.SIGTERM)
        station.wait_for("the place is known")
        station.wait_for("text edgevpr: started")
        assert station.wait_for_end() == 0
    assert "the place is not known" in station.said[-1]
