"""The three forms of a vector, against literal transcriptions place by place."""

import tracemalloc

import numpy as np
import pytest

from edgevpr.core.errors import ModelError, UsageError
from edgevpr.techniques.vectors import FORMS, VectorTechnique

LENGTH = 131  # no multiple of anything


class Vectors(VectorTechnique):
    """Encodes the vector that the test hands it as the image."""

    def __init__(self, form="float", similarity="cosine", length=LENGTH):
        super().__init__("given", length, form=form, margins=(0.1, 0.2, 0.3), similarity=similarity)

    def make_vector(self, image, mask):
        return image


def make_vectors(count=40, seed=0, length=LENGTH):
    """Vectors with a large common part, as those of networks have."""
    return (1.0 + np.random.default_rng(seed).normal(0, 0.3, (count, length))).astype(np.float32)


def make_rows(form, similarity, vectors):
    """Technique, coarse parts, their mean, and the rows of the index."""
    technique = Vectors(form, similarity, vectors.shape[1])
    coarse = np.stack([technique.encode(vector).coarse for vector in vectors])
    mean = coarse.astype(np.float32).mean(axis=0)
    rows = technique.pack(coarse, mean) if technique.spec.packed else coarse
    assert rows.shape[1:] == technique.spec.row.shape
    assert rows.dtype == np.dtype(technique.spec.row.dtype)
    return technique, coarse, mean, rows


def literal_score(form, similarity, query, place, mean):
    """One place, in the words of the module."""
    query, place, mean = (each.astype(np.float64) for each in (query, place, mean))
    if form == "1bit":
        return sum((q > m) == (p > m) for q, p, m in zip(query, place, mean, strict=True)) / len(mean)
    if form == "8bit":
        query, place = query - mean, place - mean
        largest = max(abs(place))
        place = np.array([round(value / largest * 127) for value in place]) * largest / 127
    if similarity == "cosine":
        cosine = float(query @ place) / np.sqrt(float(query @ query) * float(place @ place))
        return max(cosine, 0.0) if form == "float" else (1 + cosine) / 2
    return 1 / (1 + sum(abs(q - p) for q, p in zip(query, place, strict=True)))


@pytest.mark.parametrize("similarity", ["cosine", "l1"])
@pytest.mark.parametrize("form", FORMS)
def test_score_places_equals_the_literal_loop(form, similarity):
    technique, coarse, mean, rows = make_rows(form, similarity, make_vectors())
    query = technique.encode(make_vectors(1, seed=5)[0])
    scores, hypotheses = technique.score_places(query, rows, mean)
    assert hypotheses is None
    assert scores.dtype == np.float32
    expected = [literal_score(form, similarity, query.coarse, place, mean) for place in coarse]
    np.testing.assert_allclose(scores, expected, atol=1e-3)


@pytest.mark.parametrize("form", FORMS)
def test_score_places_is_finite_for_one_place_or_identical_places(form):
    technique, coarse, mean, rows = make_rows(form, "cosine", np.repeat(make_vectors(1), 3, axis=0))
    for query in (coarse[0], make_vectors(1, seed=3)[0], np.zeros(LENGTH)):
        scores, _ = technique.score_places(technique.encode(query.astype(np.float32)), rows, mean)
        assert np.isfinite(scores).all()
        assert ((scores >= 0) & (scores <= 1)).all()


def test_form_has_its_own_default_margin():
    assert [Vectors(form).min_margin for form in FORMS] == [0.1, 0.2, 0.3]
    with pytest.raises(UsageError, match="2bit"):
        Vectors("2bit")


def test_encode_refuses_values_beyond_half_precision():
    with pytest.raises(ModelError, match="half-precision range"):
        Vectors(similarity="l1").encode(np.full(LENGTH, 1e6, np.float32))
    assert Vectors().encode(np.full(LENGTH, 1e6, np.float32)).quality == 1


def test_encode_gives_quality_zero_for_a_zero_vector():
    assert Vectors().encode(np.zeros(LENGTH, np.float32)).quality == 0
    assert Vectors(similarity="l1").encode(np.full(LENGTH, 1e-9, np.float32)).quality == 0  # zeros in half precision
    assert Vectors().encode(make_vectors(1)[0]).quality == 1


@pytest.mark.parametrize("form", FORMS)
def test_score_places_is_zero_for_a_blank_image_even_against_another(form):
    technique, nothing = Vectors(form), Vectors().encode(np.zeros(LENGTH, np.float32))
    coarse = np.stack([nothing.coarse, *(technique.encode(place).coarse for place in make_vectors(5))])
    mean = coarse.astype(np.float32).mean(axis=0)
    rows = coarse if form == "float" else technique.pack(coarse, mean)
    assert not technique.score_places(nothing, rows, mean)[0].any()


@pytest.mark.parametrize("similarity", ["cosine", "l1"])
@pytest.mark.parametrize("form", FORMS)
def test_score_places_needs_little_memory_besides_the_rows(form, similarity):
    technique, _, mean, rows = make_rows(form, similarity, make_vectors(16, length=4096))
    many = np.resize(rows, (8192, rows.shape[1]))  # as float32 all of them would be 134 MB
    query = technique.encode(make_vectors(1, length=4096)[0])
    tracemalloc.start()
    scores, _ = technique.score_places(query, many, mean)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    np.testing.assert_array_equal(scores[:16], scores[-16:])
    assert peak < 12e6
