"""`edgevpr map move`: a map is moved by the offset and the scale that a flight with it has found, or not at all."""

import json
from dataclasses import replace

import numpy as np
import pytest
from commands import expect_refusal, run_json

from edgevpr.cli.main import main
from edgevpr.core.contract import Descriptor
from edgevpr.core.errors import PlaceError, UsageError
from edgevpr.core.geodesy import offset_m, offset_position
from edgevpr.core.types import Frame, Pose, Position
from edgevpr.mapmaking.moving import move_map
from edgevpr.places.mapfile import PlaceMap
from edgevpr.places.mapinfo import read_identity
from edgevpr.techniques import create

HOME = 47.0, 8.0
OFF_M = 3.0, -4.0
SURVEY = {"kind": "survey", "said": "", "matches": 99, "middle": {"lat_deg": HOME[0], "lon_deg": HOME[1]}}
RESULT = SURVEY | {"off_m": list(OFF_M), "off_sd": 0.4, "scale": None, "scale_sd": None}
PICTURE = np.zeros((8, 8), np.uint8)


@pytest.fixture
def path(tmp_path):
    """A map of two places with a pose, 500 m apart, and one without a position."""
    spec = create("cohog", {"camera": "nadir"}).spec
    coarse, fine = (part and np.zeros(part.shape, part.dtype) for part in (spec.coarse, spec.fine))
    descriptor = Descriptor(coarse=coarse, fine=fine, quality=1.0)
    pose = Pose(up_deg=10.0, footprint_m=130.0, covariance_m2=(1.0, 0.0, 1.0), recorded=Position(47.0, 8.001))
    frame = Frame(image=PICTURE, name="0", t_mono_s=0.0, position=Position(*HOME, 300.0), pose=pose)
    other = Position(*offset_position(*HOME, 500.0, 0.0))
    with PlaceMap.create(tmp_path / "m.gpkg", spec) as place_map:
        place_map.add(frame, descriptor)
        place_map.add(replace(frame, name="1", position=other, pose=replace(pose, recorded=None)), descriptor)
        place_map.add(replace(frame, name="2", position=None, pose=None), descriptor)
    return tmp_path / "m.gpkg"


def write_flight_log(path, *lines):
    """The log of a flight with the map, as it is now."""
    log = path.with_name("flight.jsonl")
    with PlaceMap.open(path) as place_map:
        start = {"kind": "start", "time": "now", "t_mono_s": 0.0, "map_identity": read_identity(place_map)}
    log.write_text("".join(json.dumps(line) + "\n" for line in (start, *lines)))
    return log


def read_places(path, numbers=None):
    with PlaceMap.open(path) as place_map:
        return list(place_map.read_places(numbers))


def test_move_map_moves_each_position_by_the_last_survey_of_the_flight(path, capsys):
    log = write_flight_log(path, RESULT | {"off_m": [99.0, 0.0]}, RESULT)
    before = read_places(path)
    assert main(["map", "move", str(path), "--by", str(log)]) == 0
    said = capsys.readouterr().out
    assert all(figure in said for figure in ("3 places", "3.0 m west", "4.0 m north", "+-0.4 m"))
    after = read_places(path)
    for one, other in zip(before[:2], after[:2], strict=True):
        step = offset_m(one.position.lat_deg, one.position.lon_deg, other.position.lat_deg, other.position.lon_deg)
        assert step == pytest.approx((-3.0, 4.0), abs=1e-3)
        assert replace(other.pose, recorded=None) == replace(one.pose, recorded=None)
    assert after[0].position.alt_m == 300.0
    recorded = after[0].pose.recorded
    assert offset_m(47.0, 8.001, recorded.lat_deg, recorded.lon_deg) == pytest.approx((-3.0, 4.0), abs=1e-3)
    assert after[2].position is None


def test_move_map_corrects_the_scale_around_the_middle_of_the_flight(path, capsys):
    log = write_flight_log(path, RESULT | {"scale": 0.01})
    assert run_json(capsys, "map", "move", path, "--by", log)["scale"] == 0.01
    first, second, _ = read_places(path)
    at_m = offset_m(*HOME, second.position.lat_deg, second.position.lon_deg)
    assert at_m == pytest.approx((500 / 1.01 - 3.0, 4.0), abs=1e-2)
    assert first.pose.footprint_m == pytest.approx(130 / 1.01)


def test_move_map_applies_a_log_only_once(path):
    log = write_flight_log(path, RESULT)
    assert main(["map", "move", str(path), "--by", str(log)]) == 0
    with PlaceMap.open_for_writing(path) as place_map, pytest.raises(UsageError, match=path.name):
        move_map(place_map, log)


@pytest.mark.parametrize("lines", [(), (SURVEY | RESULT | {"off_m": None, "off_sd": None},), (RESULT, SURVEY)])
def test_move_map_moves_nothing_without_a_survey(path, lines, capsys):
    log, before = write_flight_log(path, *lines), read_places(path)
    assert "map offset" in expect_refusal(capsys, "map", "move", path, "--by", log)
    assert read_places(path) == before


def test_move_map_moves_nothing_if_a_place_is_damaged(path):
    with PlaceMap.open_for_writing(path) as place_map, place_map.transaction():
        place_map.db.execute("UPDATE places SET heading_deg = 'north' WHERE place_id = 2")
    log, before = write_flight_log(path, RESULT), read_places(path, [1])
    with PlaceMap.open_for_writing(path) as place_map, pytest.raises(PlaceError):
        move_map(place_map, log)
    assert read_places(path, [1]) == before
