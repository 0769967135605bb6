"""The identity of a map."""

import shutil
from contextlib import closing

import numpy as np
import pytest

from edgevpr.core.contract import Descriptor, PartSpec, TechniqueSpec
from edgevpr.core.types import Frame, Position
from edgevpr.places.mapfile import PlaceMap
from edgevpr.places.mapinfo import MapIdentity, identity_of
from edgevpr.places.sqlite import connect

SPEC = TechniqueSpec(name="x", parameters={}, coarse=PartSpec((4,), "<f4"), fine=PartSpec((8,), "|u1"))


@pytest.fixture
def path(tmp_path):
    path = tmp_path / "m.gpkg"
    with PlaceMap.create(path, SPEC) as place_map:
        for number in range(3):
            add(place_map, number)
    return path


def add(place_map, number):
    descriptor = Descriptor(coarse=np.full(4, number, "<f4"), fine=np.full(8, number, "|u1"))
    place_map.add(
        Frame(image=None, name=f"{number}.jpg", t_mono_s=0.0, position=Position(50.0, number, 1.0)), descriptor
    )


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
        "UPDATE places SET geom = (SELECT geom FROM places WHERE place_id = 1) WHERE place_id = 2",
        "INSERT INTO edgevpr_map (key, value) VALUES ('calibration', '\"0\"')",
        "UPDATE places SET place_id = 9 WHERE place_id = 3",
    ],
)
def test_any_change_makes_it_another(path, change):
    before = identity(path)
    with closing(connect(path, "rw")) as db:
        db.execute(change)
    assert identity(path).sha256 != before.sha256
