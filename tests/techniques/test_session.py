"""Networks that work, and one sentence for each that does not: none of them may fly."""

import subprocess
import sys

import cv2
import numpy as np
import pytest
from pictures import draw_texture
from tiny_networks import CARD, FEATURES, HEIGHT, WIDTH, write_network

from edgevpr.core.errors import ModelError, UsageError
from edgevpr.techniques.card import InputRule
from edgevpr.techniques.session import fill_masked, open_backbone, prepare_input


def test_run_returns_both_outputs_with_their_shapes(models):
    write_network(models)
    features, descriptor = open_backbone("tiny", "features"), open_backbone("tiny", "descriptor")
    assert (features.shape, descriptor.shape) == (FEATURES, (16,))
    image = draw_texture(1)
    found = features.run(image)
    assert found.dtype == np.float32
    pooled = found.reshape(4, 2, 5, 2, 7).mean(axis=(2, 4))
    np.testing.assert_allclose(descriptor.run(image), pooled.ravel(), rtol=1e-5)
    assert len(features.sha256) == 64
    assert features.sha256 == descriptor.sha256 != features.card.sha256


def test_open_backbone_accepts_any_batch_size(models):
    write_network(models, fault="dynamic batch")
    assert open_backbone("tiny", "features").shape == FEATURES


@pytest.mark.parametrize(
    ("fault", "says"),
    [
        ("no onnx", "an ONNX model"),
        ("weights outside", "embedded weights"),
        ("other size", r"Got: 32 Expected: 40"),
        ("nan", "finite.* `features`"),
        ("zeros", "zeros .*`features`"),
    ],
)
def test_open_backbone_refuses_an_unsuitable_file_in_one_sentence(models, monkeypatch, fault, says):
    write_network(models, fault=fault)
    monkeypatch.chdir(models)  # where weights in a second file would be found
    with pytest.raises(ModelError, match=says) as raised:
        open_backbone("tiny", "features")
    assert str(raised.value).startswith(str(models / "tiny.onnx"))
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("card", "output", "says"),
    [
        ({"outputs": {"features": "conv5"}}, "features", "conv5"),
        ({"outputs": {"features": "descriptor"}}, "features", r"is \(1, 16\), but `features` must be \(1, C, H, W\)"),
        ({"outputs": {"descriptor": "features"}}, "descriptor", r"is \(1, 4, 10, 14\), but .* must be \(1, D\)"),
        ({"outputs": {"features": "features"}}, "descriptor", "no output .*`descriptor`"),
        ({"input": {**CARD["input"], "colour": "rgb"}}, "features", r"Got: 3 Expected: 1"),
        ({"sha256": "0" * 64}, "features", "SHA-256 .*[0-9a-f]{64}.* 0{64}"),
        ({"file": "gone.onnx"}, "features", "gone.onnx"),
    ],
)
def test_open_backbone_refuses_a_card_that_does_not_fit_its_file_in_one_sentence(models, card, output, says):
    write_network(models, card=card)
    with pytest.raises(ModelError, match=says):
        open_backbone("tiny", output)


def test_run_refuses_an_image_with_invalid_output(models):
    write_network(models)
    backbone = open_backbone("tiny", "features")
    for value, says in ((np.inf, "not finite"), (1e30, r"beyond 1e\+12"), (0, "zeros")):  # 1e30: of infinite length
        backbone.session = FakeSession(np.full((1, *FEATURES), value, np.float32))
        with pytest.raises(ModelError, match=says):
            backbone.run(draw_texture(1))


class FakeSession:
    """Gives the same whatever it is asked, as a network on the ground cannot be made to."""

    def __init__(self, result):
        self._result = result

    def get_inputs(self):
        return [type("Input", (), {"name": "picture"})]

    def run(self, names, feed):
        assert feed["picture"].shape == (1, 1, HEIGHT, WIDTH)
        return [self._result]


