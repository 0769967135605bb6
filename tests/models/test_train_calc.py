"""The training itself: needs PyTorch and onnx, which are not among the development tools because of their size."""

import importlib

import cv2
import numpy as np
import pytest
from training_pictures import read_pictures
from write_pictures import write_pictures

from edgevpr.core.errors import EdgevprError, UsageError
from edgevpr.techniques.card import read_card
from edgevpr.techniques.session import open_backbone

pytestmark = pytest.mark.slow  # networks are fitted


@pytest.fixture(scope="module")
def calc():
    """The recipe. It is a fixture and no import: only the process that runs these tests loads PyTorch."""
    for package in ("torch", "onnx", "onnxscript"):
        pytest.importorskip(package, reason=f"{package} is not installed (pip install 'edgevpr[train]')")
    recipe = importlib.import_module("train_calc")
    recipe.torch.set_num_threads(1)
    return recipe


@pytest.fixture(autouse=True)
def small(monkeypatch, calc):
    monkeypatch.setattr(calc, "BATCH", 4)
    monkeypatch.setattr(calc, "_WARM_UP_STEPS", 4)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return write_pictures(tmp_path_factory.mktemp("training") / "pictures", 20)


@pytest.fixture(scope="module")
def pictures(folder, calc):
    return [calc.small_grey(picture) for picture in read_pictures([folder], "reading")]


def test_the_same_seed_gives_the_same_network(calc, pictures):
    (first, losses), (again, others) = (calc.fitted(pictures, 6, seed=1) for _ in range(2))
    np.testing.assert_allclose(losses, others, rtol=1e-4)
    for one, other in zip(first.parameters(), again.parameters(), strict=True):
        np.testing.assert_allclose(one.numpy(), other.numpy(), atol=1e-4)


def test_folding_changes_nothing(calc):
    """What batch normalisation does in evaluation, in the weights."""
    encoder = calc.Autoencoder(calc.torch.full((14 * 19 * 36,), 0.3)).encoder
    image = calc.torch.rand(4, 1, 120, 160)
    for _ in range(3):
        encoder.code(encoder.features(image))
    folded = encoder.folded()
    assert encoder.training  # the training goes on as before
    encoder.eval()
    with calc.torch.no_grad():
        for got, wanted in zip(folded(image), encoder(image), strict=True):
            calc.torch.testing.assert_close(got, wanted, atol=1e-5, rtol=1e-4)


def test_the_encoder_normalises_responses_as_pytorch_does(calc):
    x = 100 * calc.torch.rand(2, 64, 6, 5)
    wanted = calc.torch.nn.functional.local_response_norm(x, 5, 1e-4, 0.75, 1.0)
    calc.torch.testing.assert_close(calc._response_normalised(x), wanted)


def test_a_batch_has_the_form_the_network_takes(calc, pictures):
    inputs, targets = calc.batch(pictures, 3, np.random.default_rng(1))
    assert inputs.shape == (3, 1, 120, 160)
    assert targets.shape == (3, calc.TARGET_LENGTH)
    assert inputs.min() >= 0
    assert inputs.max() == 1  # equalised: the brightest pixel is white
    assert targets.min() >= 0
    assert targets.max() <= 1


def test_both_sights_show_the_same_ground(calc):
    """The changed sight correlates with its own original, and much less with others."""
    coarse = np.random.default_rng(3).integers(0, 256, (12, 16), np.uint8)
    picture, rng = cv2.resize(coarse, (320, 240), interpolation=cv2.INTER_CUBIC), np.random.default_rng(5)
    pairs = [calc.two_sights(picture, rng) for _ in range(24)]
    flat = [np.stack([cv2.equalizeHist(sight).ravel() for sight in sights]) for sights in zip(*pairs, strict=True)]
    correlation = np.corrcoef(*flat)[:24, 24:]
    own = np.diag(correlation)
    assert own.mean() > np.median(correlation) + 0.3
    assert (own < 0.9999).all()  # and is changed


def test_a_file_that_differs_from_pytorch_is_deleted(calc, tmp_path, monkeypatch):
    onnx_file = importlib.import_module("write_onnx")
    encoder = calc.Encoder().eval().requires_grad_(False)
    outputs = {"descriptor": "descriptor", "features": "features"}
    file = onnx_file.ModelFile(
        path=tmp_path / "m.onnx", title="", source="", input="image", rule=calc._INPUT, outputs=outputs
    )
    write = onnx_file._write_onnx

    def write_another(*parts):
        write(*parts)
        encoder.conv2.bias += 0.1

    monkeypatch.setattr(onnx_file, "_write_onnx", write_another)
    with pytest.raises(EdgevprError, match="PyTorch"):
        onnx_file.write_model(file, encoder, [np.random.default_rng(0).random((1, 1, 120, 160), np.float32)])
    assert not list(tmp_path.iterdir())


def test_the_recipe_makes_a_model_that_edgevpr_opens(calc, folder, models):
    calc.main(["--images", str(folder), "--out", str(models / "mine.onnx"), "--steps", "3"])
    assert sorted(path.name for path in models.iterdir()) == ["mine.onnx", "mine.yaml"]
    card = read_card(models / "mine.yaml")
    assert card.licence == "MIT"
    assert "--steps 3" in card.source
    assert open_backbone("mine", "descriptor").shape == (1064,)
    assert open_backbone("mine", "features").shape == (128, 16, 21)
    with pytest.raises(UsageError, match=r"mine\.onnx"):
        calc.main(["--images", str(folder), "--out", str(models / "mine.onnx")])
