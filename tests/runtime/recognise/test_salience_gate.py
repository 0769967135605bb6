"""The three scores, what passes the gate, and gaps: where nothing is memorable for long, the best frames are kept."""

from dataclasses import replace

import numpy as np
import pytest

from edgevpr.core.config import load_config
from edgevpr.core.contract import Descriptor
from edgevpr.core.types import Frame, Position, Salience
from edgevpr.frames.images import cv2
from edgevpr.frames.level import UNKNOWN_VIEW, LevelledImage
from edgevpr.mapmaking.mapping import PlaceSelector
from edgevpr.runtime.recognise.encoder import EncodedFrame
from edgevpr.runtime.recognise.gate_networks import interpolate_map
from edgevpr.runtime.recognise.salience_gate import SalienceGate, SalienceVerdict, compute_scores, judge_scores
from edgevpr.techniques.entropy import compute_filled_bins

RNG = np.random.default_rng(5)


def make_config(memorability=0.0, staticity=0.0, entropy=0.0, **keys):
    thresholds = {"memorability": memorability, "staticity": staticity, "entropy": entropy}
    return replace(load_config(None).salience, **thresholds, **keys)


class HalfMemorable:
    """A network that finds the left of a picture memorable."""

    def compute_matrix(self, image):
        return np.repeat(np.array([[1.0, 1.0, 0.5, 0.0, 0.0]], np.float32), 5, axis=0)


def draw_texture(height=120, width=160, spread=40.0, middle=128.0):
    fine = cv2.GaussianBlur(RNG.normal(0, 1, (height, width)), (0, 0), 1.5)
    return np.clip(middle + spread * fine / fine.std(), 0, 255).astype(np.uint8)


def test_compute_scores_averages_the_whole_picture_with_masked_pixels_as_zero():
    picture = draw_texture()
    static = np.ones(picture.shape, bool)
    static[:, 120:] = False
    scores = compute_scores(picture, HalfMemorable(), static)
    assert scores.staticity == pytest.approx(0.75)
    memorable = interpolate_map(HalfMemorable().compute_matrix(picture), picture.shape)
    assert scores.memorability == pytest.approx(memorable[:, :120].sum() / picture.size, abs=1e-6)
    assert scores.entropy == pytest.approx(compute_filled_bins(picture)[:, :120].sum() / picture.size, abs=1e-6)
    alone = compute_scores(picture)
    assert (alone.memorability, alone.staticity) == (None, None)
    assert alone.entropy > scores.entropy


@pytest.mark.parametrize(
    ("thresholds", "lacks"),
    [
        (make_config(0.5, 0.6, 0.4), None),
        (make_config(0.51, 0.6, 0.4), "memorability"),
        (make_config(0.5, 0.95, 0.4), "staticity"),
        (make_config(0.5, 0.6, 0.7), "entropy"),
        (make_config(0.51, 0.95, 0.7), "entropy"),  # the one that is farthest below
        (make_config(0, 0, 0), None),
    ],
)
def test_judge_scores_requires_all_enabled_criteria(thresholds, lacks):
    worth = judge_scores(Salience(0.5, 0.9, 0.5), thresholds)
    assert worth.criterion == lacks
    assert (worth.reason is None) == (lacks is None) == (worth.shortfall == 0)


def test_judge_scores_ignores_a_score_that_was_not_computed():
    assert judge_scores(Salience(None, None, 0.5), make_config(0.9, 0.9, 0.4)).reason is None


def test_salience_gate_requires_less_entropy_in_bad_light():
    day = [draw_texture() for _ in range(40)]
    night = [(picture * 0.04).astype(np.uint8) for picture in day]
    by_day, at_night = SalienceGate(make_config(entropy=0.4)), SalienceGate(make_config(entropy=0.4))
    assert all(by_day.judge(picture).reason is None for picture in day)
    assert sum([at_night.judge(picture).reason is None for picture in night]) >= 36
    assert at_night.judge(np.full((120, 160), 3, np.uint8)).criterion == "entropy"


def test_salience_gate_halves_the_threshold_until_the_light_is_known():
    gate = SalienceGate(make_config(entropy=0.4))
    little = draw_texture()
    while not 0.2 < compute_scores(little).entropy < 0.4:
        little = (little * 0.8).astype(np.uint8)
    assert [gate.judge(little).reason for _ in range(4)] == [None] * 4
    assert all(gate.judge(np.full((120, 160), 3, np.uint8)).criterion == "entropy" for _ in range(3))


def test_salience_gate_does_not_adapt_to_a_long_stretch_without_information():
    gate = SalienceGate(make_config(entropy=0.4))
    for _ in range(30):
        assert gate.judge(draw_texture()).reason is None
    empty = np.full((120, 160), 77, np.uint8)
    assert all(gate.judge(empty).criterion == "entropy" for _ in range(70))


def test_salience_gate_runs_the_detector_on_every_kth_frame():
    class Counting:
        looks = 0

        def is_static(self, image):
            self.looks += 1
            return np.ones(image.shape[:2], bool)

    detector = Counting()
    gate = SalienceGate(make_config(staticity=0.6, detect_every=4), detector=detector)
    for _ in range(9):
        gate.judge(draw_texture())
    assert detector.looks == 3
    gate.judge(draw_texture(60, 80))  # of another size: what was found does not fit it
    assert detector.looks == 4


NORTH_M = 1 / 111_195  # degrees


def make_event(number, shortfall=0.0, north_m=None):
    position = None if north_m is None else Position(50 + north_m * NORTH_M, 8.0)
    lacks = "entropy" if shortfall else None
    image = np.zeros((8, 8), np.uint8)
    return EncodedFrame(
        frame=Frame(image=image, name=str(number), t_mono_s=float(number), position=position),
        picture=LevelledImage(image, None, UNKNOWN_VIEW),
        descriptor=Descriptor(coarse=np.zeros(1)),
        salience=SalienceVerdict(Salience(None, None, 0.4 - shortfall), shortfall, lacks, lacks and "not memorable"),
    )


def list_kept(gaps, events):
    found = [pair for each in events for pair in gaps.add_frame(each)]
    return [(int(each.frame.name), salience.is_low) for each, salience in [*found, *gaps.end()]]


@pytest.mark.parametrize("seed", range(5))
def test_place_selector_limits_gaps_in_frames(seed):
    rng = np.random.default_rng(seed)
    events = [make_event(number, 0.0 if rng.random() < 0.02 else rng.uniform(0.001, 0.4)) for number in range(500)]
    numbers = [number for number, _ in list_kept(PlaceSelector(20), events)]
    assert numbers == sorted(set(numbers))
    assert max(np.diff([-1, *numbers, 500])) <= 21  # twenty frames without a place between two with one
    assert len(numbers) < 150


@pytest.mark.parametrize("seed", range(5))
def test_place_selector_limits_gaps_in_metres(seed):
    rng = np.random.default_rng(seed)
    where_m = np.cumsum(rng.uniform(1, 9, 300))
    events = [make_event(number, rng.uniform(0.001, 0.4), where) for number, where in enumerate(where_m)]
    places_m = [where_m[number] for number, _ in list_kept(PlaceSelector(10_000, 40.0), events)]
    assert max(np.diff([where_m[0], *places_m])) <= 40.01


def test_place_selector_marks_the_best_frames_kept_to_limit_a_gap():
    events = [make_event(0), *(make_event(number, 0.2) for number in range(1, 21))]
    events[7], events[12] = make_event(7, 0.07), make_event(12, 0.08)
    assert list_kept(PlaceSelector(20), [*events, make_event(21, 0.2)]) == [(0, False), (7, True), (12, True)]
