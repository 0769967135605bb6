"""The two flights, what is written of them, and how answers are judged."""

import re
from dataclasses import replace

import cv2
import numpy as np
import pytest

from edgevpr.frames.positions import read_positions
from edgevpr.lab.simulate.demo import is_right, read_queries, summarise
from edgevpr.lab.simulate.generated import (
    SCENE_DEPTH_M,
    SCENE_WIDTH_M,
    GeneratedFlight,
    plan_later_flight,
    plan_mapping_flight,
    to_metres,
    write_flight,
)
from edgevpr.lab.simulate.landscape import make_scene
from edgevpr.runtime.flight.flightlog import FlightLog


def first_frames(flight: GeneratedFlight, count: int) -> GeneratedFlight:
    return replace(flight, poses=flight.poses[:count])


@pytest.fixture(scope="module")
def scene():
    return make_scene(1, SCENE_WIDTH_M, SCENE_DEPTH_M, metres_per_pixel=1.0)


@pytest.mark.slow
def test_write_flight_writes_positions_to_a_decimetre(tmp_path, scene):
    flight = first_frames(plan_mapping_flight(1), 17)
    names = list(write_flight(tmp_path, scene, flight))
    tags = read_positions(tmp_path / "positions.csv")
    assert list(tags) == names == sorted(path.name for path in (tmp_path / "images").iterdir())
    for pose, tag in zip(flight.poses, tags.values(), strict=True):
        assert to_metres(tag.position.lat_deg, tag.position.lon_deg) == pytest.approx(
            (pose.east_m, pose.north_m), abs=0.1
        )
        assert tag.heading_deg == pytest.approx(pose.heading_deg % 360, abs=0.01)


def test_write_flight_writes_the_same_each_time(tmp_path, scene):
    for folder in ("one", "two"):
        list(write_flight(tmp_path / folder, scene, first_frames(plan_later_flight(4), 2)))
    one, two = ((tmp_path / folder / "images" / "frame_0001.jpg").read_bytes() for folder in ("one", "two"))
    assert one == two
    assert cv2.imdecode(np.frombuffer(one, np.uint8), cv2.IMREAD_COLOR).shape == (480, 640, 3)


def test_summarise_judges_queries_by_true_positions(tmp_path):
    for folder, rows in (
        ("map", ("p0,50.0,8.0", "p1,50.001,8.0")),
        ("query", ("q0,50.0001,8.0", "q1,50.001,8.0", "q2,50.01,8.0")),
    ):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "positions.csv").write_text("\n".join(["file,lat,lon", *rows]))
    said = (("q0", "p0", 50.00005), ("q1", "p0", 50.0002), ("q2", "p1", None))
    with FlightLog(tmp_path / "log.jsonl") as log:
        log.write("start")
        for query, place, fix_deg in said:
            located = fix_deg and {"lat_deg": fix_deg, "lon_deg": 8.0}
            accepted = fix_deg is not None
            position = {"lat_deg": 50.0 if place == "p0" else 50.001, "lon_deg": 8.0}
            log.write("query", query=query, position=position, score=0.9, accepted=accepted, located=located)
        log.write("end")
    queries, places = read_queries(tmp_path / "log.jsonl", tmp_path / "map", tmp_path / "query")
    assert [is_right(query) for query in queries] == [True, False, False]
    assert [query.off_m for query in queries] == [pytest.approx(5.56, abs=0.01), pytest.approx(88.96, abs=0.1), None]
    figures = re.findall(r"[\d.]+", summarise(queries, places).partition("\n")[2])
    assert figures[:5] == ["3", "2", "1", "1", "0.50"], "queries, on the map and beyond it; right, their share"