@pytest.mark.parametrize("threads", [-3, 0, 1000])
def test_open_backbone_refuses_an_invalid_number_of_threads(models, threads):
    write_network(models)
    with pytest.raises(UsageError, match=f"threads={threads}"):
        open_backbone("tiny", "features", threads)


FAULTY_CARDS = """
import sys
sys.modules["onnxruntime"] = None  # what an import of a broken one does
from edgevpr import techniques
for name in ("hog", "cohog", "seqslam"):
    techniques.create(name)
try:
    techniques.create("calc", {"model": "tiny"})
except techniques.EdgevprError as error:
    print(error)
"""


@pytest.mark.process
def test_techniques_without_networks_need_no_onnxruntime(models):
    write_network(models)
    done = subprocess.run([sys.executable, "-c", FAULTY_CARDS], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("onnxruntime ")
    assert all(name in done.stdout for name in ("hog", "cohog", "seqslam"))
    assert done.stdout.count("\n") == 1


def make_rule(**changes):
    values = {"layout": "NCHW", "height": 12, "width": 16, "colour": "grey", "equalise": False, "resize": "linear"}
    return InputRule(**{**values, "scale": 1 / 255, "mean": [0.0], **changes})


def draw_colour_picture(seed):
    return np.dstack([draw_texture(seed), draw_texture(seed + 10), draw_texture(seed + 20)])


def test_calc_prepares_images_as_in_its_paper():
    image = draw_colour_picture(1)
    it = make_rule(height=120, width=160, equalise=True, resize="cubic")
    yuv = cv2.cvtColor(image, cv2.COLOR_BGR2YUV)
    yuv[..., 0] = cv2.equalizeHist(yuv[..., 0].copy())
    grey = cv2.cvtColor(cv2.cvtColor(yuv, cv2.COLOR_YUV2BGR), cv2.COLOR_BGR2GRAY)
    expected = cv2.resize(grey, (160, 120), interpolation=cv2.INTER_CUBIC).astype(np.float32) / 255
    found = prepare_input(image, it)
    assert found.shape == (1, 1, 120, 160)
    assert found.dtype == np.float32
    np.testing.assert_allclose(found[0, 0], expected, atol=1e-6)


def test_run_orders_colours_as_in_the_card():
    image = np.zeros((12, 16, 3), np.uint8)
    image[:] = (10, 20, 30)  # blue, green, red
    assert prepare_input(image, make_rule(colour="bgr", scale=1.0))[0, :, 0, 0].tolist() == [10, 20, 30]
    assert prepare_input(image, make_rule(colour="rgb", scale=1.0))[0, :, 0, 0].tolist() == [30, 20, 10]
    assert prepare_input(image[..., 0], make_rule(colour="rgb", scale=1.0))[0, :, 0, 0].tolist() == [10, 10, 10]


def test_prepare_input_applies_scale_mean_and_deviation_in_this_order():
    image = np.full((12, 16, 3), 51, np.uint8)
    it = make_rule(colour="rgb", mean=[0.1, 0.2, 0.3], std=[0.5, 1.0, 2.0])
    np.testing.assert_allclose(prepare_input(image, it)[0, :, 5, 5], [0.2, 0.0, -0.05], atol=1e-6)


def test_run_replaces_masked_pixels_by_the_mean_of_the_others():
    image = draw_colour_picture(3)
    mask = np.ones(image.shape[:2], bool)
    mask[:, 100:] = False
    filled = fill_masked(image, mask)
    np.testing.assert_array_equal(filled[:, :100], image[:, :100])
    np.testing.assert_allclose(filled[0, 120], image[:, :100].reshape(-1, 3).mean(axis=0), atol=0.51)
    assert (filled[:, 100:] == filled[0, 120]).all()
    assert fill_masked(image, None) is image
    assert (fill_masked(image[..., 0], np.zeros(mask.shape, bool)) == 128).all()
