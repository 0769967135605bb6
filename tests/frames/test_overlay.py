"""Learning an overlay mask from what stands still while the rest moves."""

import cv2
import numpy as np
import pytest

from edgevpr.core.errors import SourceError, UsageError
from edgevpr.frames.images import read_image
from edgevpr.frames.mask import FEWEST_FRAMES, learn_overlay, read_mask, require_png, write_mask

_NOISE = np.random.default_rng(1)
GROUND = sum(cv2.resize(_NOISE.random((side, 4 * side)), (1920, 480)) for side in (20, 40, 80))
GROUND = cv2.normalize(GROUND, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)
# The layout of a display: a cross, a frame, and figures that change.
CROSS = slice(95, 145), slice(135, 185)
BOX = slice(12, 68), slice(190, 310)
FIGURES = slice(195, 236), slice(12, 110)


def view(number, display=True):
    """A picture of a flight over the ground, 240 x 320."""
    picture = GROUND[37 * number % 200 :, 39 * number :][:240, :320].copy()
    if display:
        cv2.drawMarker(picture, (160, 120), 255, cv2.MARKER_CROSS, 30, 2)
        cv2.rectangle(picture, (200, 22), (300, 58), 255, 2)
        cv2.putText(picture, f"A{number:03d}", (22, 226), cv2.FONT_HERSHEY_SIMPLEX, 0.9, 0, 5)
        cv2.putText(picture, f"A{number:03d}", (22, 226), cv2.FONT_HERSHEY_SIMPLEX, 0.9, 255, 2)
    return picture


def test_what_stands_still_is_masked_and_the_ground_is_not():
    allowed = learn_overlay(map(view, range(40)), "here")
    for spot in (CROSS, BOX, FIGURES):
        assert (~allowed[spot]).mean() > 0.2
    assert not allowed[120, 150:170].any()
    assert not allowed[22, 205:295].any()
    rest = allowed.copy()
    for spot in (CROSS, BOX, FIGURES):
        rest[spot] = True
    assert rest.mean() > 0.99


def test_a_flight_without_a_display_needs_no_mask():
    assert learn_overlay((view(number, display=False) for number in range(40)), "here").mean() > 0.995


@pytest.mark.parametrize("noise", [0, 3])
def test_a_scene_that_stands_still_teaches_nothing(noise):
    rng = np.random.default_rng(1)
    still = view(3).astype(float)
    pictures = (np.clip(still + rng.normal(0, noise, still.shape), 0, 255).astype(np.uint8) for _ in range(40))
    with pytest.raises(SourceError, match=r"stands still"):
        learn_overlay(pictures, "video.mp4")


def test_blank_pictures_teach_nothing():
    with pytest.raises(SourceError, match="stands still"):
        learn_overlay((np.zeros((240, 320, 3), np.uint8) for _ in range(40)), "here")


@pytest.mark.parametrize("count", [0, 1, FEWEST_FRAMES - 1])
def test_too_few_pictures_teach_nothing(count):
    with pytest.raises(SourceError, match=f"{count} pictures"):
        learn_overlay(map(view, range(count)), "here")


def test_large_pictures_are_learnt_from_at_the_size_of_a_mask():
    large = (cv2.resize(view(number), None, fx=4, fy=4) for number in range(FEWEST_FRAMES))
    assert learn_overlay(large, "here").shape == (480, 640)


def test_a_mask_is_written_as_it_is_read(tmp_path):
    allowed = learn_overlay(map(view, range(40)), "here")
    write_mask(tmp_path / "m.png", allowed)
    assert np.array_equal(read_mask(tmp_path / "m.png").allowed, allowed)
    assert set(np.unique(read_image(tmp_path / "m.png"))) == {0, 255}
    with pytest.raises(UsageError, match=r"\.png"):
        require_png(tmp_path / "m.jpg")
