"""Words are learnt with NumPy and onnxruntime alone, on the network that edgevpr ships."""

import shutil

import numpy as np
import pytest
import train_words
from pictures import draw_texture, write_flight
from training_pictures import read_pictures

from edgevpr import techniques
from edgevpr.core.errors import UsageError
from edgevpr.core.files import find_shipped


@pytest.fixture(autouse=True)
def own_models(models, monkeypatch):
    """The backbone alone, so that no shipped words are found."""
    for name in ("calc.onnx", "calc.yaml"):
        shutil.copy(find_shipped("models") / name, models / name.replace("calc.yaml", "mine.yaml"))
    monkeypatch.setattr(train_words, "_POINTS", 2000)
    return models


@pytest.fixture
def folder(tmp_path):
    """Twelve pictures."""
    write_flight(tmp_path / "pictures", map(draw_texture, range(12)))
    return tmp_path / "pictures"


def train(folder, out, *more):
    train_words.main(["--images", str(folder), "--model", "mine", "--out", str(out), *more])


@pytest.mark.parametrize(("kind", "technique"), [("vlad", "netvlad"), ("regions", "region_vlad")])
def test_train_words_makes_the_technique_usable(kind, technique, folder, own_models, capsys):
    (folder / "broken.jpg").write_bytes(b"\xff\xd8\xff nothing")
    train(folder, own_models, "--kind", kind, "--count", "8")
    said = capsys.readouterr()
    assert " 12 images" in said.out
    assert "broken.jpg" in said.err
    made = techniques.create(technique, {"model": "mine", "words": 8})
    (picture, *_) = read_pictures([folder], "reading")
    vector = made.encode(picture).coarse.astype(np.float32)
    assert vector.shape == (8 * 128,)
    assert np.linalg.norm(vector) == pytest.approx(1, abs=1e-3)


def test_train_words_refuses_more_words_than_descriptors_allow(folder, own_models):
    with pytest.raises(UsageError, match=r"at most \d+ words"):
        train(folder, own_models, "--kind", "vlad", "--count", "5000")
