"""The training itself: needs PyTorch and onnx, which are not among the development tools because of their size."""

import json
import os
from importlib import import_module

import numpy as np
import pytest
from pictures_on_disk import write_pictures

from edgevpr.cli.main import main
from edgevpr.core.errors import EdgevprError, UsageError
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


def finished(training, checkpoint):
    for _ in training.run(checkpoint):
        pass
    return training


def weights(training):
    return {name: value.numpy() for name, value in training.encoder().state_dict().items()}


def test_a_stopped_training_ends_as_one_that_was_not(calc, pictures, tmp_path, monkeypatch):
    whole = finished(calc.Training(pictures, 6, seed=1), tmp_path / "whole")
    monkeypatch.setattr(calc, "_STEPS_BETWEEN_CHECKPOINTS", 3)
    stopped = calc.Training(pictures, 6, seed=1)
    for step in stopped.run(tmp_path / "c"):
        if step == 4:  # one step after the checkpoint: it is lost, and done again
            break
    resumed = calc.Training(pictures, 6, seed=1)
    resumed.load(tmp_path / "c")
    assert resumed.step == 3
    finished(resumed, tmp_path / "c")
    np.testing.assert_allclose(resumed.losses, whole.losses[3:], rtol=1e-4)
    for name, value in weights(whole).items():
        np.testing.assert_allclose(weights(resumed)[name], value, atol=1e-4)


def test_a_checkpoint_of_other_settings_is_refused(calc, pictures, tmp_path):
    training = calc.Training(pictures, 4, seed=1)
    training.save(tmp_path / "c")
    for other in (calc.Training(pictures, 5, 1), calc.Training(pictures, 4, 2), calc.Training(pictures[1:], 4, 1)):
        with pytest.raises(UsageError, match="--steps"):
            other.load(tmp_path / "c")


def test_a_damaged_or_missing_checkpoint_is_refused(calc, pictures, tmp_path):
    training = calc.Training(pictures, 4, seed=1)
    training.save(tmp_path / "c")
    (tmp_path / "c").write_bytes((tmp_path / "c").read_bytes()[:1000])
    with pytest.raises(UsageError, match="checkpoint"):
        training.load(tmp_path / "c")
    with pytest.raises(UsageError, match="none"):
        training.load(tmp_path / "none")


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
    file = onnxfile.ModelFile(path=tmp_path / "m.onnx", title="", input="image", rule=job._INPUT, outputs=outputs)
    inputs = list(np.random.default_rng(0).random((3, 1, 1, 120, 160), np.float32))
    assert onnxfile.write_model(file, encoder, inputs, "", "") <= 1e-4
    assert read_card(file.card).outputs.features == "features"
    write = onnxfile._write_onnx

    def write_another(*parts):
        write(*parts)
        encoder.conv3.bias += 0.1

    monkeypatch.setattr(onnxfile, "_write_onnx", write_another)
    with pytest.raises(EdgevprError, match="PyTorch"):
        onnxfile.write_model(file, encoder, inputs, "", "")
    assert not file.path.exists()


def train(folder, out, *more):
    return main(["train", "calc", "--images", str(folder), "--out", str(out), "--steps", "3", "--json", *more])


def test_the_command_makes_a_model_that_edgevpr_opens(folder, tmp_path, capsys, monkeypatch):
    assert train(folder, tmp_path / "mine.onnx") == 0
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


def test_a_file_that_differs_is_not_left_and_another_try_goes_on(onnxfile, folder, tmp_path, capsys, monkeypatch):
    with monkeypatch.context() as patched:
        patched.setattr(onnxfile, "LARGEST_DIFFERENCE", -1.0)
        assert train(folder, tmp_path / "mine.onnx") == 1
    assert "--resume" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["mine.checkpoint"]
    assert train(folder, tmp_path / "mine.onnx", "--resume") == 0


def test_interrupted_the_command_keeps_what_was_done(calc, onnx, folder, tmp_path, capsys, monkeypatch):
    one_step = calc.Training._one_step

    def interrupted(training):
        if training.step == 2:
            raise KeyboardInterrupt
        one_step(training)

    out = tmp_path / "m.onnx"
    monkeypatch.setattr(calc.Training, "_one_step", interrupted)
    assert train(folder, out) == 130
    assert not out.exists()
    monkeypatch.setattr(calc.Training, "_one_step", one_step)
    assert train(folder, out) == 2
    assert "add --resume" in capsys.readouterr().err
    assert train(folder, out, "--resume") == 0
    assert train(folder, tmp_path / "whole.onnx") == 0
    resumed, whole = (onnx.load(path).graph.initializer for path in (out, tmp_path / "whole.onnx"))
    for got, wanted in zip(resumed, whole, strict=True):
        np.testing.assert_allclose(onnx.numpy_helper.to_array(got), onnx.numpy_helper.to_array(wanted), atol=1e-4)
    assert not (tmp_path / "m.checkpoint").exists()


def test_a_full_disk_is_one_sentence(folder, tmp_path, capsys):
    out = tmp_path / "m.onnx"
    (tmp_path / f".m.checkpoint.{os.getpid()}").symlink_to("/dev/full")
    assert train(folder, out) == 1
    said = capsys.readouterr().err.strip().splitlines()[-1]
    assert "No space left on device" in said
    assert not out.exists()
