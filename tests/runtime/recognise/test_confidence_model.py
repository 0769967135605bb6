"""The model of confidence: what holds of the shipped ones, whatever their figures."""

import math

import pytest

from edgevpr.runtime.recognise.confidence import as_json, from_json, prior, probability
from edgevpr.runtime.recognise.evidence import OF_MAP, OF_PLACE, require_usable

KINDS = tuple(OF_MAP)


def evidence_of(kind, value):
    return dict.fromkeys(OF_MAP[kind] + OF_PLACE[kind], value)


@pytest.mark.parametrize("kind", KINDS)
def test_there_is_a_shipped_model_of_each_kind_that_knows_its_evidence(kind):
    model = prior(kind)
    require_usable(kind, model)
    assert model.made_of
    assert from_json(as_json(model)) == model


@pytest.mark.parametrize("kind", KINDS)
def test_a_confidence_is_a_probability_whatever_the_evidence(kind):
    for value in (-3.0, -1.0, 0.0, 1.0, 3.0):
        assert 0 <= prior(kind).confidence(evidence_of(kind, value)) <= 1


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_evidence_that_is_not_finite_makes_nothing_sure(kind, value):
    model = prior(kind)
    assert model.confidence(evidence_of(kind, 0.0) | {"agree": value, "coverage": value}) < model.threshold(0.9)


@pytest.mark.parametrize("kind", KINDS)
def test_more_precision_needs_more_confidence(kind):
    needed = [prior(kind).threshold(precision) for precision in (0.5, 0.9, 0.99, 0.999, 0.999999)]
    assert needed == sorted(needed)
    assert needed[0] < needed[-1]


@pytest.mark.parametrize("text", ["", "[]", "7", "{}", '{"of_map": 1}', "[" * 100_000, '{"of_map": NaN}'])
def test_a_text_that_is_no_model_is_refused(text):
    with pytest.raises(ValueError, match=r"."):
        from_json(text)


def test_a_probability_never_overflows():
    assert (probability(-1e308), probability(0.0), probability(1e308)) == (pytest.approx(0), 0.5, pytest.approx(1))
