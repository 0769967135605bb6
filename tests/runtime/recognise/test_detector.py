"""Staticity: boxes of detectors as a mask over the picture."""

import math

import numpy as np
import pytest

from edgevpr.runtime.recognise.gate_networks import Detector, decode_fastestdet
from edgevpr.techniques.card import load_card

pytest.importorskip("onnx", reason="the test networks are written with onnx (pip install onnx)")

from tiny_detectors import CELLS, write_detector

from edgevpr.core.errors import ModelError

PICTURE = np.full((128, 256), 90, np.uint8)


@pytest.fixture
def open_detector(models):
    def open_it(*args, **kwargs):
        write_detector(models, *args, **kwargs)
        return Detector(load_card("tiny"))

    return open_it


def test_is_static_masks_only_boxes_of_dynamic_classes(open_detector):
    static = open_detector([(16, 8, 32, 24, 2), (40, 40, 60, 60, 3)]).is_static(PICTURE)
    wanted = np.ones_like(static)
    wanted[16:48, 64:128] = False  # the picture is twice as high and four times as wide as the input
    assert np.array_equal(static, wanted)


def test_is_static_places_boxes_correctly_in_a_padded_image(open_detector):
    static = open_detector([(16, 8, 32, 24, 0)], pad=114).is_static(PICTURE)  # 64 x 32 of the input show the picture
    wanted = np.ones_like(static)
    wanted[32:96, 64:128] = False
    assert np.array_equal(static, wanted)


@pytest.mark.parametrize(
    ("raw", "complaint"),
    [
        (np.full((1, CELLS, 9), np.nan, np.float32), "not finite"),
        (np.zeros((1, CELLS, 6), np.float32), "`yolox`"),
        (np.zeros((1, 7, 9), np.float32), "`yolox`"),
    ],
)
def test_detector_that_cannot_be_used_is_refused_in_one_sentence(open_detector, raw, complaint):
    with pytest.raises(ModelError, match=complaint) as refused:
        open_detector(raw=raw)
    assert "\n" not in str(refused.value)


RNG = np.random.default_rng(3)


def sigmoid(x):
    return 1 / (1 + math.exp(-x))


def test_detector_decodes_fastestdet_cell_by_cell():
    rows, columns, classes = 3, 5, 4
    raw = RNG.normal(0, 1, (1, 5 + classes, rows, columns)).astype(np.float32)
    raw[0, 0], raw[0, 5:] = RNG.random((rows, columns)), RNG.random((classes, rows, columns))
    boxes, scores = decode_fastestdet([raw], (96, 160))
    for row in range(rows):
        for column in range(columns):
            thing, x, y, w, h, *named = raw[0, :, row, column].tolist()
            middle = ((column + math.tanh(x)) / columns, (row + math.tanh(y)) / rows)
            half = (sigmoid(w) / 2, sigmoid(h) / 2)
            at = row * columns + column
            wanted = [middle[0] - half[0], middle[1] - half[1], middle[0] + half[0], middle[1] + half[1]]
            assert boxes[at] == pytest.approx(wanted, rel=1e-4, abs=1e-5)
            assert scores[at] == pytest.approx([thing**0.6 * each**0.4 for each in named], rel=1e-4)
