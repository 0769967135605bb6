"""The two flights, what is written of them, and how answers are judged."""

import re
from dataclasses import replace
from types import SimpleNamespace

import pytest

from edgevpr.frames.positions import read_positions
from edgevpr.lab.simulate.demo import summarise
from edgevpr.lab.simulate.generated import SCENE_DEPTH_M, SCENE_WIDTH_M, plan_mapping_flight, to_metres, write_flight
from edgevpr.lab.simulate.landscape import make_scene


@pytest.fixture(scope="module")
def scene():
    return make_scene(1, SCENE_WIDTH_M, SCENE_DEPTH_M, metres_per_pixel=1.0)


@pytest.mark.slow
def test_write_flight_writes_positions_to_a_decimetre(tmp_path, scene):
    flight = plan_mapping_flight(1)
    flight = replace(flight, poses=flight.poses[:17])
    names = list(write_flight(tmp_path, scene, flight))
    tags = read_positions(tmp_path / "positions.csv")
    assert list(tags) == names == sorted(path.name for path in (tmp_path / "images").iterdir())
    for pose, tag in zip(flight.poses, tags.values(), strict=True):
        at_m = to_metres(tag.position.lat_deg, tag.position.lon_deg)
        assert at_m == pytest.approx((pose.east_m, pose.north_m), abs=0.1)
        assert tag.heading_deg == pytest.approx(pose.heading_deg % 360, abs=0.01)


def test_summarise_judges_queries_by_true_positions():
    places = (50.0, 8.0), (50.001, 8.0)
    seen = ((50.0001, 8.0), places[0], 5.56), ((50.001, 8.0), places[0], 88.96), ((50.01, 8.0), places[1], None)
    queries = [
        SimpleNamespace(true_position=true, place_position=place, off_m=off_m, accepted=off_m is not None)
        for true, place, off_m in seen
    ]
    figures = re.findall(r"[\d.]+", summarise(queries, places).partition("\n")[2])
    assert figures[:5] == ["3", "2", "1", "1", "0.50"], "queries, on the map and beyond it; right, their share"
