"""How a picture lies on the ground, and its landmarks, kept in the map file."""

import dataclasses

import pytest
from map_writer import SPEC, frame, make_descriptor, write_sql

from edgevpr.core.errors import PlaceError
from edgevpr.core.types import Pose, Position
from edgevpr.places.examine import check_map, check_places, merge_maps, repair_map
from edgevpr.places.geopackage import encode_point
from edgevpr.places.mapfile import PlaceMap

POSE = Pose(up_deg=271.5, footprint_m=66.0, covariance_m2=(4.0, -1.0, 2.25), recorded=Position(50.1, 8.2))
LANDMARKS = bytes(range(200))


@pytest.fixture
def posed_map(tmp_path):
    """A map of two places: the first has a pose and landmarks."""
    path = tmp_path / "posed.gpkg"
    with PlaceMap.create(path, SPEC) as place_map:
        place_map.add(dataclasses.replace(frame(0), pose=POSE), make_descriptor(0), landmarks=LANDMARKS)
        place_map.add(frame(1), make_descriptor(1))
    return path


def test_pose_and_landmarks_are_stored_and_optional(posed_map, tmp_path):
    assert merge_maps([posed_map], tmp_path / "copy.gpkg") == ([(2, 0)], False)
    with PlaceMap.open(posed_map) as place_map, PlaceMap.open(tmp_path / "copy.gpkg") as copy:
        for each in (place_map, copy):
            first, second = each.read_places()
            assert first.pose == POSE
            assert second.pose is None
            assert (each.read_landmarks(1), each.read_landmarks(2)) == (LANDMARKS, None)
            assert {found.problem for found in check_places(each)} == {None}
            row = each.db.execute("SELECT geom_crc32, coarse_crc32 FROM places WHERE place_id = 2")
            assert None not in row.fetchone()


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ("up_deg = 90", "pose .*checksum"),
        ("footprint_m = NULL", "pose .*checksum"),
        ("footprint_m = -1, pose_crc32 = NULL", "its footprint_m is -?[19]"),
        ("footprint_m = 9e99, pose_crc32 = NULL", "its footprint_m is -?[19]"),
        ("up_deg = 'north', pose_crc32 = NULL", "its up_deg is 'north'"),
        ("up_deg = NULL, pose_crc32 = NULL", "pose is incomplete"),
        ("cov_east_north_m2 = 99, pose_crc32 = NULL", "covariance"),
        ("recorded_lat_deg = 91, pose_crc32 = NULL", "its recorded_lat_deg is 91"),
        ("landmarks = x'00'", "landmarks .*checksum"),
        ("landmarks = zeroblob(20000)", "landmarks .*size"),
    ],
)
def test_pose_that_is_implausible_is_refused(posed_map, change, says):
    write_sql(posed_map, f"UPDATE places SET {change} WHERE place_id = 1")
    with PlaceMap.open(posed_map) as place_map:
        (broken,) = [each for each in check_places(place_map) if each.problem]
        assert broken.place_id == 1
        with pytest.raises(PlaceError, match=says):
            [*place_map.read_places([1]), place_map.read_landmarks(1)]


def test_repair_map_drops_only_damaged_landmarks_of_a_place(posed_map):
    write_sql(posed_map, "UPDATE places SET landmarks = x'00' WHERE place_id = 1")
    found = check_map(posed_map)
    assert (found.places, found.total, len(found.damaged)) == (2, 2, 1)
    repair_map(posed_map)
    assert check_map(posed_map).is_intact
    with PlaceMap.open(posed_map) as place_map:
        assert [place.place_id for place in place_map.read_places()] == [1, 2]
        assert place_map.read_landmarks(1) is None


def test_pose_is_kept_if_another_program_moves_the_place_but_not_its_recorded_position(posed_map):
    write_sql(posed_map, f"UPDATE places SET geom = x'{encode_point(51.0, 9.0).hex()}' WHERE place_id = 1")
    with PlaceMap.open(posed_map) as place_map:
        (place,) = place_map.read_places([1])
    assert place.pose == dataclasses.replace(POSE, recorded=None)
    assert (place.position.lat_deg, place.position.lon_deg) == (51.0, 9.0)
