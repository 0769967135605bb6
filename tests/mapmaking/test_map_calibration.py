"""MapCalibration of small maps: what they are asked, what is believed, and what the map keeps of it."""

from collections import Counter

import cv2
import numpy as np
import pytest
from pictures import draw_texture
from walks import make_map, query_meter

from edgevpr.core.config import load_config
from edgevpr.core.errors import UsageError
from edgevpr.core.text import iterate_silently
from edgevpr.core.types import Frame, Position
from edgevpr.frames.level import UNKNOWN_VIEW, Lens, LevelledImage
from edgevpr.mapmaking import calibrate as calibrating
from edgevpr.mapmaking.calibrate import LEFT_OUT, MIRRORED, THERE, calibrate, fit_logistic, query_map
from edgevpr.mapmaking.changes import change_picture
from edgevpr.mapmaking.look_alikes import MapSearch
from edgevpr.mapmaking.mapping import build_map
from edgevpr.places.mapfile import PlaceMap
from edgevpr.runtime.recognise.calibration import read_calibration
from edgevpr.runtime.recognise.confidence import Logistic
from edgevpr.runtime.recognise.encoder import FrameEncoder
from edgevpr.runtime.recognise.judge import make_accept_rule
from edgevpr.runtime.recognise.levelling import Levelling
from edgevpr.techniques import create

pytestmark = pytest.mark.slow

PLACES = 8
CONFIG = load_config(None).match
AHEAD = create("cohog", {"w1": 208})


def frame(number, **more):
    position = Position(50 + 0.002 * number, 8.0)
    return Frame(image=draw_texture(number, 240, 320), name=f"{number}.png", t_mono_s=0.0, position=position, **more)


def make_picture_source(*frames):
    """Give the frames of these names, and remember which were asked for."""
    asked = []

    def pictures(names):
        asked.extend(names)
        return [each for each in frames if each.name in names]

    return pictures, asked


@pytest.fixture(autouse=True)
def few_suffice(monkeypatch):
    """A map of few places is enough, and few questions."""
    monkeypatch.setattr(calibrating, "MIN_PLACES", PLACES)
    monkeypatch.setattr(calibrating, "count_queries", lambda technique: 2 * PLACES)


@pytest.fixture
def place_map(tmp_path):
    with PlaceMap.open_for_writing(make_map(tmp_path / "m.gpkg", AHEAD, map(frame, range(PLACES)))) as place_map:
        yield place_map


def calibrate_map(place_map, pictures, technique=AHEAD, **more):
    encoder = FrameEncoder(technique=technique, **more)
    return calibrate(encoder, place_map, CONFIG, query_meter(), pictures, iterate_silently)


def test_query_map_queries_each_image_in_three_ways(place_map):
    search = MapSearch(place_map, AHEAD, make_accept_rule(AHEAD, CONFIG), query_meter())
    pictures = [(number + 1, LevelledImage(frame(number).image, None, UNKNOWN_VIEW)) for number in range(3)]
    answers = list(query_map(search, [*pictures, (99, pictures[0][1])]))
    assert Counter(each.way for each in answers) == {THERE: 3, LEFT_OUT: 3, MIRRORED: 3}
    assert [each.place_id for each in answers] == [1, 1, 1, 2, 2, 2, 3, 3, 3]
    assert all(each.right for each in answers if each.way == THERE)
    assert not any(each.right for each in answers if each.way != THERE)
    assert list(query_map(search, pictures)) == answers


def test_calibration_is_stored_in_the_map(place_map):
    pictures, asked = make_picture_source(*map(frame, range(PLACES)))
    found = calibrate_map(place_map, pictures)
    assert read_calibration(place_map.calibration) == found
    assert sorted(asked) == sorted(3 * [f"{number}.png" for number in range(PLACES)]), "once for its look-alikes"
    assert sorted(found.look_alikes.places) == list(range(1, PLACES + 1))
    assert (found.asked, found.precision) == (2 * PLACES, CONFIG.accept_precision)
    assert sorted(found.recognisable) == list(range(1, PLACES + 1))
    assert list(found.models) == ["ahead", "ahead_proven"]
    assert 0 <= found.accepted <= 1


@pytest.mark.parametrize("count", [1, 2, PLACES - 1])
def test_calibration_of_few_places_keeps_the_default_models_and_knows_look_alikes(tmp_path, count):
    few = [frame(number) for number in range(count)]
    with PlaceMap.open_for_writing(make_map(tmp_path / "m.gpkg", AHEAD, few)) as place_map:
        with pytest.raises(UsageError, match=f"pictures of only {count - 1} places"):
            calibrate_map(place_map, make_picture_source(*few[1:])[0])
        found = calibrate_map(place_map, make_picture_source(*few)[0])
        assert make_accept_rule(AHEAD, CONFIG, 1, found).look_alikes == found.look_alikes
    assert (found.models, found.asked, found.accepted_wrong) == ({}, count, 0)
    assert len(found.look_alikes.places) == (count if count > 2 else 0), "the only other place is a neighbour"


def test_calibration_skips_an_unreadable_place(place_map):
    with place_map.transaction():
        place_map.db.execute("UPDATE places SET coarse = x'00' WHERE place_id = 3")
    build_map([frame(20)], FrameEncoder(technique=AHEAD), place_map)
    found = calibrate_map(place_map, make_picture_source(*map(frame, (*range(PLACES), 20)))[0])
    assert sorted(found.recognisable) == [1, 2, 4, 5, 6, 7, 8, 9]


