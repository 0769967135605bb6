"""Words are learnt with NumPy and onnxruntime alone, on the network that edgevpr ships."""

import shutil

import numpy as np
import pytest
from pictures_on_disk import write_pictures

from edgevpr import techniques
from edgevpr.cli.main import main
from edgevpr.core.files import shipped
from edgevpr.lab.training import words as training_words
from edgevpr.lab.training.pictures import read_pictures
from edgevpr.techniques.session import open_backbone
from edgevpr.techniques.words import load_words, local_descriptors, sharpness_of, vlad


@pytest.fixture(autouse=True)
def own_models(tmp_path, monkeypatch):
    """The backbone alone, so that no shipped words are found."""
    models = tmp_path / "models"
    models.mkdir()
    for name in ("calc.onnx", "calc.yaml"):
        shutil.copy(shipped("models") / name, models / name.replace("calc.yaml", "mine.yaml"))
    monkeypatch.setenv("EDGEVPR_MODELS", str(models))
    monkeypatch.setattr(training_words, "_POINTS", 2000)
    return models


@pytest.fixture
def folder(tmp_path):
    return write_pictures(tmp_path / "pictures", 12)


def train(folder, *more):
    return main(["train", "words", "--images", str(folder), "--model", "mine", *more])


@pytest.mark.parametrize(("kind", "technique"), [("vlad", "netvlad"), ("regions", "region_vlad")])
def test_words_make_the_technique_work(kind, technique, folder, own_models):
    assert train(folder, "--kind", kind, "--count", "8") == 0
    made = techniques.create(technique, {"model": "mine", "words": 8})
    (picture, *_) = read_pictures([folder], "reading")
    vector = made.encode(picture).coarse.astype(np.float32)
    assert vector.shape == (8 * 128,)
    assert np.linalg.norm(vector) == pytest.approx(1, abs=1e-3)


@pytest.mark.slow
def test_the_same_pictures_give_the_same_file(folder, own_models, tmp_path):
    for out in ("a", "b"):
        assert train(folder, "--kind", "vlad", "--count", "8", "--whiten", "6", "--out", str(tmp_path / out)) == 0
    first, again = ((tmp_path / out / "mine_vlad8.npz").read_bytes() for out in ("a", "b"))
    assert first == again


@pytest.mark.slow
def test_whitened_vectors_of_the_pictures_learnt_from_are_uncorrelated_and_alike_in_size(folder):
    assert train(folder, "--kind", "vlad", "--count", "8", "--whiten", "6") == 0
    words = load_words("mine", "vlad", 8)
    backbone = open_backbone("mine", "features")
    sharpness = sharpness_of(words.words)
    rows = []
    for picture in read_pictures([folder], "reading"):
        local = local_descriptors(backbone.run(picture))
        vector = vlad(local, words.words, sharpness)
        assert np.linalg.norm(words.whitening(vector)) == pytest.approx(1, abs=1e-5)
        white = words.whitening
        rows.append(white.scale * (white.matrix.astype(np.float32) @ (vector - white.mean)))
    covariance = np.cov(np.array(rows).T, bias=True)
    np.testing.assert_allclose(covariance, np.eye(6), atol=0.05)


def test_what_makes_no_sense_is_refused(folder, own_models, capsys):
    for arguments, part in (
        (("--kind", "vlad", "--count", "1"), "at least 2 words"),
        (("--kind", "bow", "--count", "8", "--whiten", "4"), "--whiten is for --kind vlad"),
        (("--kind", "vlad", "--count", "8", "--whiten", "12"), "needs more than 12 usable images"),
        (("--kind", "vlad", "--count", "5000"), "too few for 5000 words"),
    ):
        assert train(folder, *arguments) == 2
        assert part in capsys.readouterr().err
    (own_models / "mine_vlad8.npz").write_bytes(b"")
    assert train(folder, "--kind", "vlad", "--count", "8") == 2
    assert "mine_vlad8.npz" in capsys.readouterr().err


@pytest.mark.slow
def test_a_whitening_of_pictures_that_are_all_alike_is_refused(folder, own_models, capsys):
    first, *others = sorted(folder.iterdir())
    for other in others:
        shutil.copyfile(first, other)
    assert train(folder, "--kind", "vlad", "--count", "8", "--whiten", "6") == 2
    assert "alike" in capsys.readouterr().err
    assert not list(own_models.glob("*.npz*"))
