"""Strips that never change along one edge of the images are found, and only those."""

import cv2
import numpy as np
import pytest
from pictures import draw_rough_ground

from edgevpr.frames.sameness import StripCheck

GROUND = cv2.GaussianBlur(draw_rough_ground(1400), (0, 0), 2)


def find_strip(alter):
    check, reports = StripCheck(), []
    check.report = lambda reason: reports.append((reason.parameters["edge"], round(reason.parameters["width_px"], -1)))
    for along in range(0, 850, 50):
        check.add(alter(GROUND[along : along + 480, along // 2 : along // 2 + 640]))
    return check.offset, reports


@pytest.mark.parametrize("turns", range(4))
def test_strip_check_finds_the_edge_and_the_width_of_a_strip(turns):
    def join(image):
        bar = cv2.putText(np.zeros((480, 80), np.uint8), f"{image[9, 9]} m", (4, 99), 0, 0.5, 255)
        return np.ascontiguousarray(np.rot90(np.hstack([bar, image]), turns))

    edge = ("left", "bottom", "right", "top")[turns]
    assert find_strip(join) == (pytest.approx(40 / 720, abs=0.005), [(edge, 80)])


def test_strip_check_ignores_images_without_a_strip():
    assert find_strip(lambda image: image) == (0.0, [])
    assert find_strip(lambda image: (image * np.linspace(0, 1, 640)).astype(np.uint8)) == (0.0, [])  # no sharp end
    assert find_strip(lambda image: np.pad(image, ((0, 0), (60, 60)))) == (0.0, [])  # the middle stays the middle
    assert find_strip(lambda image: np.pad(GROUND[:480, :640], ((0, 0), (80, 0)))) == (0.0, [])  # a hover
