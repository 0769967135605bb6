"""Words of places: how they turn with the picture, what a scan counts, and that a place is found however it is seen."""

import cv2
import numpy as np
import pytest

from edgevpr.core.errors import ModelError, UsageError
from edgevpr.techniques import placewords
from edgevpr.techniques.cohog import CoHog
from edgevpr.techniques.gradients import normalised_blocks, oriented_cells, slow_patterns

SIDE = 31
NONE = 1024
AS_MAPPED = slice(48, 72)  # hypotheses: the 24 rotations from the height of the map
VOCABULARY = placewords.load("ground_words")


def ground(seed, side_px=1024):
    """Ground of soft patches of several sizes, none smaller than a region."""
    rng = np.random.default_rng(seed)
    layers = [cv2.resize(rng.random((n, n)), (side_px, side_px), interpolation=cv2.INTER_CUBIC) for n in (6, 14, 30)]
    return cv2.normalize(sum(layers), None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)


def view(picture, right_px=0, down_px=0, turned_deg=0.0):
    """512x512 of the ground, from its middle, then turned counter-clockwise."""
    middle = picture.shape[0] / 2 - 0.5
    turn = cv2.getRotationMatrix2D((middle + right_px, middle + down_px), turned_deg, 1)
    turned = cv2.warpAffine(picture, turn, picture.shape[::-1])
    top, left = (int(middle + 0.5) - 256 + step for step in (down_px, right_px))
    return np.ascontiguousarray(turned[top : top + 512, left : left + 512])


def patterns(image):
    blocks = normalised_blocks(oriented_cells(image, 16, 8, signed=True)).reshape(SIDE * SIDE, -1)
    found = blocks @ slow_patterns(8)
    return found / np.maximum(np.linalg.norm(found, axis=1, keepdims=True), 1e-6)


@pytest.fixture(scope="module")
def town():
    technique = CoHog(camera="nadir")
    grounds = [ground(seed) for seed in range(12)]
    return technique, grounds, np.stack([technique.encode(view(each)).coarse for each in grounds])


def test_a_word_of_four_is_the_one_before_turned(town):
    words = VOCABULARY
    assert words.shape == (1024, 20)
    np.testing.assert_allclose(np.linalg.norm(words, axis=1), 1, atol=2e-3)
    image = view(ground(3))
    once, turned = patterns(image), patterns(np.ascontiguousarray(np.rot90(image)))
    first, then = placewords.nearest(VOCABULARY, once), placewords.nearest(VOCABULARY, turned)
    now = then[placewords.turned_numbers(SIDE)]
    assert np.mean(first - first % 4 + (first + 1) % 4 == now) > 0.99


def test_turned_blocks_are_those_of_the_turned_picture():
    image = view(ground(4))
    blocks = normalised_blocks(oriented_cells(image, 16, 8, signed=True))
    for quarters in range(-3, 5):
        expected = normalised_blocks(
            oriented_cells(np.ascontiguousarray(np.rot90(image, quarters)), 16, 8, signed=True)
        )
        np.testing.assert_allclose(placewords.turned_blocks(blocks, quarters), expected, atol=1e-5)


