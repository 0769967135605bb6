"""Pictures that are not new: the one before again, and those patched from older ones."""

import cv2
import numpy as np
import pytest

from edgevpr.frames.shot import Refusal, RepeatDetector, make_thumbnail

HEIGHT = 240
WIDTH = 320
_NOISE = np.random.default_rng(3).normal(128, 400, (900, 1200))
GROUND = np.clip(128 + cv2.GaussianBlur(_NOISE - 128, (0, 0), 3), 0, 255).astype(np.uint8)


def draw_view(number):
    """What a camera sees that flies on."""
    return GROUND[2 * number : 2 * number + HEIGHT, 5 * number : 5 * number + WIDTH].copy()


def find_repeats(pictures):
    newness = RepeatDetector()
    return [newness.find_repeat(make_thumbnail(picture)) for picture in pictures]


NOISY = [
    np.clip(draw_view(0) + np.random.default_rng(seed).normal(0, 1.5, (HEIGHT, WIDTH)), 0, 255).astype(np.uint8)
    for seed in range(20)
]


@pytest.mark.parametrize("pictures", [[draw_view(number) for number in range(100)], NOISY], ids=["flight", "hover"])
def test_find_repeats_accepts_flight_images_and_noise_of_a_static_camera(pictures):
    assert find_repeats(pictures) == [None] * len(pictures)


def test_repeated_image_is_frozen_while_it_lasts():
    again = draw_view(1)
    again[::40, ::40] += 1  # a grey level here and there does not make a picture new
    found = find_repeats([draw_view(0), draw_view(1), *[again] * 20, draw_view(2)])
    assert found == [None, None, *[Refusal.FROZEN] * 20, None]


@pytest.mark.parametrize("behind", [1, 2, 4])
def test_find_repeats_detects_an_image_whose_lower_part_is_older(behind):
    flown = [draw_view(number) for number in range(40)]
    patched = [draw_view(number) for number in range(40, 90)]
    for picture in patched:
        picture[100:] = flown[-behind][100:]
    assert find_repeats([*flown, *patched, draw_view(91)])[40:] == [Refusal.PATCHED] * 50 + [None]


def test_find_repeats_ignores_static_parts_of_all_images():
    """A black border, a sky without a cloud, and the text of a display."""
    pictures = [draw_view(number) for number in range(80)]
    for picture in pictures:
        picture[:70], picture[220:] = 255, 0
        cv2.putText(picture, "ALT 120 BAT 14.8 AUTO", (5, 236), cv2.FONT_HERSHEY_SIMPLEX, 0.6, 255, 2)
    assert find_repeats(pictures) == [None] * 80


def test_find_repeats_accepts_motion_in_a_static_scene():
    """A camera on the ground without any noise, and somebody who walks through the picture."""
    pictures = [draw_view(0) for _ in range(60)]
    for number, picture in enumerate(pictures):
        picture[100:160, 4 * number : 4 * number + 40] = GROUND[500:560, 40:80]
    assert Refusal.PATCHED not in find_repeats(pictures)


def test_find_repeats_restarts_at_an_image_of_another_size():
    small = draw_view(0)[:96, :128]
    assert find_repeats([draw_view(0), small, small]) == [None, None, Refusal.FROZEN]
