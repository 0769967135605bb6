"""The heads against their literal transcriptions."""

import literal_heads as literal
import numpy as np
import pytest

from edgevpr.core.errors import ModelError
from edgevpr.techniques import network, regions, words


def make_feature_map(seed: int, channels: int = 6, height: int = 7, width: int = 9, dead: float = 0.6) -> np.ndarray:
    """Activations after a rectifier: a share `dead` of them is zero."""
    rng = np.random.default_rng(seed)
    alive = rng.random((channels, height, width)) > dead
    return (rng.random((channels, height, width)) * alive).astype(np.float32)


ROW_OF_SEED_7 = [0.15039823515226958, -0.14438709403072972, 0.4993904215846324, 0.9576440672550305, 0.4428030662190366]
SIGNS_OF_SEED_7 = [-1.0, 1.0, 1.0, -1.0, -1.0]
SIGNED = np.random.default_rng(9).normal(size=(5, 7, 9)).astype(np.float32)


@pytest.mark.parametrize("levels", [1, 4, 7])
def test_pool_pyramid_equals_the_literal_loop(levels):
    expected = literal.pyramid(SIGNED, range(1, levels + 1)).astype(np.float32)
    np.testing.assert_array_equal(network.pool_pyramid(SIGNED, levels), expected)


def test_make_square_regions_refuses_too_small_a_map():
    with pytest.raises(ModelError, match="R-MAC"):
        regions.make_square_regions(1, 30)


@pytest.mark.parametrize(("size", "length"), [(60, 20), (61, 61), (2, 1)])
def test_projection_equals_the_product_with_its_matrix(size, length):
    vector = np.random.default_rng(3).normal(size=size).astype(np.float32)
    row, signs = network.make_gaussian_row(size, seed=5)
    project = network.make_gaussian_projection(size, length, seed=5)
    expected = literal.project_vector(vector, row, signs, length)
    np.testing.assert_allclose(project(vector), expected, rtol=1e-4, atol=1e-5)


def test_make_gaussian_row_is_reproducible():
    row, signs = network.make_gaussian_row(5, seed=7)
    np.testing.assert_allclose(row, ROW_OF_SEED_7, rtol=1e-12)
    assert signs.tolist() == SIGNS_OF_SEED_7


@pytest.mark.parametrize("shape", [(15, 20), (13, 13), (20, 15), (7, 30), (2, 2), (4, 5)])
def test_make_square_regions_equals_the_literal_loop(shape):
    assert regions.make_square_regions(*shape) == literal.rmac_regions(*shape)


def test_pool_squares_equals_the_literal_loop():
    where = regions.make_square_regions(7, 9)
    vectors = regions.pool_squares(SIGNED, where)
    np.testing.assert_allclose(vectors, literal.rmac_vectors(SIGNED, where), rtol=1e-5, atol=1e-6)
    expected = literal.normalise_rows(literal.rmac_vectors(SIGNED, where).sum(axis=0))
    np.testing.assert_allclose(words.normalise_rows(vectors.sum(axis=0)), expected, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("soft", [None, 3.0, 50.0])
def test_compute_vlad_equals_the_literal_loop(soft):
    local = words.make_local_descriptors(SIGNED)
    np.testing.assert_allclose(np.linalg.norm(local, axis=1), 1, rtol=1e-5)
    np.testing.assert_allclose(local[9 + 2], SIGNED[:, 1, 2] / np.linalg.norm(SIGNED[:, 1, 2]), rtol=1e-5)
    known = words.normalise_rows(np.random.default_rng(6).normal(size=(8, 5))).astype(np.float32)
    expected = literal.intra_normalised(literal.vlad(local, known, soft))
    np.testing.assert_allclose(words.compute_vlad(local, known, soft), expected, rtol=1e-3, atol=1e-4)


def test_compute_vlad_leaves_an_unused_word_zero():
    local = np.tile(np.float32([[1, 0]]), (4, 1))
    known = np.float32([[0.9, 0.1], [-1, 0]])
    np.testing.assert_allclose(words.compute_vlad(local, known), [0.70710678, -0.70710678, 0, 0], atol=1e-6)


def test_compute_sharpness_weights_a_word_a_hundred_times_the_next():
    known = np.float32([[0, 0], [3, 0], [0, 3], [3, 3]])
    weights = words.compute_soft_weights(known, known, words.compute_sharpness(known))
    nearest_two = np.sort(weights, axis=1)[:, :-3:-1]
    np.testing.assert_allclose(nearest_two[:, 0] / nearest_two[:, 1], 100, rtol=1e-4)


@pytest.mark.parametrize(("dead", "count"), [(0.6, 12), (0.6, 10_000), (0.9, 30), (1.0, 10)])
def test_find_regions_returns_the_most_energetic_connected_activations(dead, count):
    features = make_feature_map(7, channels=5, dead=dead)
    boxes = regions.find_regions(features, count)
    expected = literal.regions(features, count)
    assert len(boxes) == len(expected)
    described = regions.describe_regions(features, boxes)
    assert described.shape == (len(expected), 5)
    for box, vector, (_, pixels, _) in zip(boxes, described, expected, strict=True):
        ys, xs = zip(*pixels, strict=True)
        assert box.tolist() == [min(ys), min(xs), max(ys) + 1, max(xs) + 1]
        np.testing.assert_allclose(vector, literal.sum_box(features, pixels), rtol=1e-4, atol=1e-5)


def test_equal_regions_are_sorted_by_channel_and_position():
    features = np.zeros((2, 5, 5), np.float32)
    features[:, 0, 4] = features[:, 0, 0] = features[:, 4, 2] = 1
    assert regions.find_regions(features, 4)[:, :2].tolist() == [[0, 0], [0, 4], [4, 2], [0, 0]]


def test_score_mutual_pairs_equals_the_literal_loop():
    rng = np.random.default_rng(8)
    query, place = words.normalise_rows(rng.normal(size=(6, 4))), words.normalise_rows(rng.normal(size=(9, 4)))
    assert regions.score_mutual_pairs(query, place) == pytest.approx(literal.mutual_score(query, place))
    assert regions.score_mutual_pairs(query, query) == pytest.approx(1)
    assert regions.score_mutual_pairs(query, np.zeros((9, 4))) == 0
    padded = np.concatenate([place, np.zeros((5, 4))])
    assert regions.score_mutual_pairs(query, padded) == pytest.approx(regions.score_mutual_pairs(query, place))


def test_to_bytes_keeps_directions_in_8_bits():
    vectors = np.concatenate([words.normalise_rows(np.random.default_rng(9).normal(size=(20, 64))), np.zeros((1, 64))])
    back = regions.from_bytes(regions.to_bytes(vectors.astype(np.float32)))
    assert (np.einsum("nd,nd->n", back, vectors)[:20] > 0.9998).all()
    assert not back[20].any()