def test_a_place_has_each_word_once_and_none_where_nothing_is_to_be_seen():
    good = np.zeros(SIDE * SIDE, bool)
    good[: SIDE * SIDE // 2] = True
    at = placewords.named(SIDE)
    words = placewords.of_place(VOCABULARY, patterns(view(ground(5)))[at], good[at])
    assert (words.shape, words.dtype) == ((100,), np.uint16)
    there = words[words < NONE]
    assert len(np.unique(there)) == len(there) > 20
    assert (words[50:] == NONE).all()


def test_the_scan_is_the_count_spelt_out(town):
    technique, grounds, rows = town
    query = technique.encode(view(grounds[2], 60, -30, 40.0))
    asking = {turn: technique.good_patterns(query, turn) for turn in range(6)}
    asked = placewords.of_query(VOCABULARY, asking, 6, (SIDE, SIDE))
    places = [round((n + 0.5) * 3.1 - 0.5) for n in range(10)]
    expected = np.zeros((len(rows), 24))
    for turn in range(24):
        mine = asked.turn == turn
        assert np.bincount(asked.word[mine]).max() <= 4
        of_word = {word: asked.region[mine & (asked.word == word)] for word in np.unique(asked.word[mine])}
        for slot, row in enumerate(rows):
            shared, shifts = 0, {}
            for at, word in enumerate(row.tolist()):
                for region in of_word.get(word, ()):
                    shared += 1
                    y, x = places[at // 10] - region // SIDE, places[at % 10] - region % SIDE
                    bin_ = ((y + SIDE - 1) // 4, (x + SIDE - 1) // 4)
                    for corner in ((0, 0), (0, 1), (1, 0), (1, 1)):
                        agreeing = bin_[0] + corner[0], bin_[1] + corner[1]
                        shifts[agreeing] = shifts.get(agreeing, 0) + 1
            inside = [count for (y, x), count in shifts.items() if 1 <= y <= 15 and 1 <= x <= 15]
            expected[slot, turn] = shared + 5 * max(inside, default=0)
    scores = placewords.scan(asked, rows)
    np.testing.assert_allclose(scores, expected / (24 * 100), rtol=1e-5)


@pytest.mark.parametrize(
    ("right", "down", "turned_deg"), [(0, 0, 0), (96, -64, 0), (0, 0, 105), (-64, 32, 240), (16, 48, 345)]
)
def test_a_moved_and_turned_camera_finds_the_place_and_its_rotation(town, right, down, turned_deg):
    technique, grounds, rows = town
    query = technique.encode(view(grounds[7], right, down, turned_deg))
    scores, by_rotation = technique.coarse_scores(query, rows, None)
    assert scores.argmax() == 7
    off_deg = (15 * by_rotation[7].argmax() - turned_deg + 180) % 360 - 180
    assert abs(off_deg) <= 15


def test_numbers_that_are_no_words_count_as_none(town):
    technique, grounds, rows = town
    query = technique.encode(view(grounds[4], 16, 0, 30))
    odd = rows.copy()
    odd[odd == NONE] = 60_000
    np.testing.assert_array_equal(
        technique.coarse_scores(query, odd, None)[1], technique.coarse_scores(query, rows, None)[1]
    )


def test_a_picture_without_a_good_region_is_compared_without_a_warning(town):
    technique, _, rows = town
    query = technique.encode(np.full((512, 512), 90, np.uint8))
    scores, by_rotation = technique.coarse_scores(query, rows, None)
    assert (scores == 0).all()
    assert np.isfinite(by_rotation).sum() == 24 * len(rows)


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        (None, "There are no words mine.npz"),
        (b"no archive", "cannot be read as words"),
        ({"other": np.zeros(3)}, "cannot be read as words"),
        ({"words": np.ones((256, 20), np.float16)}, "holds no 256 words"),
        ({"words": np.full((256, 20), np.nan, np.float16)}, "holds no 256 words"),
        ({"words": np.zeros((3, 20), np.float16)}, "holds no 256 words"),
    ],
)
def test_words_that_are_missing_or_damaged_are_refused_in_one_sentence(content, complaint, tmp_path, monkeypatch):
    monkeypatch.setenv("EDGEVPR_MODELS", str(tmp_path))
    if isinstance(content, bytes):
        (tmp_path / "mine.npz").write_bytes(content)
    elif content:
        np.savez_compressed(tmp_path / "mine.npz", **content)
    with pytest.raises(ModelError, match=complaint):
        CoHog(camera="nadir", words="mine")
    with pytest.raises(ModelError, match="ground_words"):
        CoHog(camera="nadir", words="../ground_words")


def test_a_map_records_its_words_and_one_that_looks_ahead_has_none():
    assert CoHog(camera="nadir").spec.parameters["words"] == "ground_words"
    assert "words" not in CoHog().spec.parameters
    with pytest.raises(UsageError, match="uses 8 bins"):
        CoHog(camera="nadir", bins=12)
