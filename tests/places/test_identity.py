"""The identity of a map."""

import shutil
from contextlib import closing

import pytest
from map_writer import make_map

from edgevpr.places.mapfile import PlaceMap
from edgevpr.places.mapfiles import connect
from edgevpr.places.mapinfo import MapIdentity, identity_of


@pytest.fixture
def path(tmp_path):
    return make_map(tmp_path / "m.gpkg", 3)


def identity(path) -> MapIdentity:
    with PlaceMap.open(path) as place_map:
        return identity_of(place_map)


def test_a_copy_is_the_same_map(path, tmp_path):
    copy = shutil.copy(path, tmp_path / "copy.gpkg")
    assert identity(path) == identity(copy)
    assert identity(path).places == 3
    assert len(identity(path).map_id) == 32


@pytest.mark.parametrize(
    "change",
    [
        "UPDATE places SET quality = 0.5 WHERE place_id = 2",
        "UPDATE places SET fine_crc32 = fine_crc32 + 1 WHERE place_id = 2",
        "UPDATE places SET up_deg = 3.0 WHERE place_id = 2",
        "UPDATE places SET source_image = 'other' WHERE place_id = 2",
        "UPDATE places SET geom = (SELECT geom FROM places WHERE place_id = 3) WHERE place_id = 2",
        "INSERT INTO edgevpr_map (key, value) VALUES ('calibration', '\"0\"')",
        "UPDATE places SET place_id = 9 WHERE place_id = 3",
    ],
)
def test_any_change_makes_it_another(path, change):
    before = identity(path)
    with closing(connect(path, "rw")) as db:
        db.execute(change)
    assert identity(path).sha256 != before.sha256
