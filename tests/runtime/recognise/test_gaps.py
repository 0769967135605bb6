"""Gaps: where nothing is memorable for long, the best frames are kept."""

from dataclasses import replace

import numpy as np
import pytest

from edgevpr.core.types import Frame, Position, Salience
from edgevpr.mapmaking.mapping import Gaps
from edgevpr.runtime.recognise.recognition import Recognition
from edgevpr.runtime.recognise.salience_gate import Worth

pytestmark = pytest.mark.slow

NORTH_M = 1 / 111_195  # degrees


def event(number, short_by=0.0, north_m=None):
    position = None if north_m is None else Position(50 + north_m * NORTH_M, 8.0)
    lacks = "entropy" if short_by else None
    return Recognition(
        frame=Frame(image=np.zeros((8, 8), np.uint8), name=str(number), t_mono_s=float(number), position=position),
        worth=Worth(Salience(None, None, 0.4 - short_by), short_by, lacks, lacks and "not memorable"),
    )


def kept(gaps, events):
    found = [pair for each in events for pair in gaps.take(each)]
    return [(int(each.frame.name), salience.is_low) for each, salience in [*found, *gaps.end()]]


def test_what_passes_is_kept_at_once_and_what_does_not_is_left_out():
    assert kept(Gaps(20), [event(0), event(1, 0.1), event(2), event(3, 0.1)]) == [(0, False), (2, False)]


@pytest.mark.parametrize("seed", range(5))
def test_no_gap_is_longer_than_the_bound_in_frames(seed):
    rng = np.random.default_rng(seed)
    events = [event(number, 0.0 if rng.random() < 0.02 else rng.uniform(0.001, 0.4)) for number in range(500)]
    numbers = [number for number, _ in kept(Gaps(20), events)]
    assert numbers == sorted(set(numbers))
    assert max(np.diff([-1, *numbers, 500])) <= 21  # twenty frames without a place between two with one
    assert len(numbers) < 150


@pytest.mark.parametrize("seed", range(5))
def test_no_gap_is_longer_than_the_bound_in_metres(seed):
    rng = np.random.default_rng(seed)
    where_m = np.cumsum(rng.uniform(1, 9, 300))
    events = [event(number, rng.uniform(0.001, 0.4), where) for number, where in enumerate(where_m)]
    places_m = [where_m[number] for number, _ in kept(Gaps(10_000, 40.0), events)]
    assert max(np.diff([where_m[0], *places_m])) <= 40.01


def test_the_best_of_a_gap_are_those_that_pass_after_the_fewest_steps_and_are_marked():
    events = [event(0), *(event(number, 0.2) for number in range(1, 21))]
    events[7], events[12] = event(7, 0.07), event(12, 0.08)
    assert kept(Gaps(20), [*events, event(21, 0.2)]) == [(0, False), (7, True), (12, True)]


def test_of_a_short_recording_in_which_nothing_passes_the_best_is_kept():
    assert kept(Gaps(20), [event(0, 0.2), event(1, 0.05), event(2, 0.3)]) == [(1, True)]


def test_without_a_gate_every_frame_is_kept():
    bare = replace(event(3), worth=None)
    assert list(Gaps(2).take(bare)) == [(bare, None)]
