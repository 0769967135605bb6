"""Learned words: the file that is read, and what is made of them."""

import literal_heads as literal
import numpy as np
import pytest
from tiny_networks import write_card

from edgevpr.core.errors import ModelError
from edgevpr.techniques import words


@pytest.fixture
def folder(models):
    write_card(models / "tiny.yaml", {"sha256": "0" * 64})
    return models


def write(folder, kind="vlad", count=3, **changes):
    arrays = {
        "words": np.arange(2 * count, dtype=np.float16).reshape(count, 2),
        "model_sha256": words.load_card("tiny").fingerprint,
    }
    np.savez(folder / f"tiny_{kind}{count}.npz", **{**arrays, **changes})


def test_words_are_read_and_belong_to_their_file(folder):
    write(folder)
    first, first_sha256 = words.load_words("tiny", "vlad", 3)
    assert first.dtype == np.float32
    assert first.tolist() == [[0, 1], [2, 3], [4, 5]]
    write(folder, words=np.ones((3, 2), np.float16))
    assert words.load_words("tiny", "vlad", 3)[1] != first_sha256


def test_words_of_another_network_are_refused(folder):
    write(folder)
    write_card(folder / "tiny.yaml", {"sha256": "1" * 64})
    with pytest.raises(ModelError, match="different network"):
        words.load_words("tiny", "vlad", 3)


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"words": np.zeros((2, 2), np.float16)}, r"must have 3 words.*\(2, 2\)"),
        ({"words": np.full((3, 2), np.nan, np.float16)}, "must have 3 words"),
        ({"words": np.array([{}, {}, {}], object)}, "cannot be read"),
    ],
)
def test_load_words_refuses_damaged_files(folder, changes, says):
    write(folder, **changes)
    with pytest.raises(ModelError, match=says):
        words.load_words("tiny", "vlad", 3)


@pytest.mark.parametrize("content", [b"", b"not a zip", b"PK\x03\x04 cut off"])
def test_load_words_refuses_another_file(folder, content):
    (folder / "tiny_vlad3.npz").write_bytes(content)
    with pytest.raises(ModelError, match="tiny_vlad3"):
        words.load_words("tiny", "vlad", 3)


def test_compute_bag_of_words_equals_the_literal_loop():
    rng = np.random.default_rng(2)
    local, known = rng.normal(size=(30, 4)).astype(np.float32), rng.normal(size=(20, 4)).astype(np.float32)
    np.testing.assert_allclose(words.compute_bag_of_words(local, known), literal.bag_of_words(local, known), rtol=1e-6)
    assert not words.compute_bag_of_words(np.zeros((0, 4), np.float32), known).any()
