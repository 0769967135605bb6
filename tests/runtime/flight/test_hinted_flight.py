"""Flights with a heading and a position: they narrow the search where they are right and cost a query where not."""

import csv
import sys
import time
from subprocess import run

import cv2
import pytest
from pictures import textured

from edgevpr.cli import main
from edgevpr.config import load_config
from edgevpr.frames.source import open_source
from edgevpr.places.mapfile import PlaceMap
from edgevpr.runtime.flight.flightlog import FlightLog, read_log
from edgevpr.runtime.flight.loop import Flight
from edgevpr.runtime.recognise.mapping import build_map
from edgevpr.runtime.recognise.pipeline import open_pipeline
from edgevpr.techniques import create
from edgevpr.types import Frame, Vehicle

SIDE_PX = 256
PLACES = 8
SPACING_DEG = 0.001  # of latitude: 111 m
MAPPED_DEG = 30.0


def view(place, heading_deg):
    """The ground of a place as an aircraft with this heading sees it: turned the other way."""
    ground = textured(place, 2 * SIDE_PX, 2 * SIDE_PX)
    turn = cv2.getRotationMatrix2D((SIDE_PX - 0.5, SIDE_PX - 0.5), heading_deg, 1)
    turned = cv2.warpAffine(ground, turn, ground.shape[::-1])
    return turned[SIDE_PX // 2 : -SIDE_PX // 2, SIDE_PX // 2 : -SIDE_PX // 2]


def write_folder(folder, rows):
    """Pictures of (place, heading flown, heading said), with their positions.csv."""
    folder.mkdir()
    with open(folder / "positions.csv", "w", newline="") as handle:
        table = csv.writer(handle)
        table.writerow(("file", "lat", "lon", "yaw_deg"))
        for number, (place, flown_deg, said_deg) in enumerate(rows):
            cv2.imwrite(str(folder / f"{number:02d}.png"), view(place, flown_deg))
            table.writerow((f"{number:02d}.png", 50 + place * SPACING_DEG, 8.0, said_deg))


@pytest.fixture(scope="module")
def flown(tmp_path_factory):
    """A map of eight places, mapped by an aircraft that looked down with its nose to 30 degrees."""
    folder = tmp_path_factory.mktemp("hinted")
    write_folder(folder / "ref", [(place, MAPPED_DEG, MAPPED_DEG) for place in range(PLACES)])
    technique = create("cohog", {"camera": "nadir"})
    source = open_source(str(folder / "ref"), live=False)
    with PlaceMap.create(folder / "m.gpkg", technique.spec) as place_map:
        build_map((source.read(0) for _ in range(PLACES)), technique, place_map)
    return folder


def test_a_wrong_compass_costs_one_query_and_not_the_flight(flown, tmp_path):
    right = [(place, 100.0, 100.0) for place in range(3)]
    wrong = [(place, 100.0, 250.0) for place in (3, 4, 5, 6)]
    write_folder(tmp_path / "query", [*right, *wrong, *right])
    command = [
        sys.executable, "-m", "edgevpr", "run", "--map", flown / "m.gpkg", "--source", tmp_path / "query",
        "--log", tmp_path / "log", "--rate-hz", "60",
    ]  # fmt: skip
    assert run(command, capture_output=True, timeout=60).returncode == 0
    queries = [line for line in read_log(tmp_path / "log") if line["kind"] == "query"]
    by_heading = {"reach_m": None, "heading": True}
    told = [by_heading] * 4 + [None] * 4 + [by_heading] * 2
    # Three by the heading; it turns wrong, and one query is lost; the next finds its place without it, as do the
    # others until a place is found that the heading agrees with.
    assert [line["hints"] for line in queries] == told
    assert [line["accepted"] for line in queries] == [True] * 3 + [False] + [True] * 6
    assert [line["place"] for line in queries if line["accepted"]] == [1, 2, 3, 5, 6, 7, 1, 2, 3]
    assert all(line["rotation_deg"] in (60, 75) for line in queries if line["accepted"])


class Camera:
    """A live source of pictures of the places named."""

    total, state = 0, "streaming"

    def __init__(self, places, heading_deg):
        self._places, self._heading_deg = list(places), heading_deg

    @property
    def ended(self):
        return not self._places

    def read(self, timeout_s):
        place = self._places.pop(0)
        return Frame(image=view(place, self._heading_deg), name=f"{place}", t_mono_s=time.monotonic())


class Autopilot:
    """A link whose vehicle says to be at a place of the map, with a heading."""

    def __init__(self, place, heading_deg):
        self._place, self._heading_deg = place, heading_deg

    def vehicle_position(self, max_age_s):
        lat_deg = 50 + self._place * SPACING_DEG
        return Vehicle(
            lat_deg=lat_deg,
            lon_deg=8.0,
            alt_m=300.0,
            heading_deg=self._heading_deg,
            t_heard_s=time.monotonic() - 0.5,
            has_gps=True,
        )

    def send(self, *messages):
        pass

    send_fix = set_health = send


def fly(flown, log, camera, autopilot, reach_m_s, **settings):
    settings = {"map": str(flown / "m.gpkg"), "match.reach_m_s": reach_m_s, "source.rate_hz": 60.0} | settings
    config = load_config(None, settings)
    pipeline = open_pipeline(config)
    with pipeline.place_map, FlightLog(str(log)) as flight_log:
        flight = Flight(pipeline, camera, flight_log, autopilot, config)
        flight.run()
    return [line for line in read_log(log) if line["kind"] == "query"]


def test_a_live_flight_takes_position_and_heading_from_the_autopilot(flown, tmp_path):
    queries = fly(flown, tmp_path / "log", Camera([4, 4], 75.0), Autopilot(4, 75.0), 20.0)
    assert [line["place"] for line in queries] == [5, 5]
    assert all(line["accepted"] and line["hints"]["heading"] for line in queries)
    # 111 m between the places is the least that the margin can be, and half a second old is what it said.
    assert all(121 <= line["hints"]["reach_m"] <= 131 for line in queries)


def test_a_false_position_costs_time_and_not_the_flight(flown, tmp_path):
    queries = fly(flown, tmp_path / "log", Camera([0, 0, 0, 0], MAPPED_DEG), Autopilot(7, None), 1.0)
    assert all(line["place"] == 1 for line in queries if line["accepted"])
    assert [line["accepted"] for line in queries[1:]] == [True] * 3
    assert queries[0]["hints"]["heading"] is False
    assert [line["hints"] for line in queries[1:]] == [None] * 3, "what was found says that it is false"


def test_our_own_fix_says_where_to_look_next(flown, tmp_path):
    queries = fly(flown, tmp_path / "log", Camera([2, 2, 3], MAPPED_DEG), None, 10.0)
    assert [line["place"] for line in queries] == [3, 3, 4]
    assert queries[0]["hints"] is None
    assert all(line["hints"]["reach_m"] >= 111 for line in queries[1:])


def test_the_speed_is_a_flag(flown, tmp_path, capsys):
    write_folder(tmp_path / "query", [(2, MAPPED_DEG, ""), (2, MAPPED_DEG, "")])
    command = ["run", "--map", str(flown / "m.gpkg"), "--source", str(tmp_path / "query"), "--rate-hz", "60"]
    assert main([*command, "--log", str(tmp_path / "log"), "--reach-m-s", "10"]) == 0
    queries = [line for line in read_log(tmp_path / "log") if line["kind"] == "query"]
    assert [line["hints"] and line["hints"]["heading"] for line in queries] == [None, False]
    assert main([*command, "--reach-m-s", "0"]) == 2
    assert "`match.reach_m_s` is 0; it must be between 0.1 and 100" in capsys.readouterr().err


def test_no_speed_no_reach(flown, tmp_path):
    queries = fly(flown, tmp_path / "log", Camera([2, 2], MAPPED_DEG), Autopilot(7, None), None)
    assert [line["hints"] for line in queries] == [None, None]
    assert all(line["accepted"] for line in queries)


def test_a_camera_that_looks_ahead_is_told_no_heading(flown, tmp_path):
    technique = create("cohog")
    source = open_source(str(flown / "ref"), live=False)
    with PlaceMap.create(tmp_path / "ahead.gpkg", technique.spec) as place_map:
        build_map((source.read(0) for _ in range(PLACES)), technique, place_map)
    autopilot, ahead = Autopilot(2, MAPPED_DEG + 90), {"map": str(tmp_path / "ahead.gpkg")}
    (query,) = fly(flown, tmp_path / "log", Camera([2], MAPPED_DEG), autopilot, None, **ahead)
    assert (query["place"], query["hints"]) == (3, None)


def test_a_sequence_is_told_nothing(flown, tmp_path):
    sequence = {"match.sequence": 2}
    queries = fly(flown, tmp_path / "log", Camera([2, 3], MAPPED_DEG), Autopilot(7, 0.0), 10.0, **sequence)
    assert [line["hints"] for line in queries] == [None, None]
