"""`seqslam`: the picture and the enhanced difference against the paper, word by word, and maps of any size."""

import math

import cv2
import numpy as np
from pictures import draw_texture

from edgevpr.techniques.seqslam import SeqSlam


def literal_levels(picture, patch=8):
    """Patch normalisation (section III.A), in the eight bits that are kept."""
    height, width = picture.shape
    levels = np.full((height, width), 128)
    for top in range(0, height, patch):
        for left in range(0, width, patch):
            here = slice(top, top + patch), slice(left, left + patch)
            pixels = picture[here].astype(float)
            if pixels.std() > 0:
                levels[here] = np.clip(np.round(28 * (pixels - pixels.mean()) / pixels.std()) + 128, 0, 255)
    return levels


def literal_enhanced(differences, window=10):
    """Local contrast enhancement (equation 2): around each place, as far as the map goes."""
    result = []
    for i, difference in enumerate(differences):
        around = np.array(differences[max(0, i - window // 2) : i + window // 2 + 1])
        deviation = around.std(ddof=1)
        result.append((difference - around.mean()) / deviation if deviation else 0.0)
    return np.array(result)


def test_encode_makes_the_image_of_the_paper():
    technique = SeqSlam()
    picture = draw_texture(3)
    small = cv2.resize(picture, (64, 32), interpolation=cv2.INTER_AREA)
    made = technique.encode(picture)
    assert made.coarse.dtype == np.uint8
    assert made.coarse.nbytes == 2048
    # Single against double precision: a value that lies between two levels may fall either way.
    difference = np.abs(made.coarse.reshape(32, 64).astype(int) - literal_levels(small))
    assert difference.max() <= 1
    assert np.count_nonzero(difference) <= 2


def test_encode_ignores_light_and_contrast_and_marks_flat_patches():
    technique = SeqSlam()
    picture = np.random.default_rng(1).integers(0, 100, (32, 64), np.uint8)
    np.testing.assert_array_equal(technique.encode(picture).coarse, technique.encode(2 * picture + 40).coarse)
    assert technique.encode(picture).quality == 1
    picture[:8, :16] = 7
    flat = technique.encode(picture)
    assert flat.quality == 1 - 2 / 32
    assert (flat.coarse.reshape(32, 64)[:8, :16] == 128).all()


def test_score_places_equals_the_enhanced_differences_of_the_paper():
    technique = SeqSlam()
    rows = np.stack([technique.encode(draw_texture(seed)).coarse for seed in range(40)])
    query = technique.encode(cv2.convertScaleAbs(draw_texture(17), alpha=0.7))
    scores, hypotheses = technique.score_places(query, rows, None)
    differences = [sum(abs(int(a) - int(b)) for a, b in zip(row, query.coarse, strict=True)) / 2048 for row in rows]
    np.testing.assert_allclose(scores, 0.5 - literal_enhanced(differences) / (2 * 10 / math.sqrt(11)), atol=1e-6)
    assert hypotheses is None
    assert scores.dtype == np.float32
    assert scores.argmax() == 17
    assert scores.min() >= 0
    assert scores.max() <= 1
