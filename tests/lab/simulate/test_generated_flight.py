"""The two flights, what is written of them, and how answers are judged."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from edgevpr.frames.positions import read_positions
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
