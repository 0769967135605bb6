"""Landmarks: where they lie, what they are packed into, and pictures that have none."""

import numpy as np
import pytest
from pictures import draw_texture

from edgevpr.places.rows import MAX_LANDMARK_BYTES
from edgevpr.runtime.recognise.landmarks import (
    PLACE_LANDMARKS,
    QUERY_LANDMARKS,
    detect_landmarks,
    pack_bytes,
    unpack_bytes,
)


@pytest.fixture(scope="module")
def ground():
    return draw_texture(1, 480, 640)


def test_detect_landmarks_spreads_them_over_the_image_around_its_centre(ground):
    found = detect_landmarks(ground)
    assert 100 < len(found) <= PLACE_LANDMARKS < len(detect_landmarks(ground, count=QUERY_LANDMARKS))
    assert (np.abs(found.points) <= (0.5, 0.375)).all()
    for side in (found.points[:, 0] < 0, found.points[:, 0] > 0, found.points[:, 1] < 0, found.points[:, 1] > 0):
        assert np.mean(side) > 0.2
    at_px = found.points * 640 + (319.5, 239.5)
    assert len(np.unique(np.rint(at_px / 3), axis=0)) == len(found), "a corner counts once, on whatever level"


def test_detect_landmarks_is_independent_of_the_camera_resolution(ground):
    small = detect_landmarks(np.ascontiguousarray(ground.repeat(2, axis=0).repeat(2, axis=1)))
    one = {tuple(point) for point in np.rint(detect_landmarks(ground).points * 100).tolist()}
    other = {tuple(point) for point in np.rint(small.points * 100).tolist()}
    assert len(one & other) > 0.6 * len(one)


def test_detect_landmarks_avoids_masked_pixels(ground):
    mask = np.ones(ground.shape, bool)
    mask[:, 300:] = False
    found = detect_landmarks(ground, mask)
    assert len(found) > 30
    assert found.points[:, 0].max() * 640 + 319.5 < 300 - 15


def test_unpack_bytes_reverses_pack_bytes_within_the_size_of_a_place(ground):
    found = detect_landmarks(ground)
    blob = pack_bytes(found)
    assert len(blob) <= MAX_LANDMARK_BYTES
    again = unpack_bytes(blob)
    assert again.points == pytest.approx(found.points, abs=1e-5)
    assert again.size == pytest.approx(found.size, abs=6e-4)
    assert np.abs((again.angle_deg - found.angle_deg + 180) % 360 - 180).max() < 0.71
    assert (again.bits == found.bits).all()


@pytest.mark.parametrize(
    "spoil",
    [
        lambda blob: b"",
        lambda blob: blob[:2],
        lambda blob: blob[:-1],
        lambda blob: blob + b"x",
        lambda blob: b"\x09" + blob[1:],
    ],
    ids=["empty", "short header", "cut", "longer", "newer form"],
)
def test_unpack_bytes_refuses_damaged_landmarks(ground, spoil):
    with pytest.raises(ValueError, match="its landmarks"):
        unpack_bytes(spoil(pack_bytes(detect_landmarks(ground))))


@pytest.mark.parametrize(
    "image",
    [
        np.zeros((1, 1), np.uint8),
        np.zeros((1, 640), np.uint8),
        np.full((3, 2, 3), 255, np.uint8),
        np.full((480, 640), 127, np.uint8),
        np.zeros((480, 640, 3), np.uint8),
    ],
    ids=["one pixel", "a line", "tiny", "flat", "black"],
)
def test_detect_landmarks_finds_none_without_corners(image):
    found = detect_landmarks(image)
    assert (len(found), found.points.shape, found.bits.shape) == (0, (0, 2), (0, 32))
