"""The walk of a frame with the flight so far: what is accepted for it, what is refused, and what the event says."""

import math
import shutil
from dataclasses import replace

import numpy as np
import pytest
from fixed_confidence import make_rule
from pictures import draw_texture
from walks import make_map, walk_over

from edgevpr.core.config import load_config
from edgevpr.core.reasons import ReasonCode
from edgevpr.core.types import Frame, Position
from edgevpr.places.mapfile import PlaceMap
from edgevpr.runtime.recognise.decide import MatchSettings
from edgevpr.runtime.recognise.judge import make_accept_rule
from edgevpr.runtime.recognise.place_filter import PlaceFilter
from edgevpr.techniques import create

pytestmark = pytest.mark.slow

PLACES = 40
STRIDE = 3
DUPLICATE_PLACES = 20, 36  # both places show the same picture
TECHNIQUE = create("cohog", {"w1": 208})


def frame(place, t_s=0.0, position=True):
    shown = DUPLICATE_PLACES[0] if place == DUPLICATE_PLACES[1] else place
    there = Position(50 + place * 0.0002, 8.0) if position else None
    return Frame(image=draw_texture(shown), name=f"{place}.png", t_mono_s=t_s, t_utc_s=t_s, position=there)


@pytest.fixture(scope="module", params=[True, False], ids=["positions", "in order"])
def whole_map(request, tmp_path_factory):
    frames = (frame(place, position=request.param) for place in range(PLACES))
    return make_map(tmp_path_factory.mktemp("map") / "m.gpkg", TECHNIQUE, frames)


class TrackedWalk:
    """A flight with or without the flight so far in mind; `confidence` is what each match has by itself."""

    def __init__(self, place_map, rule=None, follows=True):
        self.confidence, self._t_s = 0.88, 0.0
        place_filter = PlaceFilter(place_map, max_speed_m_s=None, is_live=False) if follows else None
        rule = rule or make_rule(lambda evidence: self.confidence, neighbour_m=30.0, min_quality=0.1)
        settings = MatchSettings(candidates=42)
        self.recogniser = walk_over(place_map, TECHNIQUE, rule, settings=settings, place_filter=place_filter)

    def query(self, place, confidence=None, elapsed_s=float(STRIDE), image=None):
        self._t_s += elapsed_s
        self.confidence = confidence or self.confidence
        seen = frame(place, self._t_s)
        event = self.recogniser.step(seen if image is None else replace(seen, image=image))
        assert not event.failed, event.reason
        return event


@pytest.fixture
def flight(whole_map, tmp_path):
    with PlaceMap.open(shutil.copy(whole_map, tmp_path)) as place_map:
        yield TrackedWalk(place_map)


@pytest.fixture
def untracked_walk(whole_map, tmp_path):
    with PlaceMap.open(shutil.copy(whole_map, tmp_path / "alone.gpkg")) as place_map:
        yield TrackedWalk(place_map, follows=False)


def test_tracked_match_is_accepted_although_refused_alone(flight, untracked_walk):
    way = range(1, 19, STRIDE)
    alone_events, events = ([walk.query(place) for place in way] for walk in (untracked_walk, flight))
    assert not any(event.accepted for event in alone_events)
    assert all(event.track is None for event in alone_events)
    assert [event.accepted for event in events[:1] + events[3:]] == [False] + [True] * 3
    assert events[0].track.confidence == pytest.approx(0.88)
    assert events[-1].track.confidence > 0.9
    assert [event.best.place.source_image for event in events] == [f"{place}.png" for place in way]
    assert events[0].position is None


def test_tracked_match_that_contradicts_the_track_is_refused_with_a_reason(flight, untracked_walk):
    for place in range(1, 16, STRIDE):
        flight.query(place)
    assert untracked_walk.query(32, 0.9).accepted
    event = flight.query(32, 0.9, elapsed_s=1.0)
    assert (event.accepted, event.position) == (False, None)
    assert event.reason.code is ReasonCode.TRACK_CONTRADICTS
    assert event.best.place.source_image == "32.png"
    assert flight.query(35, 0.9).accepted or flight.query(38, 0.9).accepted, "but not for long"


def test_tracked_flight_resolves_two_places_that_look_the_same(flight, untracked_walk):
    for place in range(24, 36, STRIDE):
        flight.query(place, 0.9)
    # By itself the place that comes first in the map is as good as the other.
    assert untracked_walk.query(DUPLICATE_PLACES[1], 0.9).best.place.source_image == f"{DUPLICATE_PLACES[0]}.png"
    event = flight.query(DUPLICATE_PLACES[1], 0.9)
    assert event.best.place.source_image == f"{DUPLICATE_PLACES[1]}.png"
    assert event.ranking.slots[0] == event.track.slot == DUPLICATE_PLACES[1]
    assert event.ranking.scores[0] == pytest.approx(event.best.match.score)
    assert sorted(event.ranking.slots.tolist()) == sorted(set(event.ranking.slots.tolist()))
    assert event.track.confidence > 0.5
    if event.position:
        assert event.position.lat_deg == pytest.approx(50 + DUPLICATE_PLACES[1] * 0.0002)


def test_tracked_hover_keeps_recognising_its_place(whole_map):
    """With the models that are shipped."""
    with PlaceMap.open(whole_map) as place_map:
        rule = make_accept_rule(TECHNIQUE, load_config(None).match)
        hovering = TrackedWalk(place_map, rule)
        assert all(hovering.query(5, elapsed_s=1.0).accepted for _ in range(40))
        creeping = TrackedWalk(place_map, rule)
        assert all(creeping.query(5 + look // 4, elapsed_s=0.5).accepted for look in range(40))


def test_tracked_flight_survives_blank_and_unusable_images(flight):
    for place in range(1, 16, STRIDE):
        flight.query(place)
    event = flight.query(17, elapsed_s=1.0, image=np.full((120, 160), 90, np.uint8))
    assert (event.lacks_texture, event.accepted, event.track) == (True, False, None)
    assert flight.recogniser.step(Frame(image=None, name="none", t_mono_s=0.0)).failed
    assert any(flight.query(place).accepted for place in (19, 22))


def test_tracked_flight_accepts_no_unmapped_ground(whole_map):
    rule = make_rule(lambda evidence: 0.89 if evidence["agree"] > math.log(0.6) else 0.05)
    with PlaceMap.open(whole_map) as place_map:
        walk = TrackedWalk(place_map, rule)
        assert [walk.query(place).accepted for place in range(1, 16, STRIDE)][-1]
        away = [walk.query(0, image=draw_texture(900 + look)) for look in range(10)]
    assert not any(event.accepted for event in away)
    assert all(event.track.lost > 0.5 for event in away[5:])