def test_pictures_are_levelled_as_those_of_the_map(tmp_path, monkeypatch):
    monkeypatch.setattr(calibrating, "MIN_PLACES", 2)
    monkeypatch.setattr(calibrating, "count_queries", lambda technique: 2)
    down = create("cohog", {"camera": "nadir", "w1": 208})
    tilted = [frame(number, roll_deg=8.0, pitch_deg=-6.0, heading_deg=40.0, height_m=90.0) for number in range(PLACES)]

    def make_levelling():
        return Levelling(Lens(60.0), below=True, is_live=False)

    path = make_map(tmp_path / "m.gpkg", down, tilted, levelling=make_levelling())
    with PlaceMap.open_for_writing(path) as place_map:
        with pytest.raises(UsageError, match=" 0 places"):
            calibrate_map(place_map, make_picture_source(tilted[0])[0], down)
        found = calibrate_map(place_map, make_picture_source(*tilted)[0], down, levelling=make_levelling())
    assert (found.asked, len(found.recognisable)) == (2, 2)


@pytest.mark.parametrize(
    ("pitch_deg", "heading_deg", "left_out"), [(45.0, None, (0, 1)), (70.0, 40.0, (1, 0)), (45.0, 40.0, (0, 0))]
)
def test_build_map_counts_tilted_images_by_what_is_missing(tmp_path, pitch_deg, heading_deg, left_out):
    down = create("cohog", {"camera": "nadir", "w1": 208})
    path = make_map(tmp_path / "down.gpkg", down, [])
    pose = {"roll_deg": 0.0, "pitch_deg": pitch_deg, "heading_deg": heading_deg, "height_m": 90.0}
    encoder = FrameEncoder(technique=down, levelling=Levelling(Lens(60.0), below=True, is_live=False))
    with PlaceMap.open_for_writing(path) as place_map:
        result = build_map([frame(0, **pose)], encoder, place_map)
    assert (result.tilted, result.without_heading) == left_out
    assert result.added == 1 - sum(left_out)


def test_calibration_reports_a_map_that_looks_alike_everywhere(tmp_path):
    """Water: the same few faint waves on every picture."""
    waves = cv2.GaussianBlur(np.random.default_rng(1).normal(size=(240, 320)), (0, 0), 2)
    waves = cv2.normalize(waves, None, 90, 130, cv2.NORM_MINMAX)

    def draw_water(number):
        image = np.clip(waves + np.random.default_rng(number).normal(0, 2, (240, 320)), 0, 255).astype(np.uint8)
        return Frame(image=image, name=f"{number}.png", t_mono_s=0.0, position=Position(50 + 0.002 * number, 8.0))

    with PlaceMap.open_for_writing(make_map(tmp_path / "m.gpkg", AHEAD, map(draw_water, range(PLACES)))) as place_map:
        found = calibrate_map(place_map, make_picture_source(*map(draw_water, range(PLACES)))[0])
    assert found.looks_alike
    assert found.accepted < 0.3


START = Logistic(("a", "b"), (0.0, 0.0), (1.0, 2.0), 0.0)


def make_rows(count, seed=1):
    """Rows of which `a` tells whether they are right, and `b` nothing."""
    rng = np.random.default_rng(seed)
    right = rng.random(count) < 0.5
    return [{"a": float(is_right + rng.normal(0, 0.5)), "b": float(2 * rng.normal())} for is_right in right], right


def test_fit_logistic_weights_only_features_that_separate_the_classes():
    rows, right = make_rows(2000)
    found = fit_logistic(START, rows, right, np.ones(len(rows)), 1.0)
    # Two normal distributions, 1 apart with the variance 0.25: the logit is 4 (a - 0.5).
    assert found.weights == (pytest.approx(4, abs=0.5), pytest.approx(0, abs=0.15))
    assert found.bias == pytest.approx(-2, abs=0.4)
    assert (found.names, found.scales) == (START.names, START.scales)


def test_fit_logistic_with_a_strong_prior_changes_only_the_bias():
    rows, right = make_rows(200)
    start = fit_logistic(START, *make_rows(2000, seed=2), np.ones(2000), 1.0)
    found = fit_logistic(start, rows, np.zeros(len(right), bool), np.ones(len(rows)), 1e6)
    assert found.weights == pytest.approx(start.weights, abs=0.01)
    assert found.bias < start.bias - 1
    held = fit_logistic(start, rows, np.zeros(len(right), bool), np.ones(len(rows)), 1e6, bias_precision=1e6)
    assert held.bias == pytest.approx(start.bias, abs=0.01)


def test_change_picture_moves_the_mask_with_the_image():
    image = draw_texture(4)
    shown = np.zeros(image.shape, bool)
    shown[:, 80:] = True
    image = np.where(shown, 40 + image // 4, 190 + image // 4)

    def measure_contrast(picture, part):
        return abs(float(picture[part].mean()) - float(picture[~part].mean()))

    followed, left = [], []
    for seed in range(12):
        seen, now = change_picture(image, np.random.default_rng(seed), True, shown)
        assert (now.shape, now.dtype) == (image.shape, bool)
        followed.append(measure_contrast(seen, now))
        left.append(measure_contrast(seen, shown))
    assert np.mean(followed) > 1.5 * np.mean(left)
