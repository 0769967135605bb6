"""The other ways that `cohog` is measured beside run, and the recipes of modern networks are whole."""

import os
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from peers import modern, ways
from pictures import textured

from edgevpr.techniques.card import read_card

ROOT = Path(__file__).parents[1]
NEEDS = {"CoHOG, published": "skimage", "pydbow": "dbow", "FAISS on cohog's codes": "faiss"}
NAMES = ("cosplace", "cosplace_resnet50", "eigenplaces", "mixvpr", "salad")
CLASSIFIER = 1000  # classes of the numbers below


@pytest.fixture(scope="module")
def cards(tmp_path_factory):
    folder = tmp_path_factory.mktemp("cards")
    for name, text in modern.cards(modern.RECIPES.read_text()).items():
        (folder / f"{name}.yaml").write_text(text)
    return {path.stem: read_card(path, needs_hash=False) for path in folder.iterdir()}


@pytest.fixture(scope="module")
def architectures():
    pytest.importorskip("torch", reason="PyTorch is not installed (pip install 'edgevpr[train]')")
    from peers import architectures
    from peers.architectures import export  # noqa: F401  so that `architectures.export` is there

    return architectures


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of the types of faiss
@pytest.mark.parametrize("name", ways.WAYS)
def test_every_way_finds_a_picture_that_moved_a_little(name, monkeypatch):
    if name in NEEDS:
        pytest.importorskip(NEEDS[name])
    monkeypatch.setattr(ways, "WORDS_ORB", 40)
    monkeypatch.setattr(ways, "WORDS_SIFT", 8)
    monkeypatch.setattr(ways, "PYDBOW_EVERY", 1)
    way = ways.WAYS[name]()
    pictures = [cv2.resize(textured(seed), (320, 240)) for seed in range(8)]
    words = way.learn(pictures)
    index = way.index([way.encode(each, words) for each in pictures], words)
    found = []
    for each in pictures:
        scores = way.scores(way.encode(np.roll(each, (2, 3), (0, 1)), words), index)
        assert scores.shape == (8,)
        found.append(int(np.argmax(scores)))
    assert found == list(range(8))
    assert way.nbytes(index, 8) > 0
    nothing = way.scores(way.encode(np.full((240, 320), 128, np.uint8), words), index)
    assert np.isfinite(nothing).all()


def test_every_card_of_the_page_is_valid_and_makes_a_technique(cards):
    assert sorted(cards) == sorted(NAMES)
    for name, card in cards.items():
        assert card.file == f"{name}.onnx"
        assert card.is_technique
        assert len(card.input.mean) == len(card.input.std) == 3


def test_every_card_has_an_architecture_of_its_size(cards, architectures):
    sizes = {name: (it.height, it.width) for name, it in architectures.ARCHITECTURES.items()}
    assert sizes == {name: (card.input.height, card.input.width) for name, card in cards.items()}


def test_backbones_are_as_large_as_their_authors_say(architectures):
    """torchvision says 11,689,512 and 25,557,032 parameters and 1.81 and 4.09 GFLOPS at 224x224, with the classifier;
    the model card of DINOv2 says 86 million."""
    from peers.architectures.dinov2 import Encoder
    from peers.architectures.resnet import channels_of, resnet

    for layers, parameters, gmacs in ((18, 11_689_512, 1.81), (50, 25_557_032, 4.09)):
        whole = architectures.Architecture(build=lambda layers=layers: resnet(layers), height=224, width=224)
        size = architectures.export.size_of(whole)
        classifier = (channels_of(layers) + 1) * CLASSIFIER
        assert round(1e6 * size["parameters_m"]) == parameters - classifier
        assert size["gmacs"] == pytest.approx(gmacs, abs=0.01)
    encoder = architectures.Architecture(build=Encoder, height=224, width=224)
    assert architectures.export.size_of(encoder)["parameters_m"] == pytest.approx(86, abs=1)


def test_descriptors_have_the_published_length_and_length_one(architectures):
    import torch

    torch.manual_seed(1)
    torch.set_num_threads(1)
    for name, length in {"cosplace": 512, "cosplace_resnet50": 2048, "mixvpr": 4096, "salad": 8448}.items():
        it = architectures.ARCHITECTURES[name]
        with torch.no_grad():
            found = it.build().eval()(torch.rand(1, 3, it.height, it.width))
        assert found.shape == (1, length)
        assert float(found.norm()) == pytest.approx(1, abs=1e-4)


def test_without_data_sets_it_says_so_and_writes_nothing(tmp_path):
    result = ROOT / "benchmarks" / "results" / "peers.md"
    before = result.stat().st_mtime_ns
    done = subprocess.run(
        [sys.executable, str(ROOT / "benchmarks" / "peers" / "peers.py")],
        env={**os.environ, "EDGEVPR_DATA": str(tmp_path)},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 2
    assert "name the right folder with EDGEVPR_DATA" in done.stderr
    assert "Traceback" not in done.stderr
    assert result.stat().st_mtime_ns == before
