"""The training itself: needs PyTorch and onnx, which are not among the development tools because of their size."""

import json
from importlib import import_module

import numpy as np
import pytest
from pictures_on_disk import write_pictures

from edgevpr.cli.main import main
from edgevpr.core.errors import EdgevprError
from edgevpr.lab.training import job
from edgevpr.lab.training.pictures import read_pictures, small_grey
from edgevpr.techniques.card import read_card

# PyTorch is a fixture and no import: of all processes that collect these tests, only the one that runs them loads it.

pytestmark = pytest.mark.slow  # networks are fitted


@pytest.fixture(scope="module")
def torch():
    return pytest.importorskip("torch", reason="PyTorch is not installed (pip install 'edgevpr[train]')")


@pytest.fixture(scope="module")
def onnx():
    pytest.importorskip("onnxscript", reason="onnxscript is not installed (pip install 'edgevpr[train]')")
    return pytest.importorskip("onnx", reason="onnx is not installed (pip install 'edgevpr[train]')")


@pytest.fixture(scope="module")
def calc(torch):
    return import_module("edgevpr.lab.training.calc")


@pytest.fixture(scope="module")
def onnxfile(torch, onnx):
    return import_module("edgevpr.lab.training.onnxfile")


@pytest.fixture(autouse=True)
def small(monkeypatch, torch, onnx, calc):
    monkeypatch.setattr(calc, "BATCH", 4)
    monkeypatch.setattr(calc, "_WARM_UP_STEPS", 4)
    torch.set_num_threads(1)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return write_pictures(tmp_path_factory.mktemp("training") / "pictures", 20)


@pytest.fixture(scope="module")
def pictures(folder):
    return [small_grey(picture) for picture in read_pictures([folder], "reading")]


def test_the_same_seed_gives_the_same_network(calc, pictures):
    (first, losses), (again, others) = (calc.fitted(pictures, 6, seed=1) for _ in range(2))
    np.testing.assert_allclose(losses, others, rtol=1e-4)
    for one, other in zip(first.parameters(), again.parameters(), strict=True):
        np.testing.assert_allclose(one.numpy(), other.numpy(), atol=1e-4)


def test_folding_changes_nothing(torch, calc):
    """What batch normalisation does in evaluation, in the weights."""
    encoder = calc.Autoencoder(torch.full((14 * 19 * 36,), 0.3)).encoder
    image = torch.rand(4, 1, 120, 160)
    for _ in range(3):
        encoder.features(image)
        encoder.code(encoder.features(image))
    trained_on = encoder.training
    folded = encoder.folded()
    assert encoder.training is trained_on  # the training goes on as before
    encoder.eval()
    with torch.no_grad():
        for got, wanted in zip(folded(image), encoder(image), strict=True):
            torch.testing.assert_close(got, wanted, atol=1e-5, rtol=1e-4)


def test_the_encoder_normalises_responses_as_pytorch_does(torch, calc):
    x = 100 * torch.rand(2, 64, 6, 5)
    wanted = torch.nn.functional.local_response_norm(x, 5, 1e-4, 0.75, 1.0)
    torch.testing.assert_close(calc._response_normalised(x), wanted)


def test_the_file_equals_pytorch_and_a_difference_is_found(torch, calc, onnxfile, tmp_path, monkeypatch):
    torch.manual_seed(0)
    encoder = calc.Encoder().eval().requires_grad_(False)
    outputs = {"descriptor": "descriptor", "features": "features"}
    file = onnxfile.ModelFile(
        path=tmp_path / "m.onnx", title="", source="", input="image", rule=job._INPUT, outputs=outputs
    )
    inputs = list(np.random.default_rng(0).random((3, 1, 1, 120, 160), np.float32))
    assert onnxfile.write_model(file, encoder, inputs) <= 1e-4
    assert read_card(file.card).outputs.features == "features"
    write = onnxfile._write_onnx

    def write_another(*parts):
        write(*parts)
        encoder.conv3.bias += 0.1

    monkeypatch.setattr(onnxfile, "_write_onnx", write_another)
    with pytest.raises(EdgevprError, match="PyTorch"):
        onnxfile.write_model(file, encoder, inputs)
    assert not file.path.exists()


def test_the_command_makes_a_model_that_edgevpr_opens(folder, tmp_path, capsys, monkeypatch):
    out = tmp_path / "mine.onnx"
    assert main(["train", "calc", "--images", str(folder), "--out", str(out), "--steps", "3", "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["pictures"] == 20
    assert said["largest_difference"] <= 1e-4
    assert sorted(path.name for path in tmp_path.iterdir()) == ["mine.onnx", "mine.yaml"]
    card = read_card(tmp_path / "mine.yaml")
    assert card.licence == "MIT"
    assert "--steps 3" in card.source
    monkeypatch.setenv("EDGEVPR_MODELS", str(tmp_path))
    from edgevpr.techniques.session import open_backbone

    assert open_backbone("mine", "descriptor").shape == (1064,)
    assert open_backbone("mine", "features").shape == (128, 16, 21)
