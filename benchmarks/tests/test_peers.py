"""The other ways that `cohog` is measured beside run, and the recipes of modern networks are whole."""

import re
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from base import REPOSITORY
from pictures import textured

from edgevpr.techniques.card import read_card

sys.path.append(str(REPOSITORY / "benchmarks" / "peers"))
import ways

NEEDS = {"CoHOG, published": "skimage", "FAISS on cohog's codes": "faiss"}
RECIPES = REPOSITORY / "docs" / "how-to" / "modern-networks.md"


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of the types of faiss
@pytest.mark.parametrize("name", ways.WAYS)
def test_every_way_finds_a_picture_that_moved_a_little(name, monkeypatch):
    if name in NEEDS:
        pytest.importorskip(NEEDS[name])
    monkeypatch.setattr(ways, "WORDS_ORB", 40)
    monkeypatch.setattr(ways, "WORDS_SIFT", 8)
    way = ways.WAYS[name]()
    pictures = [cv2.resize(textured(seed), (320, 240)) for seed in range(8)]
    words = way.learn(pictures)
    index = way.index([way.encode(each, words) for each in pictures], words)
    moved = [way.scores(way.encode(np.roll(each, (2, 3), (0, 1)), words), index) for each in pictures]
    assert [int(np.argmax(scores)) for scores in moved] == list(range(8))
    assert way.nbytes(index, 8) > 0
    nothing = way.scores(way.encode(np.full((240, 320), 128, np.uint8), words), index)
    assert np.isfinite(nothing).all()


def test_every_card_of_the_page_is_valid_and_makes_a_technique(tmp_path: Path):
    cards = re.findall(r"^`(\w+)\.yaml`:\n\n((?:    .+\n)+)", RECIPES.read_text("utf-8"), re.MULTILINE)
    assert len(cards) == 5
    for name, text in cards:
        (tmp_path / f"{name}.yaml").write_text(re.sub("^    ", "", text, flags=re.MULTILINE))
        card = read_card(tmp_path / f"{name}.yaml", needs_hash=False)
        assert (card.file, card.is_technique) == (f"{name}.onnx", True)
        assert len(card.input.mean) == len(card.input.std) == 3
