"""The decoders of detectors against loops that say the same cell by cell, and boxes that were put in by hand."""

import math

import numpy as np
import pytest

from edgevpr.runtime.recognise.gate_networks import fastestdet, yolox

RNG = np.random.default_rng(3)


def sigmoid(x):
    return 1 / (1 + math.exp(-x))


def test_yolox_cell_by_cell():
    height, width, classes = 64, 96, 4
    strides = (8, 16, 32)
    count = sum((height // stride) * (width // stride) for stride in strides)
    raw = RNG.normal(0, 1, (1, count, 5 + classes)).astype(np.float32)
    boxes, scores = yolox([raw], (height, width))
    at = 0
    for stride in strides:
        for row in range(height // stride):
            for column in range(width // stride):
                x, y, w, h, thing, *named = raw[0, at]
                middle = ((x + column) * stride, (y + row) * stride)
                half = (math.exp(w) * stride / 2, math.exp(h) * stride / 2)
                wanted = [
                    (middle[0] - half[0]) / width,
                    (middle[1] - half[1]) / height,
                    (middle[0] + half[0]) / width,
                    (middle[1] + half[1]) / height,
                ]
                assert boxes[at] == pytest.approx(wanted, rel=1e-4, abs=1e-5)
                assert scores[at] == pytest.approx([thing * each for each in named], rel=1e-4)
                at += 1


def test_fastestdet_cell_by_cell():
    rows, columns, classes = 3, 5, 4
    raw = RNG.normal(0, 1, (1, 5 + classes, rows, columns)).astype(np.float32)
    raw[0, 0], raw[0, 5:] = RNG.random((rows, columns)), RNG.random((classes, rows, columns))
    boxes, scores = fastestdet([raw], (96, 160))
    for row in range(rows):
        for column in range(columns):
            thing, x, y, w, h, *named = raw[0, :, row, column].tolist()
            middle = ((column + math.tanh(x)) / columns, (row + math.tanh(y)) / rows)
            half = (sigmoid(w) / 2, sigmoid(h) / 2)
            at = row * columns + column
            wanted = [middle[0] - half[0], middle[1] - half[1], middle[0] + half[0], middle[1] + half[1]]
            assert boxes[at] == pytest.approx(wanted, rel=1e-4, abs=1e-5)
            assert scores[at] == pytest.approx([thing**0.6 * each**0.4 for each in named], rel=1e-4)
