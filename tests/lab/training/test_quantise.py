"""A network in 8-bit integers: nearly the same numbers from a smaller file."""

import builtins
import json

import numpy as np
import pytest
from pictures import textured
from pictures_on_disk import write_pictures
from tiny_networks import write_network

from edgevpr.cli.main import main
from edgevpr.core.errors import ModelError, SourceError
from edgevpr.lab.training.quantise import quantise
from edgevpr.runtime.preflight.networks import verify_here
from edgevpr.techniques.session import open_backbone

pytestmark = pytest.mark.slow


@pytest.fixture
def models(models, monkeypatch):
    monkeypatch.setattr("edgevpr.lab.training.quantise.verify", verify_here)
    return models


def test_the_integers_give_nearly_the_same_descriptor(models, tmp_path):
    write_network(models, "mine")
    result = quantise("mine", write_pictures(tmp_path / "pictures", 8))
    assert result.images == 8
    assert result.card == str(models / "mine_int8.yaml")
    assert (result.before.shapes, result.after.name) == (result.after.shapes, "mine_int8")
    for output in ("descriptor", "features"):
        exact = open_backbone("mine", output).run(textured(1)).ravel()
        rough = open_backbone("mine_int8", output).run(textured(1)).ravel()
        assert (exact != rough).any()
        assert exact @ rough / np.linalg.norm(exact) / np.linalg.norm(rough) > 0.99


def test_the_command_says_what_both_take(models, tmp_path, capsys):
    write_network(models, "mine")
    folder = write_pictures(tmp_path / "pictures", 6)
    assert main(["models", "quantise", "mine", "--calibrate", str(folder), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["after"]["file_mb"] > 0


def test_no_images_and_no_onnx_are_one_sentence(models, tmp_path, monkeypatch):
    write_network(models, "mine")
    (tmp_path / "empty").mkdir()
    with pytest.raises(SourceError, match="empty"):
        quantise("mine", tmp_path / "empty")
    pictures = write_pictures(tmp_path / "pictures", 2)
    imported = builtins.__import__

    def without_onnx(name, *args, **kwargs):
        if name == "onnx":
            raise ImportError("No module named 'onnx'")
        return imported(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", without_onnx)
    with pytest.raises(ModelError, match="`onnx`"):
        quantise("mine", pictures)
    assert not (models / "mine_int8.yaml").exists()
