"""The whole walk in under a second: pictures become a map, a frame is recognised, a fix is sent. The first gate."""

from fakes import FakeClock, FakeLink, FakeSource, to_autopilot
from pictures import textured

from edgevpr.core.config import load_config
from edgevpr.core.types import Frame, Position
from edgevpr.mapmaking.mapping import build_map
from edgevpr.places.index import load_index
from edgevpr.places.mapfile import PlaceMap
from edgevpr.power.boards import load_board
from edgevpr.runtime.flight.flight import Flight
from edgevpr.runtime.flight.flightlog import FlightLog, read_log
from edgevpr.runtime.flight.herald import Herald
from edgevpr.runtime.flight.metering import FlightMeter
from edgevpr.runtime.flight.navigator import Navigator
from edgevpr.runtime.flight.world import Crew, Stop
from edgevpr.runtime.recognise.judge import accept_rule
from edgevpr.runtime.recognise.opening import meter_of
from edgevpr.runtime.recognise.recogniser import Matcher, Recogniser, WalkSettings
from edgevpr.techniques import create


def test_the_whole_walk(tmp_path):
    config, board, clock = load_config(None), load_board("rpi-4b"), FakeClock()
    technique, meter = create("cohog", {"w1": 208}), meter_of(config, board)
    frames = [
        Frame(image=textured(n), name=f"{n}", t_mono_s=0.0, position=Position(50 + n / 1000, 8.0)) for n in range(5)
    ]
    with PlaceMap.create(tmp_path / "m.gpkg", technique.spec) as place_map:
        assert build_map(frames, technique, place_map, meter).added == 5
    with PlaceMap.open(tmp_path / "m.gpkg") as place_map, FlightLog(tmp_path / "log", clock=clock) as flight_log:
        recogniser = Recogniser(
            Matcher(technique, load_index(place_map, technique, 10**6), accept_rule(technique, config.match)),
            place_map,
            meter,
            WalkSettings(candidates=technique.candidates),
        )
        link = FakeLink(clock)
        crew = Crew(
            recogniser=recogniser,
            source=FakeSource([textured(3), textured(9)], clock),
            link=link,
            autopilot=to_autopilot(link, Navigator(5.0, 1.0), clock, flight_log),
            flight_log=flight_log,
            herald=Herald(flight_log, link),
            meter=FlightMeter(config.battery, board, clock.clock),
            clock=clock.clock,
            stop=Stop(),
        )
        assert Flight(config, crew).run() == 0
    assert link.stats().fixes_sent == 1
    known, answer, unknown, end = read_log(tmp_path / "log")
    assert (end["queries"], end["accepted"], end["unusable"]) == (2, 1, 0)
    assert (known["place"], known["accepted"], known["fix"]["sent"]) == (4, True, True)
    assert (answer["kind"], answer["query"], answer["result"]) == ("answer", known["query"], "ACCEPTED")
    assert (unknown["accepted"], unknown["fix"], unknown["last_fix"]["answer"]) == (False, None, "ACCEPTED")
