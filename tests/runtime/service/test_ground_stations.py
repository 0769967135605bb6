"""The example with MAVSDK, a real ground station, beside a flight whose messages the autopilot forwards."""

import signal
from contextlib import ExitStack

import pytest
from flight_process import start
from ground_stations import Router, mavsdk_example
from loopback import free_port
from mavlink_peers import AutopilotThread

pytestmark = pytest.mark.process


def test_the_example_with_mavsdk_says_whether_the_place_is_known(recording, tmp_path):
    ground, autopilot = free_port(), free_port()
    with ExitStack() as stack:
        station = stack.enter_context(mavsdk_example(ground, tmp_path))
        pilot = AutopilotThread(f"udpin:127.0.0.1:{autopilot}")
        stack.callback(pilot.finish)
        router = stack.enter_context(Router(autopilot, ground))
        station.wait_for("the place is not known")
        link = f"udpout:127.0.0.1:{router.companion_port}"
        flags = "--link", link, "--rate-hz", "4"
        flight = start(recording / "cohog.gpkg", recording / "blind" / "images", tmp_path / "log", *flags)
        stack.callback(flight.communicate)
        stack.callback(flight.send_signal, signal.SIGTERM)
        station.wait_for("the place is known")
        station.wait_for("text edgevpr: started")
        assert station.wait_for_end() == 0
    assert "the place is not known" in station.said[-1]
