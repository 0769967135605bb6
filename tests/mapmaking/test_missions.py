"""Areas and paths of mission files."""

import json
import math

import pytest

from edgevpr.core.errors import UsageError
from edgevpr.core.geodesy import offset_m
from edgevpr.mapmaking.missions import Waypoint, read_area

WAYPOINTS = """QGC WPL 110
0\t1\t0\t16\t0\t0\t0\t0\t50.001\t11.9\t584.0\t1
1\t0\t3\t22\t0\t0\t0\t0\t0\t0\t60.0\t1
2\t0\t3\t16\t0\t0\t0\t0\t50.002\t11.901\t60.0\t1
3\t0\t3\t201\t0\t0\t0\t0\t51\t12\t0\t1
4\t0\t10\t82\t0\t0\t0\t0\t50.003\t11.903\t70.0\t1
5\t0\t0\t20\t0\t0\t0\t0\t0\t0\t0\t1
"""
ITEMS = [
    {"type": "SimpleItem", "command": 22, "frame": 3, "params": [0, 0, 0, None, 50.0, 11.9, 50]},
    {"type": "SimpleItem", "command": 530, "frame": 2, "params": [0, 2, None, None, None, None, None]},
    {
        "type": "ComplexItem",
        "complexItemType": "survey",
        "polygon": [[50.0, 11.9], [50.01, 11.9], [50.01, 11.91]],
        "TransectStyleComplexItem": {
            "CameraCalc": {"DistanceToSurface": 80},
            "VisualTransectPoints": [[50.001, 11.9], [50.009, 11.9]],
        },
    },
]


def write_mission_file(tmp_path, said):
    path = tmp_path / "area"
    path.write_text(said if isinstance(said, str) else json.dumps(said))
    return path


def test_read_area_reads_only_flown_waypoints_of_a_waypoint_file(tmp_path):
    area = read_area(write_mission_file(tmp_path, WAYPOINTS))
    assert area.path == (Waypoint(50.001, 11.9), Waypoint(50.002, 11.901, 60.0), Waypoint(50.003, 11.903, 70.0))
    assert area.extent_deg == pytest.approx((50.001, 11.9, 50.003, 11.903))


def test_read_area_reads_waypoints_and_survey_of_a_plan(tmp_path):
    area = read_area(write_mission_file(tmp_path, {"fileType": "Plan", "mission": {"items": ITEMS}}))
    assert area.path == (Waypoint(50.0, 11.9, 50.0), Waypoint(50.001, 11.9, 80), Waypoint(50.009, 11.9, 80))


def test_read_area_reads_the_outline_of_a_structure_scan(tmp_path):
    scan = {"type": "ComplexItem", "complexItemType": "StructureScan", "polygon": [[50.0, 11.9], [50.01, 11.9]]}
    area = read_area(write_mission_file(tmp_path, {"fileType": "Plan", "mission": {"items": [scan]}}))
    assert area.path == (Waypoint(50.0, 11.9), Waypoint(50.01, 11.9), Waypoint(50.0, 11.9))


def _make_plan(point):
    """A plan with a survey of one point."""
    survey = '{"type": "ComplexItem", "TransectStyleComplexItem": {"VisualTransectPoints": [POINT]}}'
    return '{"mission": {"items": [ITEM]}}'.replace("ITEM", survey.replace("POINT", point))


@pytest.mark.parametrize(
    "said",
    [
        "",
        "file,lat,lon",
        "QGC WPL 110\n0 1 0",
        "QGC WPL 110\n0 1 0 16 0 0 0 0 x 11 0 1",
        "QGC WPL 110\n0 1 0 16 0 0 0 0 nan 11 0 1",
        "[]",
        "[" * 100_000,
        '{"type": "Polygon", "coordinates": []}',
        '{"fileType": "Plan"}',
        '{"fileType": "Plan", "mission": {"items": [{}]}}',
        _make_plan("[NaN, 50]"),
        _make_plan("[1" + 400 * "0" + ", 50]"),
    ],
)
def test_read_area_refuses_an_invalid_mission_in_one_sentence(tmp_path, said):
    with pytest.raises(UsageError, match="save"):
        read_area(write_mission_file(tmp_path, said))


def test_read_area_refuses_an_empty_or_invalid_area_and_a_foreign_file(tmp_path):
    for empty in ("QGC WPL 110\n", {"fileType": "Plan", "mission": {"items": []}}):
        with pytest.raises(UsageError, match="no waypoints"):
            read_area(write_mission_file(tmp_path, empty))
    with pytest.raises(UsageError, match="invalid coordinates"):
        read_area(write_mission_file(tmp_path, "QGC WPL 110\n0 1 3 16 0 0 0 0 5542661 707819 0 1"))
    (tmp_path / "picture").write_bytes(b"\xff\xd8\xff\xe0")
    with pytest.raises(UsageError, match="save"):
        read_area(tmp_path / "picture")
    with pytest.raises(UsageError, match="cannot"):
        read_area(tmp_path / "missing")


@pytest.mark.parametrize(("lat_deg", "lon_deg"), [(50.0, 11.9), (-35.36, 149.16), (-17.0, -179.9999)])
def test_read_area_accepts_a_circle(lat_deg, lon_deg):
    area = read_area(f"{lat_deg}, {lon_deg},500")
    ground = area.project_ground(lambda lats_deg, lons_deg: offset_m(lat_deg, lon_deg, lats_deg, lons_deg), 20.0, 7.0)
    assert ground.bounds == pytest.approx((-520, -520, 520, 520))
    assert ground.area == pytest.approx(math.pi * 520**2, rel=0.001)
    south, west, north, east = area.extent_deg
    assert (south + north) / 2 == pytest.approx(lat_deg)
    assert 0 < east - west < 0.02
    for said in (f"{lat_deg},{lon_deg},0", f"{lat_deg},{lon_deg},9000000", "95,11,500", "50,190,500"):
        with pytest.raises(UsageError, match="RADIUS_M"):
            read_area(said)
