"""Real ground stations, MAVSDK and MAVProxy, see the companion: its component, its health, its events. So does
the example with MAVSDK."""

import json
import signal
from contextlib import ExitStack, contextmanager

import pytest
from flight_process import start
from ground_stations import Router, mavproxy, mavsdk, mavsdk_example
from mavlink_peers import AutopilotThread, free_port

pytestmark = pytest.mark.process

ACTIVE, CRITICAL = 4, 5  # MAV_STATE


@pytest.fixture
def seen_by(recording, tmp_path):
    """A flight whose messages a ground station sees, forwarded by the autopilot; gives the station."""

    @contextmanager
    def opened(open_station, *flags, source=recording / "blind" / "images"):
        ground, autopilot = free_port(), free_port()
        with ExitStack() as stack:
            station = stack.enter_context(open_station(ground, tmp_path))
            pilot = AutopilotThread(f"udpin:127.0.0.1:{autopilot}")
            stack.callback(pilot.finish)
            router = stack.enter_context(Router(autopilot, ground))
            if open_station is mavsdk:
                station.wait_for('"autopilot": 1')
            elif open_station is mavsdk_example:
                station.wait_for("the place is not known")
            else:  # shows what one component says, at first the autopilot
                station.wait_for("Detected vehicle 1:1 ")
                station.ask("vehicle 1:197")
            link = f"udpout:127.0.0.1:{router.companion_port}"
            flight = start(recording / "cohog.gpkg", source, tmp_path / "log", "--link", link, *flags)
            stack.callback(flight.communicate)
            stack.callback(flight.send_signal, signal.SIGTERM)
            yield station

    return opened


def test_mavsdk_sees_component_health_events_and_figures(seen_by):
    with seen_by(mavsdk, "--dry-run", "--rate-hz", "2") as station:
        station.wait_for('"components"', "197", ask="components")
        station.wait_for('"text": "edgevpr: dry run: no fix is sent"')
        beat = json.loads(station.wait_for('"HEARTBEAT"', '"component": 197', f'"system_status": {ACTIVE}'))
        assert (beat["type"], beat["autopilot"]) == (18, 8), "an onboard computer, and no autopilot"
        for name in ("vpr_place", "vpr_score", "vpr_cpu", "vpr_mah"):
            value = json.loads(station.wait_for('"component": 197', f'"{name}"'))["value"]
            assert value >= 0


def test_mavproxy_sees_component_health_events_and_figures(seen_by):
    with seen_by(mavproxy, "--dry-run", "--rate-hz", "2") as station:
        station.wait_for("Detected vehicle 1:197 ")
        station.wait_for("edgevpr: dry run: no fix is sent")
        station.wait_for("HEARTBEAT {type : 18, autopilot : 8", f"system_status : {ACTIVE}", ask="status HEARTBEAT")
        station.wait_for("NAMED_VALUE_FLOAT {", "name : vpr_mah", ask="status NAMED_VALUE_FLOAT")
        station.wait_for("NAMED_VALUE_INT {", "name : vpr_place", ask="status NAMED_VALUE_INT")
        station.wait_for("MAV Errors: 0", ask="status")


def test_mavsdk_example_reports_whether_the_place_is_known(seen_by, recording):
    with seen_by(mavsdk_example, "--rate-hz", "4", source=recording / "blind" / "images") as station:
        station.wait_for("the place is known")
        station.wait_for("text edgevpr: started")
        assert station.wait_for_end() == 0
    assert "the place is not known" in station.said[-1]
