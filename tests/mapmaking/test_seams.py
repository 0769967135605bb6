"""Straight seams of a raster, where parts of another day meet."""

import cv2
import numpy as np
import pytest

from edgevpr.mapmaking.seams import WINDOW_PX, has_seam

ALL = np.ones((WINDOW_PX, WINDOW_PX), bool)


def ground(seed):
    """Blurred noise, roads, and roofs: edges as a camera sees them."""
    rng = np.random.default_rng(seed)
    image = cv2.GaussianBlur(rng.uniform(0, 255, (WINDOW_PX, WINDOW_PX, 3)).astype(np.float32), (0, 0), 6)
    image = 60 * (image - image.mean()) / image.std() + 125
    for _ in range(40):
        corner = rng.integers(0, WINDOW_PX, 2)
        cv2.rectangle(image, corner.tolist(), (corner + rng.integers(10, 60, 2)).tolist(), rng.uniform(0, 255, 3), -1)
    cv2.line(image, (100, 0), (140, WINDOW_PX), (230, 230, 230), 12)
    return np.uint8(np.clip(cv2.GaussianBlur(image, (0, 0), 0.9) + rng.normal(0, 2, image.shape), 0, 255))


def beyond(slope):
    """The part of a picture to the right of a line through its middle."""
    rows, columns = np.indices(ALL.shape)
    return columns > WINDOW_PX / 2 + slope * (rows - WINDOW_PX / 2)


@pytest.mark.parametrize("seed", range(4))
def test_edges_on_the_ground_are_no_seams(seed):
    assert not has_seam(ground(seed), ALL)


@pytest.mark.parametrize("slope", [0.0, 0.2, -0.2, 0.9])
def test_another_day_beyond_a_straight_line_is_a_seam_in_every_direction(slope):
    part = beyond(slope)[..., None]
    mosaic = np.where(part, ground(1), ground(0))
    brighter = np.where(part, np.uint8(np.minimum(1.5 * ground(0), 255)), ground(0))
    for image in (mosaic, brighter):
        assert has_seam(image, ALL)
        assert has_seam(np.ascontiguousarray(image.transpose(1, 0, 2)), ALL)


def test_parts_that_fade_into_each_other_are_not_seen():
    share = np.clip((np.indices(ALL.shape)[1] - WINDOW_PX / 2) / 20 + 0.5, 0, 1)[..., None]
    assert not has_seam(np.uint8(share * ground(1) + (1 - share) * ground(0)), ALL)


def test_the_edge_of_the_data_and_of_the_file_is_no_seam():
    image, valid = ground(0), ~beyond(0.2)
    image[~valid] = 0
    assert has_seam(image, ALL)
    assert not has_seam(image, valid)
    assert not has_seam(np.ascontiguousarray(ground(0)[:200, :300]), ALL[:200, :300])
