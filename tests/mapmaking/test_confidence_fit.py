"""Fitting of a regression: it finds what rows say, and stays where it started as far as they say nothing."""

import numpy as np
import pytest

from edgevpr.mapmaking.calibrate import fitted
from edgevpr.runtime.recognise.confidence import Logistic

START = Logistic(("a", "b"), (0.0, 0.0), (1.0, 2.0), 0.0)


def rows_of(count, seed=1):
    """Rows of which `a` tells whether they are right, and `b` nothing."""
    rng = np.random.default_rng(seed)
    right = rng.random(count) < 0.5
    return [{"a": float(is_right + rng.normal(0, 0.5)), "b": float(2 * rng.normal())} for is_right in right], right


def test_what_tells_right_from_wrong_weighs_and_the_rest_does_not():
    rows, right = rows_of(2000)
    found = fitted(START, rows, right, np.ones(len(rows)), 1.0)
    # Two normal distributions, 1 apart with the variance 0.25: the logit is 4 (a - 0.5).
    assert found.weights == (pytest.approx(4, abs=0.5), pytest.approx(0, abs=0.15))
    assert found.bias == pytest.approx(-2, abs=0.4)
    assert (found.names, found.scales) == (START.names, START.scales)


def test_a_strong_pull_keeps_the_weights_and_only_the_bias_follows():
    rows, right = rows_of(200)
    start = fitted(START, *rows_of(2000, seed=2), np.ones(2000), 1.0)
    found = fitted(start, rows, np.zeros(len(right), bool), np.ones(len(rows)), 1e6)
    assert found.weights == pytest.approx(start.weights, abs=0.01)
    assert found.bias < start.bias - 1


def test_rows_count_by_their_weights():
    rows, right = [{"a": 0.0, "b": 0.0}] * 2, np.array([True, False])
    found = fitted(START, rows, right, np.array([9.0, 1.0]), 1.0)
    assert found.bias == pytest.approx(np.log(9), abs=1e-3)
