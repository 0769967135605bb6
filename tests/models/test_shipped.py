"""What lies in models/: files as their cards say, small enough for the wheel, and working without PyTorch."""

import hashlib

import cv2
import numpy as np
import onnxruntime
import pytest

from edgevpr.core.config import load_config
from edgevpr.core.files import shipped
from edgevpr.runtime.recognise.gate_networks import Memorability
from edgevpr.techniques.card import load_card
from edgevpr.techniques.session import open_backbone
from edgevpr.techniques.words import load_words

MODELS = shipped("models")


@pytest.fixture(autouse=True)
def shipped_alone(tmp_path, monkeypatch):
    monkeypatch.setenv("EDGEVPR_MODELS", str(tmp_path))


def noise(seed=0):
    return np.random.default_rng(seed).integers(0, 256, (240, 320, 3), np.uint8)


def test_the_card_is_of_the_file():
    card = load_card("calc")
    assert card.path.parent == MODELS
    assert hashlib.sha256(card.file_path.read_bytes()).hexdigest() == card.sha256
    assert card.licence == "MIT"
    assert "train_calc.py" in card.source


def test_the_file_has_fixed_shapes_and_two_outputs():
    session = onnxruntime.InferenceSession(str(MODELS / "calc.onnx"), providers=["CPUExecutionProvider"])
    assert [(each.name, each.shape) for each in session.get_inputs()] == [("image", [1, 1, 120, 160])]
    assert {each.name: each.shape for each in session.get_outputs()} == {
        "descriptor": [1, 1064],
        "features": [1, 128, 16, 21],
    }


def test_the_descriptor_is_of_length_one_and_tells_pictures_apart():
    backbone = open_backbone("calc", "descriptor")
    first, again, other = (backbone.run(noise(seed)) for seed in (1, 1, 2))
    assert np.linalg.norm(first) == pytest.approx(1, abs=1e-5)
    np.testing.assert_array_equal(first, again)
    assert first @ other < 0.99
    assert first.min() >= 0  # after the last rectifier


def test_feature_maps_speak_here_and_there():
    """Regions are made of activations that touch: a channel that is above zero everywhere has but one."""
    backbone = open_backbone("calc", "features")
    pictures = [cv2.resize(noise(seed)[:24, :32], (320, 240), interpolation=cv2.INTER_CUBIC) for seed in range(4)]
    active = np.mean([backbone.run(picture) > 0 for picture in pictures], axis=(0, 2, 3))
    assert (active > 0).mean() > 0.9
    assert active.mean() < 0.5


@pytest.mark.parametrize(("kind", "count"), [("vlad", 64), ("regions", 256), ("bow", 10_000)])
def test_the_words_of_the_defaults_are_there(kind, count):
    words, _ = load_words("calc", kind, count)
    assert words.shape == (count, 128)
    lengths = np.linalg.norm(words, axis=1)
    assert lengths.min() > 0.2  # means of vectors of length 1
    assert lengths.max() < 1.02


def test_all_of_it_fits_the_wheel():
    assert (MODELS / "calc.onnx").stat().st_size < 2_000_000
    assert sum(path.stat().st_size for path in MODELS.rglob("*") if path.is_file()) < 4_200_000


def test_matchability_keeps_a_picture_and_leaves_it_out_in_the_dark_in_fog_and_where_there_is_nothing():
    card = load_card("matchability")
    assert "matchability.py" in card.source
    assert card.file_path.stat().st_size < 1_000_000
    network = Memorability(card)
    ground = cv2.GaussianBlur(np.random.default_rng(1).normal(0, 1, (480, 640)), (0, 0), 2)
    ground = np.clip(128 + 45 * ground / ground.std(), 0, 255)

    def worth(picture):
        seen = picture + np.random.default_rng(2).normal(0, 6, picture.shape)  # by a sensor
        return network.matrix(np.clip(seen, 0, 255).astype(np.uint8)).mean()

    least = load_config(None).salience.memorability
    assert worth(ground) > least
    for spoilt in (0.04 * ground, 200 + 0.05 * (ground - 128), np.full_like(ground, 90)):
        assert worth(spoilt) < least
