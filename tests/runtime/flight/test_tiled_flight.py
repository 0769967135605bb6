"""Flights over a folder of maps, of which only a few are in RAM at once."""

import shutil
import threading
from concurrent.futures import Future, ThreadPoolExecutor, wait
from pathlib import Path
from typing import ClassVar

import cv2
import numpy as np
import pytest
from fakes import FakeClock, FakeLink, FakeSource, vehicle_at
from flights import STEP_DEG, Flight, of_kind
from pictures import textured

from edgevpr.core.config import load_config
from edgevpr.core.errors import MapError, UsageError
from edgevpr.core.quadkeys import tile_keys
from edgevpr.core.types import Frame, Position
from edgevpr.mapmaking.mapping import build_map
from edgevpr.places.examine import select
from edgevpr.places.index import bytes_per_place
from edgevpr.places.mapfile import PlaceMap
from edgevpr.places.tilemap import TileMap
from edgevpr.power.boards import load_board
from edgevpr.review.compare import compare
from edgevpr.review.replay import replay
from edgevpr.runtime.flight import tiles as tiles_of_flight
from edgevpr.runtime.flight.flight import fly
from edgevpr.runtime.preflight.pick import outlook
from edgevpr.runtime.recognise import opening
from edgevpr.runtime.recognise.encoder import FrameEncoder
from edgevpr.runtime.recognise.opening import count_searched_places, open_recogniser, places_in_ram
from edgevpr.techniques import create

SIDE_PX, PLACES, ZOOM = 256, 24, 17  # a tile has a side of 197 m at this latitude: one or two places, 111 m apart
TECHNIQUE = create("cohog", {"w1": 256, "camera": "nadir"})
A_PLACE_MB = bytes_per_place(TECHNIQUE.spec) / 1e6


def frame(place):
    position = Position(50 + place * STEP_DEG, 8.0)
    return Frame(image=textured(place, SIDE_PX, SIDE_PX), name=f"{place}", t_mono_s=0.0, position=position)


@pytest.fixture(scope="module")
def tiles(tmp_path_factory):
    """A row of places from south to north, each tile of the ground in a file of its own."""
    folder = tmp_path_factory.mktemp("tiles")
    with PlaceMap.create(folder / "whole.gpkg", TECHNIQUE.spec) as place_map:
        build_map(map(frame, range(PLACES)), FrameEncoder(technique=TECHNIQUE), place_map)
    keys = tile_keys(50 + np.arange(PLACES) * STEP_DEG, np.full(PLACES, 8.0), ZOOM)
    for key in set(keys.tolist()):
        there = (np.flatnonzero(keys == key) + 1).tolist()
        select(folder / "whole.gpkg", folder / f"{key}.gpkg", lambda place_map, there=there: there)
    (folder / "whole.gpkg").unlink()
    return folder


@pytest.fixture
def folder(tiles, tmp_path):
    return Path(shutil.copytree(tiles, tmp_path / "tiles"))


class Noted(ThreadPoolExecutor):
    """The thread that loads tiles; `idle` waits for it."""

    loads: ClassVar[list[Future]] = []

    def submit(self, *call):
        self.loads.append(super().submit(*call))
        return self.loads[-1]

    @classmethod
    def idle(cls):
        wait(cls.loads, 30)


@pytest.fixture(autouse=True)
def thread(monkeypatch):
    monkeypatch.setattr(tiles_of_flight, "ThreadPoolExecutor", Noted)
    Noted.loads.clear()


class TiledFlight:
    """A flight over a folder of tiles; its autopilot, if it `says`, tells where it is. Of six places' room, four tiles
    are in RAM at most. A frame comes when the tile that was asked for is there, or `work` is done."""

    def __init__(self, folder, log, *, says=True, places_mb=6, **settings):
        self.at, self.clock = 0, FakeClock()
        link = FakeLink(self.clock, vehicle=lambda: self.vehicle() if says else None)
        with pytest.MonkeyPatch.context() as patch:  # less than may be configured
            patch.setattr(opening, "budget_mb", lambda config, board: places_mb * A_PLACE_MB)
            self.itself = Flight(folder, log, self.clock, link, **{"source.rate_hz": 1.0} | settings)
        self.map, self.link, self.held = self.itself.recogniser.place_map, link, []

    def vehicle(self):
        return vehicle_at(50 + self.at * STEP_DEG, 8.0, self.clock.now_s - 0.1)

    def fly(self, way, work=Noted.idle):
        way = list(way)
        places = iter(way)

        def read():
            work()
            self.at = next(places)
            self.held.append(self.map.ram.tiles)

        self.lines = self.itself.fly(FakeSource(map(frame, way), self.clock, work=read))
        return of_kind(self.lines, "query")


def tile_at(tile_map, place):
    (key,) = tile_keys(np.array([50 + place * STEP_DEG]), np.array([8.0]), ZOOM)
    return tile_map.keys.index(key)


