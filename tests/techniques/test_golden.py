"""The techniques against the literal transcription of chapter 6."""

from functools import cache

import literal
import numpy as np
import pytest
from pictures import draw_texture

from edgevpr.techniques import create, entropy

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("seed", [1, 2])
def test_compute_filled_bins_equals_the_printed_algorithm(seed):
    image = draw_texture(seed, 70, 45)
    np.testing.assert_allclose(entropy.compute_filled_bins(image), literal.filled_bins(image), atol=1e-6)


def test_compute_filled_bins_stays_below_one_at_radius_5():
    all_different = np.add.outer(11 * np.arange(20), np.arange(20)).astype(np.uint8)  # in any 11x11 pixels
    assert entropy.compute_filled_bins(all_different).max() == pytest.approx(np.log2(81) / 8, abs=1e-6)


def test_compute_shannon_equals_the_entropy_of_each_disc():
    image = draw_texture(4, 128, 128)
    np.testing.assert_allclose(entropy.compute_shannon(image), literal.shannon(image), atol=1e-5)


@cache  # these loops are slow
def literal_grey(seed):
    return literal.grey_square(draw_texture(seed), 208)


@cache
def literal_blocks(seed):
    return literal.blocks(literal.cell_histograms(literal_grey(seed), 16, 8, True))


@cache
def literal_entropy(seed, which):
    return getattr(literal, which)(literal.levels(literal_grey(seed)))


@pytest.mark.parametrize(("which", "threshold"), [("filled_bins", 0.5), ("shannon", 0.4), ("shannon", 0.55)])
def test_cohog_descriptor_good_regions_and_score(which, threshold):
    technique = create("cohog", {"w1": 208, "w2": 16, "gt": threshold, "entropy": which, "matching": "thesis"})
    query, reference = technique.encode(draw_texture(6)), technique.encode(draw_texture(7))

    good = literal.good_blocks(literal_entropy(6, which), 16, threshold)
    query_blocks, reference_blocks = literal_blocks(6), literal_blocks(7)
    assert 0 < good.sum() < len(good), "the picture must have good and confusing regions"
    np.testing.assert_array_equal(query.good, good)
    np.testing.assert_allclose(query.regions, query_blocks, atol=1e-4)
    assert technique.match(query, reference.fine).score == pytest.approx(
        literal.regional_match(query_blocks, good, reference_blocks),
        abs=2e-3,  # a place is kept in 8 bits
    )


def test_hog_is_the_cosine_of_whole_image_histograms():
    technique = create("hog", {"w1": 64})
    images = [draw_texture(8), draw_texture(9)]
    vectors = []
    for image in images:
        cells = literal.cell_histograms(literal.grey_square(image, 64), 8, 9, False)
        vector = literal.blocks(cells).ravel()
        vectors.append(vector / np.linalg.norm(vector))
    query, other = (technique.encode(image) for image in images)
    scores, _ = technique.score_places(query, np.stack([query.coarse, other.coarse]))
    np.testing.assert_allclose(query.coarse, vectors[0], atol=2e-4)  # half precision
    np.testing.assert_allclose(scores, [1.0, vectors[0] @ vectors[1]], atol=1e-3)
