"""A query from another height than the map's: looked for from there where the first look accepts nothing."""

import math
from dataclasses import replace

import pytest
from pictures import draw_view
from walks import make_map, walk_over

from edgevpr.core.types import Frame, Pose, Position
from edgevpr.frames.level import Lens
from edgevpr.places.mapfile import PlaceMap
from edgevpr.runtime.recognise.hints import Prior
from edgevpr.runtime.recognise.levelling import Levelling
from edgevpr.techniques import create

pytestmark = pytest.mark.slow

PLACES = 4


def frame(place, height_ratio=1.0):
    image = draw_view(place, height_ratio)
    return Frame(image=image, name=str(place), t_mono_s=0.0, position=Position(50 + place * 0.01, 8.0))


@pytest.fixture(scope="module")
def height_map(tmp_path_factory):
    technique = create("cohog", {"camera": "nadir"})
    path = make_map(tmp_path_factory.mktemp("heights") / "m.gpkg", technique, map(frame, range(PLACES)))
    with PlaceMap.open(path) as place_map:
        yield technique, place_map


def recogniser(height_map, monkeypatch, prior=None):
    """A recogniser, and the heights that its scans are asked to look from."""
    technique, place_map = height_map
    heights, scan = [], type(technique).score_places

    def score_places(query, rows, mean, **hints):
        heights.append(hints["height_ratio"])
        return scan(technique, query, rows, mean, **hints)

    monkeypatch.setattr(technique, "score_places", score_places, raising=False)
    return walk_over(place_map, technique, prior=prior), heights


def test_step_needs_one_pass_at_the_height_of_the_map(height_map, monkeypatch):
    walk, heights = recogniser(height_map, monkeypatch)
    event = walk.step(frame(2))
    assert event.accepted
    assert heights == [1.0]
    assert event.best.match.height_ratio == pytest.approx(1, abs=0.01)


@pytest.mark.parametrize("height_ratio", [0.55, 2.0])
def test_step_accepts_a_query_from_another_height_in_the_second_pass(height_map, monkeypatch, height_ratio):
    walk, heights = recogniser(height_map, monkeypatch)
    event = walk.step(frame(1, height_ratio))
    assert heights == [1.0, 0.5, 0.7, 1.42, 2.0]
    assert event.accepted, event.reason
    assert event.best.place.source_image == "1"
    assert event.best.match.height_ratio == pytest.approx(height_ratio, rel=0.05)


def test_step_searches_the_next_query_at_the_last_height(height_map, monkeypatch):
    walk, heights = recogniser(height_map, monkeypatch, Prior(None, None, is_live=False))
    first, second = (walk.step(frame(place, 2.0)) for place in (1, 3))
    assert (first.accepted, second.accepted) == (True, True)
    assert heights[:5] == [1.0, 0.5, 0.7, 1.42, 2.0]
    assert heights[5:] == [pytest.approx(2.0)]
    assert second.view.zoom == pytest.approx(first.best.match.height_ratio / 2.0)


def test_step_accepts_no_unmapped_ground_at_any_height(height_map, monkeypatch):
    walk, _ = recogniser(height_map, monkeypatch)
    for height_ratio in (0.5, 1.0, 2.0):
        event = walk.step(frame(17, height_ratio))
        assert not event.failed
        assert not event.accepted


@pytest.fixture(scope="module")
def two_footprint_map(tmp_path_factory):
    """A map of places that were cut at two footprints, 100 m and 150 m."""
    technique, frames = create("cohog", {"camera": "nadir"}), []
    for ratio in (1.0, 1.5):
        pose = Pose(up_deg=0.0, footprint_m=100 * ratio, covariance_m2=(1.0, 0.0, 1.0), is_surveyed=True)
        frames += [replace(frame(place, ratio), name=f"{place} {ratio}", pose=pose) for place in range(PLACES)]
    with PlaceMap.open(make_map(tmp_path_factory.mktemp("layers") / "m.gpkg", technique, frames)) as place_map:
        yield technique, place_map


@pytest.mark.parametrize("height_m", [None, 100.0])
def test_step_searches_the_places_whose_footprint_fits_the_height(two_footprint_map, height_m):
    """By the height, where it is told, from the first picture on; else by the last match."""
    technique, place_map = two_footprint_map
    scan, looked = type(technique).score_places, []

    class Noting(type(technique)):
        def score_places(self, query, rows, mean, **hints):
            looked.append(hints["in_reach"])
            return scan(self, query, rows, mean, **hints)

    fov_deg = math.degrees(2 * math.atan(0.5))  # the footprint is the height
    levelling = Levelling(Lens(fov_deg), is_live=False) if height_m else None
    noting, prior = Noting(**technique.spec.parameters), Prior(None, None, is_live=False)
    walk = walk_over(place_map, noting, encoder={"levelling": levelling}, prior=prior)
    for place, ratio in ((1, 1.5), (3, 1.5), (2, 1.0), (0, 1.0)):
        del looked[:]
        event = walk.step(replace(frame(place, ratio), height_m=height_m and ratio * height_m))
        assert event.accepted, event.reason
        assert event.best.place.source_image.startswith(f"{place} ")
        if height_m or place in (3, 0):
            assert event.best.place.pose.footprint_m == 100 * ratio
            assert looked[0].tolist() == [ratio == 1.0] * PLACES + [ratio == 1.5] * PLACES
