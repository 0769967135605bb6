"""Layers: places that were cut at several footprints, and those of them that a picture is looked for among."""

from dataclasses import replace

import numpy as np
import pytest
from map_writer import SPEC, frame, make_descriptor
from ranking import make_index

from edgevpr.core.types import Pose
from edgevpr.places.layers import read_layers
from edgevpr.places.mapfile import PlaceMap
from edgevpr.places.retrieve import Expectation


def make_layers(path, shown):
    """The layers of a map of places that show so much ground; `shown` has (footprint_m, is_surveyed) of each."""
    with PlaceMap.create(path, SPEC) as place_map:
        for number, (footprint_m, is_surveyed) in enumerate(shown, start=1):
            pose = Pose(up_deg=0.0, footprint_m=footprint_m, covariance_m2=(1.0, 0.0, 1.0), is_surveyed=is_surveyed)
            place_map.add(replace(frame(number), pose=pose), make_descriptor(number))
    with PlaceMap.open(path) as place_map:
        return read_layers(place_map)


CUT = [(150.0, True), (100.0, True), (102.0, True), (150.0, True), (300.0, False)]


def test_layers_are_one_per_footprint_of_the_map(tmp_path):
    assert make_layers(tmp_path / "a.gpkg", CUT).footprints_m == (100.0, 150.0)
    assert make_layers(tmp_path / "b.gpkg", CUT[1:3]).footprints_m == (101.0,), "as good as one"
    assert make_layers(tmp_path / "c.gpkg", [(80.0, False), (160.0, False), (90.0, False)]).footprints_m == (90.0,)
    assert make_layers(tmp_path / "d.gpkg", []).footprints_m == ()


@pytest.mark.parametrize(("seen_m", "among_m"), [(60, 100), (125, 100), (150, 150), (400, 150), (None, None)])
def test_choose_footprint_prefers_slightly_smaller_places(tmp_path, seen_m, among_m):
    assert make_layers(tmp_path / "m.gpkg", CUT).choose_footprint(seen_m) == among_m


def test_narrow_search_excludes_places_of_other_footprints(tmp_path):
    found = make_layers(tmp_path / "m.gpkg", CUT)
    whole = make_index([1, 2, 3, 4, 5, 9])  # 9 was learnt since
    assert found.narrow_search(Expectation(), whole, 150.0).in_reach.tolist() == [True, False, False, True, True, True]
    assert found.narrow_search(Expectation(), whole, 90.0).in_reach.tolist() == [False, True, True, False, True, True]
    near = Expectation(in_reach=np.array([True, True, False, False, False, False]))
    assert found.narrow_search(near, whole, 150.0).in_reach.tolist() == [True, False, False, False, False, False]
    assert found.narrow_search(near, whole, None) is near
    assert found.narrow_search(Expectation(), make_index([2, 3]), 150.0).in_reach is None, "none of them is in reach"


def test_narrow_search_keeps_all_places_of_a_single_layer(tmp_path):
    expected = Expectation()
    assert make_layers(tmp_path / "m.gpkg", CUT[1:3]).narrow_search(expected, make_index([1, 2]), 300.0) is expected
