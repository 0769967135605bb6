"""The walk of a frame: what it gives, and that no fault of a frame, a place or a technique leaves it."""

import shutil
from unittest.mock import Mock

import numpy as np
import pytest
from pictures import draw_texture
from walks import make_map, walk_over

from edgevpr.core.config import load_config
from edgevpr.core.errors import MapError, ModelError
from edgevpr.core.reasons import Reason, ReasonCode
from edgevpr.core.types import Frame, Pose, Position
from edgevpr.places.mapfile import PlaceMap
from edgevpr.runtime.recognise.decide import MatchSettings
from edgevpr.runtime.recognise.judge import AcceptRule
from edgevpr.runtime.recognise.recogniser import Recogniser
from edgevpr.techniques import create

PLACES = 6
RULE = AcceptRule(min_score=0.07, min_margin=0.06, neighbour_m=50.0)


def frame(number, t_mono_s=0.0):
    position = Position(50 + number * 0.001, 8.0)
    return Frame(image=draw_texture(number), name=f"{number}.png", t_mono_s=t_mono_s, position=position)


@pytest.fixture(scope="module")
def whole_map(tmp_path_factory):
    return make_map(tmp_path_factory.mktemp("map") / "m.gpkg", create("cohog", {"w1": 208}), map(frame, range(PLACES)))


@pytest.fixture
def walk(whole_map, tmp_path, clock):
    """A recogniser over six places, whose meter has a clock to turn."""
    settings = MatchSettings(candidates=42, min_accuracy_m=20.0)
    with PlaceMap.open(shutil.copy(whole_map, tmp_path)) as place_map:
        yield walk_over(place_map, create("cohog", {"w1": 208}), RULE, clock=clock, settings=settings)


def test_step_returns_a_complete_event_for_a_recognised_place(walk):
    event = walk.step(frame(3, 12.5))
    assert event.accepted
    assert not event.failed
    assert event.reason.code is ReasonCode.ACCEPTED_BY_SCORE
    assert (event.best.place.place_id, event.best.place.source_image) == (4, "3.png")
    assert event.position == Position(50.003, 8.0)
    assert event.accuracy_m == pytest.approx(111.2, abs=0.5), "half of the way to the next place nobody knows better"
    assert event.ranking.slots[0] == 3
    assert (event.hints, event.fix) == (None, None)
    assert event.frame.t_mono_s == 12.5
    assert event.descriptor.fine is not None


def test_step_meters_each_step(walk, clock):
    encode, scan, match = walk.technique.encode, walk.technique.score_places, walk.technique.match
    walk.technique.encode = lambda *asked: (clock.work(0.010), encode(*asked))[1]
    walk.technique.score_places = lambda *asked: (clock.work(0.020, 2.0), scan(*asked))[1]
    walk.technique.match = lambda *asked: (clock.work(0.001), match(*asked))[1]
    event = walk.step(frame(3))
    steps = event.steps
    assert [steps.encode.wall_s, steps.scan.wall_s, steps.compare.wall_s] == pytest.approx([0.010, 0.020, 0.006])
    assert [steps.encode.cpu_s, steps.scan.cpu_s, steps.compare.cpu_s] == pytest.approx([0.010, 0.040, 0.006])
    assert (event.cost.t_encode_s, event.cost.t_match_s) == pytest.approx((0.010, 0.026))
    assert event.cost.cpu_s == pytest.approx(0.056)


class LibraryError(Exception):
    """What a library may raise."""


@pytest.mark.parametrize(
    "error", [ModelError("no."), MapError("gone."), LibraryError("x"), MemoryError(), ZeroDivisionError()]
)
@pytest.mark.parametrize("where", ["encode", "score_places", "match"])
def test_step_refuses_with_the_reason_of_any_exception_of_a_technique(walk, error, where):
    whole = getattr(walk.technique, where)
    setattr(walk.technique, where, Mock(side_effect=error))
    event = walk.step(frame(1))
    assert (event.failed, event.accepted, event.position) == (True, False, None)
    assert event.is_query == (where != "encode")
    expected = {ModelError: ReasonCode.UNUSABLE, MapError: ReasonCode.MAP_UNREADABLE}
    assert event.reason.code is expected.get(type(error), ReasonCode.UNEXPECTED_ERROR)
    assert event.reason.parameters["problem"] == str(error)
    setattr(walk.technique, where, whole)
    assert walk.step(frame(1)).accepted, "the next frame is recognised"


def test_step_lets_a_stop_pass(walk):
    class Stop(BaseException):
        pass

    walk.technique.encode = Mock(side_effect=Stop)
    with pytest.raises(Stop):
        walk.step(frame(1))


def test_report_unread_returns_an_event_for_an_unreadable_frame(walk):
    event = walk.report_unread(ValueError("cut"))
    assert (event.frame, event.failed, event.is_query) == (None, True, False)
    assert event.reason == Reason(ReasonCode.UNEXPECTED_ERROR, {"error": "ValueError", "problem": "cut"})


def test_recogniser_never_claims_better_than_the_minimum_accuracy(walk):
    walk.index.lat_deg[:] = np.linspace(50.0, 50.00001, PLACES)
    settings = MatchSettings(min_accuracy_m=20.0)
    dense = Recogniser(walk.encoder, walk.place_map, walk.matcher, walk.meter, settings=settings)
    assert dense.accuracy_m == 20.0
    assert load_config(None).mavlink.min_accuracy_m == 5.0


def test_step_ignores_places_of_the_same_ground_as_rivals(tmp_path):
    """A place 60 m on is beyond `neighbour_m`, and half of its ground is the same."""
    technique, ground, side_px = create("cohog", {"camera": "nadir"}), draw_texture(9, 256, 2048), 256
    pose = Pose(up_deg=0.0, footprint_m=128.0, covariance_m2=(1.0, 0.0, 1.0))

    def cut(east_m):
        at = Position(50.0, 8.0 + east_m / (111_195 * np.cos(np.radians(50.0))))
        image = np.ascontiguousarray(ground[:, 2 * east_m : 2 * east_m + side_px])
        return Frame(image=image, name=f"{east_m}", t_mono_s=0.0, position=at, heading_deg=0.0, pose=pose)

    with PlaceMap.open(make_map(tmp_path / "dense.gpkg", technique, map(cut, range(0, 880, 20)))) as place_map:
        event = walk_over(place_map, technique, RULE, settings=MatchSettings(candidates=8)).step(cut(400))
    away_m = 20.0 * abs(np.array(event.ranking.compared_slots) - event.ranking.compared_slots[0])
    assert (away_m > 140).sum() >= 3
