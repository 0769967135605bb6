"""A flight over a map, by the real recogniser, loop and log, for the tests of what is made of it afterwards."""

import csv
from dataclasses import replace

import cv2
import pytest
from browser import driven
from fakes import FakeClock, FakeLink, FakeSource, receiver_at, to_autopilot
from pictures import textured

from edgevpr.cli.main import main
from edgevpr.core.config import load_config
from edgevpr.core.types import Frame, Vehicle
from edgevpr.power.boards import load_board
from edgevpr.runtime.flight.aboard import start_fields
from edgevpr.runtime.flight.flight import Flight
from edgevpr.runtime.flight.flightlog import FlightLog
from edgevpr.runtime.flight.herald import Herald
from edgevpr.runtime.flight.metering import FlightMeter
from edgevpr.runtime.flight.navigator import Navigator
from edgevpr.runtime.flight.world import Crew, Stop
from edgevpr.runtime.recognise.opening import open_recogniser

PLACES, SEEN = 8, 10  # the last pictures are of nothing in the map
STEP_DEG = 0.001  # of latitude: 111 m


@pytest.fixture(scope="session")
def flown(tmp_path_factory):
    """A folder with a flight.jsonl, its map.gpkg, the pictures of the map (`ref`) and of the flight (`seen`), which
    have the same names. The GPS of the aircraft is 90 m beside the map's positions."""
    folder = tmp_path_factory.mktemp("flown")
    pictures = {f"{number:02d}.png": textured(number, 240, 320) for number in range(SEEN)}
    (folder / "ref").mkdir()
    (folder / "seen").mkdir()
    with open(folder / "positions.csv", "w", newline="") as handle:
        table = csv.writer(handle)
        table.writerow(("file", "lat", "lon"))
        for number, (name, picture) in enumerate(pictures.items()):
            cv2.imwrite(str(folder / "seen" / name), 255 - picture)
            if number < PLACES:
                cv2.imwrite(str(folder / "ref" / name), picture)
                table.writerow((name, f"{50 + number * STEP_DEG:.4f}", 8.0))
    build = ["map", "build", folder / "map.gpkg", "--images", folder / "ref", "--positions", folder / "positions.csv"]
    assert main([*map(str, build), "--technique", "cohog", "--param", "w1=208", "--no-calibrate"]) == 0

    clock = FakeClock()
    aircraft = Vehicle(lat_deg=50.0, lon_deg=8.0, alt_m=100.0, heading_deg=0.0, t_heard_s=0.0, has_gps=False)

    def vehicle() -> Vehicle:
        lat_deg = 50 + STEP_DEG * (clock() - 1000)
        receiver = receiver_at((lat_deg, 8.00126), 1.0, clock())
        return replace(aircraft, lat_deg=lat_deg, t_heard_s=clock(), gps=receiver)

    place_map = folder / "map.gpkg"
    config = load_config(None, {"map": str(place_map), "source.uri": "/dev/video0", "source.rate_hz": 1.0})
    board, recogniser = load_board(config.board), open_recogniser(config, load_board(config.board), narrowed=True)
    link = FakeLink(clock, vehicle=vehicle)
    link.listener = Navigator(config.mavlink.min_accuracy_m, 1.0)
    source = FakeSource([Frame(image=each, name=name, t_mono_s=0.0) for name, each in pictures.items()], clock)
    with recogniser.place_map, FlightLog(folder / "flight.jsonl", clock=clock) as log:
        start = start_fields(config, board.name, recogniser.technique.spec, recogniser.place_map)
        log.write("start", **start, decided={"rule": recogniser.rule})
        crew = Crew(
            recogniser=recogniser,
            source=source,
            link=link,
            autopilot=to_autopilot(link, link.listener, clock, log),
            flight_log=log,
            herald=Herald(log, link),
            meter=FlightMeter(config.battery, board, clock.clock),
            clock=clock.clock,
            stop=Stop(),
        )
        Flight(config, crew).run()
    return folder


@pytest.fixture(scope="session")
def browser():
    """A real browser, started once."""
    with driven() as started:
        yield started
