"""A map made on one processor flies on another: what is made of a picture is the same to the last bit.

The expected numbers are those of x86-64 and of aarch64 (a Cortex-A53), of which every one was seen to be the same.
"""

import zlib

import numpy as np
import pytest

from edgevpr.techniques import create, entropy
from edgevpr.techniques.gradients import grey_square, levels
from edgevpr.techniques.networks.card import InputRule
from edgevpr.techniques.networks.prepare import prepare

_WORDS = [
    29, 690, 747, 54, 116, 894, 839, 498, 689, 90, 326, 674, 1003, 479, 98, 888, 496, 742, 8, 181, 3, 96, 318, 117,
    211, 177, 316, 209, 722, 908, 275, 122, 1020, 401, 977,
]  # fmt: skip


@pytest.fixture
def picture():
    """Made of whole numbers alone, 480 x 640."""
    y, x = np.mgrid[:480, :640]
    return ((x * x // 97 + y * y // 61 + x * y // 173 + (x // 9 * 37 ^ y // 7 * 29)) % 256).astype(np.uint8)


def test_a_picture_is_scaled_to_the_same_pixels(picture):
    assert zlib.crc32(grey_square(picture, 512)) == 2266451809
    assert zlib.crc32(levels(grey_square(picture, 512))) == 2049827080
    assert zlib.crc32(entropy._shannon_copy(picture)) == 274043403


def test_a_network_sees_the_same_picture(picture):
    rule = InputRule(
        layout="NCHW", height=512, width=512, colour="grey", equalise=False, resize="linear", scale=1.0, mean=[0.0]
    )
    assert zlib.crc32(prepare(picture, rule).astype(np.uint8)) == 2049827080


def test_a_place_has_the_same_code(picture):
    technique = create("cohog")
    found = technique.encode(picture)
    mean = np.full((12, 12, 8), 90.0, np.float32)
    assert zlib.crc32(found.coarse) == 3849885506
    assert zlib.crc32(technique.pack(found.coarse[None], mean)) == 319593651


def test_a_place_has_the_same_words(picture):
    """But for a word or two: which of two words is nearer may hang on the last bit of a sum."""
    words = create("cohog", {"camera": "nadir"}).encode(picture).coarse
    there = np.flatnonzero(words < 1024)
    assert len(there) == 35
    assert np.mean(words[there] == np.array(_WORDS)) > 0.9


def test_a_query_is_turned_to_the_same_picture(picture):
    technique = create("cohog", {"camera": "nadir"})
    turned, allowed, _ = technique._views_of(technique.encode(picture))._picture_of(1.0, 5)
    assert (zlib.crc32(turned), zlib.crc32(allowed)) == (1188350251, 19798888)
