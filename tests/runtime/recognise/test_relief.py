"""The variation of the height of the ground, and what it adds to a position from a tilted image."""

import math

import numpy as np
import pytest

from edgevpr.frames.level import View
from edgevpr.runtime.recognise.relief import UNKNOWN_HEIGHT_SD, Relief, compute_nadir_sd


def compute_relief(ratios, is_one_place=False):
    relief = Relief()
    for number, ratio in enumerate(ratios):
        relief.add(ratio, 0 if is_one_place else number)
    return relief


@pytest.mark.parametrize("reported", [1.0, 0.4])
def test_relief_is_the_scatter_of_heights_at_any_reported_height(reported):
    rng = np.random.default_rng(1)
    flat, hills = (compute_relief(reported * np.exp(rng.normal(0, sd, 80))) for sd in (0.01, 0.2))
    assert flat.height_sd < 0.05
    assert 0.2 < hills.height_sd < 0.45


def test_relief_is_unknown_before_matches_of_different_places():
    assert Relief().height_sd == UNKNOWN_HEIGHT_SD
    assert compute_relief([1.0]).height_sd == pytest.approx(UNKNOWN_HEIGHT_SD)
    assert compute_relief([1.0] * 50, is_one_place=True).height_sd == pytest.approx(UNKNOWN_HEIGHT_SD)


@pytest.mark.parametrize(("tilt_deg", "height_sd", "expected"), [(45, 0.1, 0.08), (45, 0.0, 0.0), (10, 0.1, 0.0)])
def test_compute_nadir_sd_adds_the_relief_beyond_20_degrees(tilt_deg, height_sd, expected):
    view = View(nadir_offset=(0.0, 0.8 * math.tan(math.radians(tilt_deg))), nadir_offset_sd=0.02, focal=0.8)
    assert compute_nadir_sd(view, height_sd) == pytest.approx(math.hypot(0.02, expected))
