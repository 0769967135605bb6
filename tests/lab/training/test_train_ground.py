"""`edgevpr train ground`: regions are turned alike before they are grouped, and the words written have length 1."""

import json

import numpy as np
import pytest
from pictures_on_disk import write_pictures

from edgevpr.cli.main import main
from edgevpr.lab.training.words import aligned
from edgevpr.techniques import placewords

pytestmark = pytest.mark.slow


def test_regions_that_are_turned_are_one_word():
    rng = np.random.default_rng(1)
    patterns = rng.normal(size=(50, 20)).astype(np.float32)
    turned = placewords.turned_words(patterns).reshape(50, 4, 20)
    for quarter in range(4):
        np.testing.assert_allclose(aligned(turned[:, quarter]), aligned(patterns), atol=1e-5)


def test_the_command_writes_words_that_cohog_can_use(tmp_path, capsys):
    folder = write_pictures(tmp_path / "pictures", 8)
    out = tmp_path / "words.npz"
    assert main(["train", "ground", "--images", str(folder), "--out", str(out), "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["pictures"] == 8
    assert result["distance"] < 0.4
    with np.load(out) as file:
        words = file["words"].astype(np.float32)
    assert words.shape == (256, 20)
    np.testing.assert_allclose(np.linalg.norm(words, axis=1), 1, atol=2e-3)
    assert main(["train", "ground", "--images", str(folder), "--out", str(out)]) != 0
    assert "words.npz" in capsys.readouterr().err


def test_too_few_regions_are_refused(tmp_path, capsys):
    from edgevpr.frames.images import cv2

    (tmp_path / "empty").mkdir()
    cv2.imwrite(str(tmp_path / "empty" / "a.png"), np.full((120, 160), 90, np.uint8))
    assert main(["train", "ground", "--images", str(tmp_path / "empty"), "--out", str(tmp_path / "w.npz")]) != 0
    assert "too few" in capsys.readouterr().err
