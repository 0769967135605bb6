"""Agreement: its signs are those of a match of `cohog`, and pictures of other ground do not agree."""

import cv2
import numpy as np
import pytest
from pictures import draw_rough_ground, draw_texture

from edgevpr.runtime.recognise import agreement
from edgevpr.runtime.recognise.landmarks import QUERY_LANDMARKS, detect_landmarks, pack_bytes, unpack_bytes
from edgevpr.techniques import create

WIDTH_PX = 640
HEIGHT_PX = 480


@pytest.fixture(scope="module")
def landscape():
    """Ground with patches of all sizes, from which pictures are cut."""
    return draw_rough_ground(1600)


def cut_picture(landscape, x, y, up_deg=0.0, scale=1.0):
    """A picture around (x, y) of the landscape, from a camera rotated clockwise by `up_deg`, `scale` times as high."""
    turn = np.deg2rad(up_deg)
    # A pixel right in the picture is one right in the landscape, turned clockwise with the camera.
    a, b = scale * np.cos(turn), scale * np.sin(turn)
    middle = (WIDTH_PX - 1) / 2, (HEIGHT_PX - 1) / 2
    shift = x - a * middle[0] + b * middle[1], y - b * middle[0] - a * middle[1]
    to_landscape = np.array([[a, -b, shift[0]], [b, a, shift[1]]], np.float64)
    return cv2.warpAffine(landscape, to_landscape, (WIDTH_PX, HEIGHT_PX), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)


def detect_query(image):
    return detect_landmarks(image, count=QUERY_LANDMARKS)


def detect_stored(image):
    return unpack_bytes(pack_bytes(detect_landmarks(image)))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("right_px", "down_px", "rotation_deg", "scale"),
    [(80, 0, 0, 1.0), (0, -60, 0, 1.0), (40, 30, 30, 1.0), (-50, 20, 315, 1.15), (10, -40, 180, 0.85)],
)
def test_measure_agreement_has_the_signs_of_a_cohog_match(landscape, right_px, down_px, rotation_deg, scale):
    """The query's middle lies right of the place's by `right_px`, and below it by `down_px`."""
    place = cut_picture(landscape, 800, 600)
    query = cut_picture(landscape, 800 + right_px, 600 + down_px, rotation_deg, scale)
    found = agreement.measure_agreement(detect_query(query), detect_stored(place))
    assert found.inliers >= agreement.MIN_PROVEN_INLIERS
    assert np.array(found.shift_share) * WIDTH_PX == pytest.approx((right_px, down_px), abs=2)
    assert abs((found.rotation_deg - rotation_deg + 180) % 360 - 180) < 1
    assert found.scale == pytest.approx(scale, rel=0.02)

    cohog = create("cohog", {"camera": "nadir"})
    match = cohog.match(cohog.encode(query), cohog.encode(place).fine)
    assert abs((match.rotation_deg - rotation_deg + 180) % 360 - 180) < 1
    assert np.array(match.shift_cells) / 32 == pytest.approx(found.shift_share, abs=1.5 / 32)

    expected = agreement.Overlay((match.shift_cells[0] / 32, match.shift_cells[1] / 32), match.rotation_deg)
    guided = agreement.compare_near(detect_query(query), detect_stored(place), expected)
    assert guided.is_expected
    assert guided.inliers >= agreement.MIN_PROVEN_INLIERS
    assert guided.shift_share == pytest.approx(found.shift_share, abs=0.005)


@pytest.mark.parametrize("seed", range(6))
def test_pictures_of_other_ground_do_not_agree(landscape, seed):
    other = draw_texture(100 + seed, HEIGHT_PX, WIDTH_PX)
    expected = agreement.Overlay((0.05 * (seed % 3), -0.05), 15.0 * seed)
    found = agreement.compare_near(detect_query(other), detect_stored(cut_picture(landscape, 800, 600)), expected)
    assert found.inliers < agreement.MIN_CONFIRMED_INLIERS
    assert found.is_expected
