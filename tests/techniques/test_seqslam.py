"""`seqslam`: the picture and the enhanced difference against the paper, word by word, and maps of any size."""

import math

import cv2
import numpy as np
from pictures import textured

from edgevpr.techniques.seqslam import SeqSlam


def literal_levels(picture, patch=8):
    """Patch normalisation (section III.A), a pixel at a time, in the eight bits that are kept."""
    height, width = picture.shape
    levels = np.full((height, width), 128)
    for top in range(0, height, patch):
        for left in range(0, width, patch):
            pixels = [float(picture[y, x]) for y in range(top, top + patch) for x in range(left, left + patch)]
            mean = sum(pixels) / len(pixels)
            deviation = math.sqrt(sum((pixel - mean) ** 2 for pixel in pixels) / len(pixels))
            if deviation == 0:
                continue
            for y in range(top, top + patch):
                for x in range(left, left + patch):
                    levels[y, x] = min(max(round(28 * (float(picture[y, x]) - mean) / deviation) + 128, 0), 255)
    return levels


def literal_enhanced(differences, window=10):
    """Local contrast enhancement (equation 2): around each place, as far as the map goes."""
    result = []
    for i, difference in enumerate(differences):
        around = [float(differences[j]) for j in range(len(differences)) if abs(j - i) <= window // 2]
        mean = sum(around) / len(around)
        squares = sum((each - mean) ** 2 for each in around)
        result.append((difference - mean) / math.sqrt(squares / (len(around) - 1)) if squares else 0.0)
    return np.array(result)


def rows_of(technique, count, first=0):
    return np.stack([technique.encode(textured(first + seed)).coarse for seed in range(count)])


def test_the_picture_is_that_of_the_paper():
    technique = SeqSlam()
    picture = textured(3)
    small = cv2.resize(picture, (64, 32), interpolation=cv2.INTER_AREA)
    made = technique.encode(picture)
    assert made.coarse.dtype == np.uint8
    assert made.coarse.nbytes == 2048
    # Single against double precision: a value that lies between two levels may fall either way.
    difference = np.abs(made.coarse.reshape(32, 64).astype(int) - literal_levels(small))
    assert difference.max() <= 1
    assert np.count_nonzero(difference) <= 2


def test_light_and_contrast_change_nothing_and_a_flat_patch_says_so():
    technique = SeqSlam()
    rng = np.random.default_rng(1)
    picture = rng.integers(0, 100, (32, 64), np.uint8)
    np.testing.assert_array_equal(technique.encode(picture).coarse, technique.encode(2 * picture + 40).coarse)
    assert technique.encode(picture).quality == 1
    picture[:8, :16] = 7
    flat = technique.encode(picture)
    assert flat.quality == 1 - 2 / 32
    assert (flat.coarse.reshape(32, 64)[:8, :16] == 128).all()


def test_scores_are_the_enhanced_mean_absolute_differences_of_the_paper():
    technique = SeqSlam()
    rows = rows_of(technique, 40)
    query = technique.encode(cv2.convertScaleAbs(textured(17), alpha=0.7))
    scores, hypotheses = technique.coarse_scores(query, rows, None)
    differences = [sum(abs(int(a) - int(b)) for a, b in zip(row, query.coarse, strict=True)) / 2048 for row in rows]
    np.testing.assert_allclose(scores, 0.5 - literal_enhanced(differences) / (2 * 10 / math.sqrt(11)), atol=1e-6)
    assert hypotheses is None
    assert scores.dtype == np.float32
    assert scores.argmax() == 17
    assert scores.min() >= 0
    assert scores.max() <= 1
