"""An offset that all images have from their recorded positions, in the direction of the camera."""

import numpy as np
import pytest

from edgevpr.mapmaking.offset import find_common_offset

FOOTPRINT_M = 100.0
SPACING_M = 25.0


def make_lines(*courses, images=10):
    """The centres of images on parallel lines, and their directions: complex (N,) each."""
    along = SPACING_M * (np.arange(images) - images / 2)
    centre = [along * course + 1j * 50 * line * course for line, course in enumerate(courses)]
    return np.concatenate(centre), np.repeat(np.array(courses, complex), images)


def make_noise(sd_m, count):
    east_m, north_m = np.random.default_rng(1).normal(0, sd_m, (2, count))
    return east_m + 1j * north_m


@pytest.mark.parametrize("offset", [0.2, 0.2j, -0.15 + 0.1j], ids=["ahead", "beside", "behind"])
@pytest.mark.parametrize("is_level", [False, True], ids=["as taken", "north-up"])
@pytest.mark.parametrize("courses", [(1, -1), (1j, -1j, 1j), (1, 1j)], ids=["there and back", "three", "across"])
def test_find_common_offset_finds_that_of_the_camera(courses, is_level, offset):
    centre, course = make_lines(*courses)
    recorded = centre + FOOTPRINT_M * offset * course + make_noise(2.0, len(centre))
    log = np.log(FOOTPRINT_M) + (np.zeros_like(course) if is_level else np.log(course) + 0.7j)
    assert find_common_offset(recorded, centre, log) == pytest.approx(abs(offset), abs=0.03)


@pytest.mark.parametrize(
    ("courses", "offset", "noise_m"),
    [((1, 1), 0.3, 2.0), ((1, -1), 0.05, 2.0), ((1, -1), 0.0, 20.0), ((1, -1), 0.15, 40.0)],
    ids=["one way", "late by half a second", "scatter", "offset below the scatter"],
)
def test_find_common_offset_is_zero_if_none_is_clear(courses, offset, noise_m):
    centre, course = make_lines(*courses)
    recorded = centre + FOOTPRINT_M * offset * course + make_noise(noise_m, len(centre))
    assert find_common_offset(recorded, centre, np.log(FOOTPRINT_M) + np.log(course)) == 0.0


def test_find_common_offset_is_zero_for_few_places():
    centre, course = make_lines(1, -1, images=3)
    assert find_common_offset(centre + 20 * course, centre, np.log(FOOTPRINT_M) + np.log(course)) == 0.0
    empty = np.zeros(0, complex)
    assert find_common_offset(empty, empty, empty) == 0.0
