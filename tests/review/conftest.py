"""A flight over a map, by the real recogniser, loop and log, for the tests of what is made of it afterwards."""

import pytest
from browser import launch_browser
from commands import run
from fakes import FakeClock, FakeLink, FakeSource, make_receiver, make_vehicle
from flights import Flight
from pictures import draw_texture, write_flight

from edgevpr.core.types import Frame
from edgevpr.runtime.flight.startup import start_fields

PLACES = 8  # the last pictures are of nothing in the map
QUERY_COUNT = 10
STEP_DEG = 0.001  # of latitude: 111 m


@pytest.fixture(scope="session")
def flight_folder(tmp_path_factory):
    """A folder with a flight.jsonl, its map.gpkg, the pictures of the map (`ref`) and of the flight (`seen`), which
    have the same names. The GPS of the aircraft is 90 m beside the map's positions."""
    folder = tmp_path_factory.mktemp("flown")
    pictures = {f"{number}.png": draw_texture(number, 240, 320) for number in range(QUERY_COUNT)}
    write_flight(folder / "ref", list(pictures.values())[:PLACES], STEP_DEG)
    write_flight(folder / "seen", [255 - picture for picture in pictures.values()])
    flags = ["--technique", "cohog", "--param", "w1=208", "--no-calibrate"]
    assert run("map", "build", folder / "map.gpkg", "--images", folder / "ref", *flags) == 0

    clock = FakeClock()

    def vehicle():
        lat_deg = 50 + STEP_DEG * (clock() - 1000)
        receiver = make_receiver((lat_deg, 8.00126), 1.0, clock())
        known = {"heading_deg": 0.0, "has_gps": False, "gps": receiver, "velocity_m_s": (0.0, 111.0)}
        return make_vehicle(lat_deg, 8.0, clock(), **known)

    link = FakeLink(clock, vehicle=vehicle)
    flight = Flight(folder / "map.gpkg", folder / "flight.jsonl", clock, link, **{"source.rate_hz": 1.0})
    recogniser = flight.recogniser
    start = start_fields(flight.config, flight.board.name, recogniser.technique.spec, recogniser.place_map)
    source = FakeSource([Frame(image=each, name=name, t_mono_s=0.0) for name, each in pictures.items()], clock)
    flight.fly(source, start={**start, "decided": {"rule": recogniser.rule}})
    return folder


@pytest.fixture(scope="session")
def browser():
    """A real browser, started once."""
    with launch_browser() as started:
        yield started
