"""What lies in models/: files as their cards say, small enough for the wheel, and working without PyTorch."""

import hashlib

import cv2
import numpy as np
import pytest

from edgevpr.core.config import load_config
from edgevpr.core.files import find_shipped
from edgevpr.runtime.recognise.gate_networks import Memorability
from edgevpr.techniques.card import load_card

pytestmark = pytest.mark.usefixtures("models")

MODELS = find_shipped("models")


def test_card_is_of_its_file():
    card = load_card("calc")
    assert card.path.parent == MODELS
    assert hashlib.sha256(card.file_path.read_bytes()).hexdigest() == card.sha256
    assert card.licence == "MIT"
    assert "train_calc.py" in card.source


def test_models_fit_the_wheel():
    assert (MODELS / "calc.onnx").stat().st_size < 2_000_000
    assert sum(path.stat().st_size for path in MODELS.rglob("*") if path.is_file()) < 4_200_000


def test_matchability_keeps_an_image_but_not_darkness_fog_or_blank_images():
    card = load_card("matchability")
    assert "matchability.py" in card.source
    assert card.file_path.stat().st_size < 1_000_000
    network = Memorability(card)
    ground = cv2.GaussianBlur(np.random.default_rng(1).normal(0, 1, (480, 640)), (0, 0), 2)
    ground = np.clip(128 + 45 * ground / ground.std(), 0, 255)

    def score_picture(picture):
        seen = picture + np.random.default_rng(2).normal(0, 6, picture.shape)  # by a sensor
        return network.compute_matrix(np.clip(seen, 0, 255).astype(np.uint8)).mean()

    least = load_config(None).salience.memorability
    assert score_picture(ground) > least
    for spoilt in (0.04 * ground, 200 + 0.05 * (ground - 128), np.full_like(ground, 90)):
        assert score_picture(spoilt) < least