@pytest.mark.slow
def test_the_tiles_around_the_aircraft_are_in_ram_and_no_others(folder, tmp_path):
    flight = TiledFlight(folder, tmp_path / "log")
    way = [0] * 4 + [place for place in range(PLACES // 2) for _ in range(2)]
    queries = flight.fly(way)
    found = [line for line in queries if line["accepted"]]
    assert len(found) > 0.6 * len(way)
    assert all(line["position"]["lat_deg"] == pytest.approx(50 + int(line["query"]) * STEP_DEG) for line in found)
    assert all(tile_at(flight.map, place) in held for place, held in list(zip(way, flight.held, strict=True))[4:])
    assert max(map(len, flight.held)) <= 5
    assert flight.map.ram.capacity == 6, "the budget is never exceeded: it is all that was allocated"
    assert len(of_kind(flight.lines, "tiles")) > 5


def test_what_a_query_takes_is_that_of_the_tiles_around_the_aircraft(folder):
    config = load_config(None, {"map": str(folder)})
    recogniser = open_recogniser(config, load_board("this"), narrowed=True)
    assert (places_in_ram(recogniser), count_searched_places(recogniser)) == (PLACES, 4 * 2), (
        "two are in the largest tile"
    )
    assert f"{PLACES} places (some 8 of them compared with a query) take" in outlook(recogniser, config).reason
    recogniser.place_map.close()


@pytest.mark.slow
def test_an_aircraft_that_is_lost_is_found_in_tiles_that_are_loaded_in_turn(folder, tmp_path):
    flight = TiledFlight(folder, tmp_path / "log", says=False, places_mb=4)
    queries = flight.fly([0] * (PLACES + 4))
    accepted = [line["accepted"] for line in queries]
    assert not any(accepted[:8]), "the tiles in the north are the first"
    assert all(accepted[accepted.index(True) :]), "it is not lost again"
    assert {line["position"]["lat_deg"] for line in queries if line["accepted"]} == {50.0}


@pytest.mark.slow
def test_a_false_position_is_not_the_only_place_where_it_is_looked_for(folder, tmp_path):
    flight = TiledFlight(folder, tmp_path / "log", places_mb=4, **{"source.rate_hz": 0.2})
    flight.vehicle = lambda: vehicle_at(50.0, 8.0, flight.clock.now_s - 0.1)
    accepted = [line["accepted"] for line in flight.fly([12] * 24)]
    assert not any(accepted[:12])
    assert any(accepted[12:])


def test_no_query_waits_for_a_tile(folder, tmp_path, monkeypatch):
    load, is_there = TileMap.load, threading.Event()
    flight = TiledFlight(folder, tmp_path / "log")

    def slow(tile_map, tile):
        assert is_there.wait(30)
        return load(tile_map, tile)

    monkeypatch.setattr(TileMap, "load", slow)
    asked = []

    def work():
        asked.append(len(Noted.loads))
        if len(asked) == 6:
            is_there.set()
            Noted.idle()

    queries = flight.fly([8] * 10, work)
    assert asked[1:6] == [1] * 5, "one tile is being loaded"
    assert [line["accepted"] for line in queries][-3:] == [True] * 3
    assert not any(line["accepted"] for line in queries[:5])


@pytest.mark.parametrize("how", ["damaged", "of another technique"])
def test_a_tile_that_cannot_be_used_is_said_once_and_flown_past(folder, tmp_path, how):
    flight = TiledFlight(folder, tmp_path / "log")
    tile = folder / f"{flight.map.keys[tile_at(flight.map, 8)]}.gpkg"
    tile.unlink()
    if how == "damaged":
        tile.write_bytes(b"nothing")
    else:
        PlaceMap.create(tile, create("cohog", {"camera": "nadir"}).spec).close()
    queries = flight.fly([8, 8, 8, 8, 14, 14, 14, 14])
    (said,) = of_kind(flight.lines, "tile")
    assert (tile.name if how == "damaged" else "w1 is 512, not 256") in said["problem"]
    assert queries[-1]["accepted"]


def test_a_flight_ends_while_a_tile_is_being_loaded(folder, tmp_path):
    flight = TiledFlight(folder, tmp_path / "log")
    flight.fly([8] * 2, work=lambda: None)
    assert not [each for each in threading.enumerate() if each.name.startswith("tiles")]


@pytest.mark.slow
def test_a_recorded_flight_over_tiles_is_flown_again_to_the_byte(folder, tmp_path):
    (tmp_path / "seen").mkdir()
    for number in range(8):
        cv2.imwrite(str(tmp_path / "seen" / f"{number}.png"), frame(number // 2 + 8).image)
    files = {
        "source.uri": str(tmp_path / "seen"),
        "log.path": str(tmp_path / "log"),
        "log.record": str(tmp_path / "tape"),
    }
    assert fly(load_config(None, {"map": str(folder), "source.rate_hz": 2.0, **files})) == 0
    again = replay(tmp_path / "log")
    lines = compare(again.flown, again.lines)
    assert not lines.others
    assert len(of_kind(again.lines, "tiles")) > 2


def test_a_folder_is_flown_over_and_nothing_else(folder, tmp_path):
    board = load_board("this")
    with pytest.raises(UsageError, match="edgevpr map subset"):
        open_recogniser(load_config(None, {"map": str(folder)}), board)
    with pytest.raises(UsageError, match="no sequences"):
        open_recogniser(load_config(None, {"map": str(folder), "match.sequence": 5}), board, narrowed=True)
    (tmp_path / "none").mkdir()
    with pytest.raises(MapError, match="no folder of maps"):
        TileMap.open(tmp_path / "none")
