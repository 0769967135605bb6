"""Flights with a heading and a position: they narrow the search where they are right and cost a query where not."""

import cv2
import numpy as np
import pytest
from fakes import FakeClock, FakeLink, FakeSource, vehicle_at
from flights import STEP_DEG, Flight, of_kind
from pictures import textured

from edgevpr.core.types import Frame, Position
from edgevpr.mapmaking.mapping import build_map
from edgevpr.places.mapfile import PlaceMap
from edgevpr.runtime.recognise.encoder import FrameEncoder
from edgevpr.techniques import create

SIDE_PX = 256
PLACES = 8
MAPPED_DEG = 30.0
TURNED_DEG = 70.0  # flown with the nose to 100 degrees


def view(place, heading_deg):
    """The ground of a place as an aircraft with this heading sees it: turned the other way."""
    ground = textured(place, 2 * SIDE_PX, 2 * SIDE_PX)
    turn = cv2.getRotationMatrix2D((SIDE_PX - 0.5, SIDE_PX - 0.5), heading_deg, 1)
    turned = cv2.warpAffine(ground, turn, ground.shape[::-1])
    return turned[SIDE_PX // 2 : -SIDE_PX // 2, SIDE_PX // 2 : -SIDE_PX // 2]


def frame(place, flown_deg, said_deg=None):
    """The picture of a place, flown with one heading and said to be flown with another."""
    position = Position(50 + place * STEP_DEG, 8.0)
    image = np.ascontiguousarray(view(place, flown_deg))
    return Frame(image=image, name=f"{place}", t_mono_s=0.0, position=position, heading_deg=said_deg)


def mapped(path, **settings):
    """A map of eight places, mapped by an aircraft that looked down, or ahead, with its nose to 30 degrees."""
    technique = create("cohog", {"w1": 256, **settings})
    frames = (frame(place, MAPPED_DEG, MAPPED_DEG) for place in range(PLACES))
    with PlaceMap.create(path, technique.spec) as place_map:
        build_map(frames, FrameEncoder(technique=technique), place_map)
    return path


@pytest.fixture(scope="module")
def place_map(tmp_path_factory):
    return mapped(tmp_path_factory.mktemp("hinted") / "m.gpkg", camera="nadir")


def fly(place_map, log, frames, says=None, reach_m_s=None, is_live=True, **settings):
    """The queries of a flight whose autopilot is at a place with a heading, by what it `says` (None: there is none)."""
    clock, link = FakeClock(), None
    if says:
        place, heading_deg = says
        link = FakeLink(
            clock,
            vehicle=lambda: vehicle_at(50 + place * STEP_DEG, 8.0, clock.now_s - 0.5, heading_deg=heading_deg),
        )
    settings = {"match.reach_m_s": reach_m_s, "source.rate_hz": 60.0} | settings
    if not is_live:
        settings["source.uri"] = "recording"
    flight = Flight(place_map, log, clock, link, **settings)
    return of_kind(flight.fly(FakeSource(frames, clock, is_live=is_live)), "query")


@pytest.mark.slow
def test_a_wrong_compass_costs_one_query_and_not_the_flight(place_map, tmp_path):
    right = [frame(place, 100.0, 100.0) for place in range(3)]
    wrong = [frame(place, 100.0, 250.0) for place in (3, 4, 5, 6)]
    queries = fly(place_map, tmp_path / "log", [*right, *wrong, *right], is_live=False)
    by_heading = {"reach_m": None, "heading": True}
    told = [by_heading] * 4 + [None] * 4 + [by_heading] * 2
    # Three by the heading; it turns wrong, and one query is lost; the next finds its place without it, as do the
    # others until a place is found that the heading agrees with.
    assert [line["hints"] for line in queries] == told
    assert [line["accepted"] for line in queries] == [True] * 3 + [False] + [True] * 6
    assert [line["place"] for line in queries if line["accepted"]] == [1, 2, 3, 5, 6, 7, 1, 2, 3]
    assert all(abs(line["rotation_deg"] - TURNED_DEG) < 3 for line in queries if line["accepted"])


def test_a_live_flight_takes_position_and_heading_from_the_autopilot(place_map, tmp_path):
    queries = fly(place_map, tmp_path / "log", [frame(4, 75.0)] * 2, (4, 75.0), 20.0)
    assert [line["place"] for line in queries] == [5, 5]
    assert all(line["accepted"] and line["hints"]["heading"] for line in queries)
    # 111 m between the places is the least that the margin can be, and half a second old is what it said.
    assert all(121 <= line["hints"]["reach_m"] <= 131 for line in queries)


@pytest.mark.slow
def test_an_aircraft_carried_off_by_half_a_kilometre_is_found_again(place_map, tmp_path):
    """Nothing tells of it."""
    way = (0, 1, 2, 7, 7, 6)
    queries = fly(place_map, tmp_path / "log", [frame(place, MAPPED_DEG) for place in way], None, 10.0)
    assert queries[3]["hints"]["reach_m"] < 250, "where it was taken to be narrowed the query"
    assert all(line["accepted"] for line in queries[4:])
    assert all(line["place"] == place + 1 for line, place in zip(queries, way, strict=True) if line["accepted"])
