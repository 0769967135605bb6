"""How a picture is laid before a network."""

import cv2
import numpy as np
from pictures import textured

from edgevpr.techniques.card import InputRule
from edgevpr.techniques.session import prepare, without_masked


def rule(**changes):
    values = {"layout": "NCHW", "height": 12, "width": 16, "colour": "grey", "equalise": False, "resize": "linear"}
    return InputRule(**{**values, "scale": 1 / 255, "mean": [0.0], **changes})


def coloured(seed):
    return np.dstack([textured(seed), textured(seed + 10), textured(seed + 20)])


def test_calc_sees_the_picture_as_its_paper_says():
    image = coloured(1)
    it = rule(height=120, width=160, equalise=True, resize="cubic")
    yuv = cv2.cvtColor(image, cv2.COLOR_BGR2YUV)
    yuv[..., 0] = cv2.equalizeHist(yuv[..., 0].copy())
    grey = cv2.cvtColor(cv2.cvtColor(yuv, cv2.COLOR_YUV2BGR), cv2.COLOR_BGR2GRAY)
    expected = cv2.resize(grey, (160, 120), interpolation=cv2.INTER_CUBIC).astype(np.float32) / 255
    found = prepare(image, it)
    assert found.shape == (1, 1, 120, 160)
    assert found.dtype == np.float32
    np.testing.assert_allclose(found[0, 0], expected, atol=1e-6)


def test_colours_come_in_the_order_of_the_card():
    image = np.zeros((12, 16, 3), np.uint8)
    image[:] = (10, 20, 30)  # blue, green, red
    assert prepare(image, rule(colour="bgr", scale=1.0))[0, :, 0, 0].tolist() == [10, 20, 30]
    assert prepare(image, rule(colour="rgb", scale=1.0))[0, :, 0, 0].tolist() == [30, 20, 10]
    assert prepare(image[..., 0], rule(colour="rgb", scale=1.0))[0, :, 0, 0].tolist() == [10, 10, 10]


def test_scale_mean_and_deviation_in_this_order():
    image = np.full((12, 16, 3), 51, np.uint8)
    it = rule(colour="rgb", mean=[0.1, 0.2, 0.3], std=[0.5, 1.0, 2.0])
    np.testing.assert_allclose(prepare(image, it)[0, :, 5, 5], [0.2, 0.0, -0.05], atol=1e-6)


def test_masked_pixels_become_the_mean_of_the_others():
    image = coloured(3)
    mask = np.ones(image.shape[:2], bool)
    mask[:, 100:] = False
    filled = without_masked(image, mask)
    np.testing.assert_array_equal(filled[:, :100], image[:, :100])
    np.testing.assert_allclose(filled[0, 120], image[:, :100].reshape(-1, 3).mean(axis=0), atol=0.51)
    assert (filled[:, 100:] == filled[0, 120]).all()
    assert without_masked(image, None) is image
    assert (without_masked(image[..., 0], np.zeros(mask.shape, bool)) == 128).all()
