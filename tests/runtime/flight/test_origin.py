"""The origin that is set for an autopilot without one: a place of the map, at the altitude of the ground."""

from types import SimpleNamespace

import pytest

from edgevpr.core.config import load_config
from edgevpr.core.errors import PlaceError
from edgevpr.core.types import Place, Pose, Position
from edgevpr.runtime.flight.startup import find_origin


def make_place_map(altitudes_m, footprint_m=100.0, lens=None, is_surveyed=False):
    def places():
        pose = None
        if footprint_m:
            pose = Pose(up_deg=0.0, footprint_m=footprint_m, covariance_m2=(1.0, 0.0, 1.0), is_surveyed=is_surveyed)
        yield Place(place_id=0, source_image="unknown.jpg")
        for number, alt_m in enumerate(altitudes_m, 1):
            if alt_m == "damaged":
                raise PlaceError("map", number, "damaged")
            position = Position(50.0 + number, 8.0, alt_m)
            yield Place(place_id=number, source_image=f"{number}.jpg", position=position, pose=pose)

    return SimpleNamespace(lens=lens, read_places=places)


@pytest.mark.parametrize(
    ("places", "ground_m"),
    [
        (make_place_map([634.0, 633.0, 9999.0, 635.0, 634.0]), 584.0),
        (make_place_map([634.0, "damaged"]), 584.0),
        (make_place_map([634.0], footprint_m=None), None),
        (make_place_map([None, None]), None),
        (make_place_map([634.0], is_surveyed=True), None),
        (make_place_map([634.0], lens="other.yaml"), None),
    ],
)
def test_find_origin_has_the_altitude_of_the_ground(places, ground_m):
    source = load_config(None, {"source.fov_deg": 90.0}).source
    assert find_origin(places, source) == Position(51.0, 8.0, None if ground_m is None else pytest.approx(ground_m))


def test_find_origin_has_no_altitude_without_lens_or_position():
    source = load_config(None, {}).source
    assert find_origin(make_place_map([634.0]), source) == Position(51.0, 8.0, None)
    assert find_origin(make_place_map([]), source) is None
