"""Places of a map that look alike, ahead: doors of one kind, and what is accepted over them."""

from contextlib import contextmanager
from dataclasses import replace

import cv2
import numpy as np
import pytest
from walks import make_map, query_meter, walk_over

from edgevpr.core.config import load_config
from edgevpr.core.types import Frame
from edgevpr.mapmaking.look_alikes import MapSearch, measure_look_alikes
from edgevpr.places.mapfile import PlaceMap
from edgevpr.runtime.recognise.judge import make_accept_rule
from edgevpr.techniques import create

AHEAD = create("cohog")
HEIGHT_PX = 240
WIDTH_PX = 320
FIRST = 1  # numbers of the places with a door of one kind
SECOND = 5
SPOT_PX = 120  # how far to the right the second door was pictured from


def make_furnished_view(seed, width_px=WIDTH_PX):
    """A view of many things with straight edges."""
    rng = np.random.default_rng(seed)
    view = np.full((HEIGHT_PX, width_px), 128, np.uint8)
    for _ in range(width_px // 4):
        x, y, wide, high = rng.integers((0, 0, 8, 8), (width_px, HEIGHT_PX, 70, 70)).tolist()
        cv2.rectangle(view, (x, y), (x + wide, y + high), int(rng.integers(0, 256)), -1)
    return view


def make_door_view(sign, from_px):
    """A picture of a door of one kind, from a spot. Only a small `sign` (a seed) tells one door from another."""
    wall = make_furnished_view(7, WIDTH_PX + SPOT_PX)
    wall[60:90, 200:230] = make_furnished_view(sign)[:30, :30]
    return wall[:, from_px : from_px + WIDTH_PX]


def change_light(picture, seed=0):
    """The picture in another light, with noise."""
    noise = np.random.default_rng(seed).normal(0, 6, picture.shape)
    return np.clip(0.8 * cv2.GaussianBlur(picture, (0, 0), 1).astype(float) + 20 + noise, 0, 255).astype(np.uint8)


def make_single_views():
    """Pictures of eight places, of which two have a door of one kind."""
    others = [make_furnished_view(20 + number) for number in range(6)]
    return [make_door_view(50, 0), *others[:3], make_door_view(51, SPOT_PX), *others[3:]]


def make_route_views():
    """Pictures of a way, each showing most of what the one before shows."""
    way = make_furnished_view(30, 4 * WIDTH_PX)
    return [way[:, at : at + WIDTH_PX] for at in range(0, 3 * WIDTH_PX, WIDTH_PX // 4)]


@contextmanager
def open_map(path, pictures):
    """A map of these pictures, and what it knows of its look-alikes."""
    frames = [Frame(image=image, name=f"{number}.png", t_mono_s=0.0) for number, image in enumerate(pictures)]
    with PlaceMap.open(make_map(path / "m.gpkg", AHEAD, frames)) as place_map:
        search = MapSearch(place_map, AHEAD, make_accept_rule(AHEAD, load_config(None).match), query_meter())
        described = [(number + 1, AHEAD.encode(image)) for number, image in enumerate(pictures)]
        yield place_map, measure_look_alikes(search, described)


def test_measure_look_alikes_finds_similar_doors_among_single_views(tmp_path):
    with open_map(tmp_path, make_single_views()) as (_, look_alikes):
        assert not look_alikes.overlap
        first, second = look_alikes.places.pop(FIRST), look_alikes.places.pop(SECOND)
        assert (first.other_id, second.other_id) == (SECOND, FIRST)
        assert first.agree == second.agree > max(first.own, *(other.agree for other in look_alikes.places.values()))


def test_measure_look_alikes_treats_neighbours_along_a_route_as_the_same_ground(tmp_path):
    with open_map(tmp_path, make_route_views()) as (_, look_alikes):
        assert look_alikes.overlap
        assert look_alikes.twins == 0


@pytest.mark.parametrize("known", [False, True])
def test_a_door_that_resembles_its_twin_is_refused(tmp_path, known):
    with open_map(tmp_path, make_single_views()) as (place_map, look_alikes):
        rule = make_accept_rule(AHEAD, load_config(None).match)
        walk = walk_over(place_map, AHEAD, replace(rule, look_alikes=look_alikes) if known else rule)
        event = walk.step(Frame(image=change_light(make_door_view(50, SPOT_PX)), name="query", t_mono_s=0.0))
        assert event.best.place.place_id == SECOND, "the regions prefer the wrong door"
        assert not event.accepted
        assert (event.confidence <= 0.5) == known


def test_single_view_without_a_twin_is_accepted_by_its_regions(tmp_path):
    with open_map(tmp_path, make_single_views()) as (place_map, look_alikes):
        rule = replace(make_accept_rule(AHEAD, load_config(None).match), look_alikes=look_alikes)
        walk = walk_over(place_map, AHEAD, rule)
        events = [
            walk.step(Frame(image=change_light(image, number), name="query", t_mono_s=0.0))
            for number, image in enumerate(make_single_views())
        ]
        assert [event.accepted for event in events] == [number + 1 not in (FIRST, SECOND) for number in range(8)]
