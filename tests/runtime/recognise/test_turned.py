"""A picture of unknown heading that fits a place in two ways: which of them is right is not known."""

from functools import partial

import numpy as np
import pytest
from pictures import draw_texture
from walks import make_map, walk_over

from edgevpr.core.reasons import ReasonCode
from edgevpr.core.types import Frame, Position
from edgevpr.places.mapfile import PlaceMap
from edgevpr.runtime.recognise.hints import Prior, RecordedPrior
from edgevpr.techniques import create

WITHIN_DEG = 20.0
SYMMETRIC_PLACE = 2  # the place that looks the same from its other end


def frame(place, shift_px=0, heading_deg=None):
    ground = draw_texture(place, 500, 500)
    if place == SYMMETRIC_PLACE:
        ground = np.uint8(np.rint((ground.astype(float) + ground[::-1, ::-1]) / 2))
    image = ground[50 + shift_px : 434 + shift_px, 50:434]
    at = Position(50 + place * 0.01, 8.0)
    return Frame(image=image, name=str(place), t_mono_s=0.0, position=at, heading_deg=heading_deg)


@pytest.fixture(scope="module")
def make_walk(tmp_path_factory):
    technique, frames = create("cohog", {"camera": "nadir"}), (frame(place, heading_deg=0.0) for place in range(4))
    with PlaceMap.open(make_map(tmp_path_factory.mktemp("turned") / "m.gpkg", technique, frames)) as place_map:
        yield partial(walk_over, place_map, technique)


@pytest.fixture
def walk(make_walk):
    return make_walk(prior=RecordedPrior(("heading",), WITHIN_DEG))


def test_step_accepts_a_rotationally_ambiguous_place_only_with_a_heading(walk):
    unknown, known = (walk.step(frame(SYMMETRIC_PLACE, 40, heading_deg)) for heading_deg in (None, 0.0))
    assert not unknown.accepted
    assert unknown.reason.code is ReasonCode.ROTATION_AMBIGUOUS
    assert known.accepted, known.reason


def test_step_accepts_any_other_place_without_a_heading(walk):
    event = walk.step(frame(1, 40))
    assert event.accepted, event.reason


def test_step_loses_one_query_to_a_wrong_compass(make_walk):
    """The next finds its place without the heading, as do the others until a place is found that agrees with it."""
    walk = make_walk(prior=Prior(None, WITHIN_DEG, is_live=False))
    events = [walk.step(frame(place, 40, heading_deg)) for place, heading_deg in {0: 0.0, 1: 150.0, 3: 150.0}.items()]
    assert [event.accepted for event in events] == [True, False, True]
    assert [event.hints is not None for event in events] == [True, True, False]
