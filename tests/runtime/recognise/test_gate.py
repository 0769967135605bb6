"""A picture that says nothing is refused before anything is searched for, and nothing made of nothing is accepted."""

from itertools import islice

import cv2
import numpy as np
import pytest
import unreal_pictures
from pictures import draw_texture
from walks import make_map

from edgevpr.core.config import load_config
from edgevpr.core.reasons import ReasonCode
from edgevpr.core.types import NO_COST, Frame
from edgevpr.power.boards import load_board
from edgevpr.runtime.recognise.opening import open_recogniser
from edgevpr.techniques import create

pytestmark = pytest.mark.slow

PLACES = 6


def frame(image, name="x"):
    return Frame(image=image, name=name, t_mono_s=0.0)


@pytest.fixture(scope="module", params=["forward", "nadir"])
def walk(request, tmp_path_factory):
    """A recogniser of six places, as a flight opens it."""
    path = tmp_path_factory.mktemp("map") / "m.gpkg"
    config, board = load_config(None, {"map": str(path), "source.camera": request.param}), load_board("this")
    frames = (frame(draw_texture(number, 240, 320), f"{number}.png") for number in range(PLACES))
    make_map(path, create("cohog", {"camera": request.param}), frames)
    recogniser = open_recogniser(config, board)
    with recogniser.place_map:
        yield recogniser


def test_step_does_not_search_images_without_information(walk):
    picture = np.full((480, 640, 3), (180, 0, 0), np.uint8)
    cv2.putText(picture, "NO SIGNAL", (150, 260), cv2.FONT_HERSHEY_SIMPLEX, 2, (255, 255, 255), 3)
    event = walk.step(frame(picture))
    assert (event.lacks_texture, event.accepted, event.failed, event.is_query) == (True, False, False, True)
    assert (event.position, event.best, event.ranking) == (None, None, None)
    assert event.reason.code is ReasonCode.LOW_TEXTURE
    assert event.reason.parameters["min_share"] == 0.4
    assert event.steps.scan == event.steps.compare == NO_COST, "the search is saved"
    after = walk.step(frame(draw_texture(3, 240, 320)))
    assert (after.accepted, after.lacks_texture, after.best.place.source_image) == (True, False, "3.png")


def test_step_accepts_no_image_of_an_unreal_scene(walk):
    kinds = unreal_pictures.yield_pictures(seed=9000, count=23)
    for kind, picture in islice(kinds, 0, None, 2 if walk.technique.spec.parameters["camera"] == "nadir" else 1):
        event = walk.step(frame(picture, kind))
        assert not event.accepted, f"{kind}: {event.reason}"


def test_step_accepts_only_the_correct_place_for_a_mostly_hidden_image(walk):
    recognised = 0
    for kind, picture in unreal_pictures.yield_spoilt(9002, draw_texture(2, 240, 320)):
        event = walk.step(frame(picture, kind))
        assert not event.accepted or event.best.place.source_image == "2.png", kind
        recognised += event.accepted
    assert recognised > 0, "what is left is often enough"
