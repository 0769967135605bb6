"""The figures of quality, by scikit-learn and for any scores at all: with ties, one query, none right, all right."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from edgevpr.lab.evaluate import metrics
from edgevpr.lab.evaluate.metrics import figures, interval


def test_recall_at_counts_queries_with_a_right_reference_among_the_first_k():
    right = np.array([False, True, False, True])
    ranks = [metrics.first_right(np.array(order), right) for order in ([1, 0, 2, 3], [0, 2, 3, 1], [2, 0])]
    assert ranks == [0, 2, math.inf]
    assert metrics.recall_at(1, ranks) == 1 / 3
    assert metrics.recall_at(2, ranks) == 1 / 3
    assert metrics.recall_at(3, ranks) == 2 / 3
    assert metrics.recall_at(10, ranks) == 2 / 3


def test_pcu_of_the_slowest_technique_is_its_precision():
    assert metrics.pcu(0.62, 0.83, 0.83) == pytest.approx(0.62)
    # Table 6.1: CoHOG on Gardens Point, 0.90 at 0.02 s against Cross-Region-BoW's 0.83 s.
    assert metrics.pcu(0.90, 0.02, 0.83) == pytest.approx(0.9 * math.log10(50.5))


# Few distinct scores, so that ties are usual; and the rank of the first right one, infinite where there is none.
QUERIES = st.lists(
    st.tuples(st.integers(-3, 3), st.sampled_from([0.0, 1.0, 4.0, 7.0, 30.0, float("inf")])), min_size=1, max_size=60
)


def arrays(queries):
    scores, ranks = (np.array(column, float) for column in zip(*queries, strict=True))
    return scores, ranks


@pytest.mark.slow
@settings(deadline=None)
@given(QUERIES)
def test_figures_are_shares_that_fit_each_other(queries):
    scores, ranks = arrays(queries)
    found, right = figures(scores, ranks), ranks == 0
    shares = [value for key, value in found.items() if isinstance(value, float)]
    assert all(0 <= share <= 1 for share in shares)
    assert found["recall_at_1"] <= found["recall_at_5"] <= found["recall_at_10"]
    assert found["recall_at_1"] == right.mean()
    assert found["auc"] <= found["auc_from_zero"] + 1e-12
    if right.any():
        assert found["precision_at_100_recall"] >= found["recall_at_1"] - 1e-12
    else:
        assert found["auc"] == found["recall_at_100_precision"] == 0
    if right.all():
        assert found["precision_at_100_recall"] == found["recall_at_100_precision"] == found["auc_from_zero"] == 1
    assert (found["roc_auc"] is None) == (right.all() or not right.any())


@pytest.mark.slow
@settings(deadline=None)
@given(QUERIES)
def test_figures_equal_those_of_scikit_learn(queries):
    sklearn = pytest.importorskip("sklearn.metrics")
    scores, ranks = arrays(queries)
    right = ranks == 0
    if not right.any():
        return
    precision, recall = metrics.precision_recall(scores, right)
    theirs = sklearn.precision_recall_curve(right, scores)
    ours = np.column_stack([precision, recall])
    assert np.allclose(ours, np.column_stack([theirs[0][-2::-1], theirs[1][-2::-1]])[: len(ours)])
    assert metrics.auc_from_zero(precision, recall) == pytest.approx(sklearn.auc(theirs[1], theirs[0]), abs=1e-12)
    assert metrics.auc(precision, recall) == pytest.approx(np.trapezoid(precision, recall), abs=1e-12)
    assert metrics.precision_at_100_recall(precision, recall) == max(precision[recall == 1])
    certain = max(recall[precision == 1], default=0)
    assert metrics.recall_at_100_precision(precision, recall) == certain
    highest = max(precision[recall == min(recall)])
    assert metrics.compute_extended_precision(precision, recall) == (highest + certain) / 2
    if not right.all():
        assert metrics.roc_auc(scores, right) == pytest.approx(sklearn.roc_auc_score(right, scores), abs=1e-12)


@pytest.mark.slow
def test_interval_covers_the_share_that_the_queries_were_drawn_with():
    random = np.random.default_rng(5)
    covered = 0
    for _ in range(200):
        low, high = interval(random.random(100) < 0.8)
        covered += low <= 0.8 <= high
    assert covered > 0.88 * 200
