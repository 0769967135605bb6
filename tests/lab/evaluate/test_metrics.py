"""The figures of quality: small cases worked out by hand, and any scores at all by scikit-learn."""

import csv
import math
import os
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from edgevpr.lab.evaluate import metrics
from edgevpr.lab.evaluate.dataset import list_names, read_truth

DATA = Path(os.environ.get("EDGEVPR_DATA") or Path(__file__).parents[4] / "shared" / "data")
PUBLISHED = DATA / "vprbench_precomputed"
NEVER = math.inf


def measure_queries(*queries):
    """The figures of queries (score, rank of the first right reference[, False: its place is not in the map])."""
    scores, ranks, has_match = zip(*((*query, True)[:3] for query in queries), strict=True)
    return SimpleNamespace(**metrics.compute_quality(np.array(scores), np.array(ranks), np.array(has_match)))


def test_compute_quality_of_a_perfect_run_with_ties():
    found = measure_queries((0.9, 0), (0.9, 0), (0.5, 0), (0.5, 0))
    assert (found.auc_from_zero, found.auc_2_3) == (1, 0.5), "equation 2.3 of the thesis counts ties as half"
    assert (found.ep, found.precision_at_100_recall, found.roc_auc) == (1, 1, None)
    assert found.recall_at_100_precision_vpr_bench == found.recall_at_100_precision_vpr_tutorial == 1
    assert (found.queries_off_map, found.with_match) == (0, None)


def test_compute_quality_counts_queries_off_the_map():
    # By falling score: right, off the map, right, wrong (third), right.
    found = measure_queries((0.9, 0), (0.8, NEVER, False), (0.7, 0), (0.6, 2), (0.5, 0))
    assert (found.queries, found.queries_off_map) == (5, 1)
    assert (found.recall_at_1, found.recall_at_5) == (3 / 5, 4 / 5)
    # Points (recall, precision): (1/3, 1), (1/3, 1/2), (2/3, 2/3), (2/3, 1/2), (1, 3/5).
    assert found.auc_2_3 == pytest.approx((1 / 2 + 2 / 3) / 6 + (1 / 2 + 3 / 5) / 6)
    assert found.auc_from_zero == pytest.approx(found.auc_2_3 + 1 / 3)
    assert found.recall_at_100_precision_vpr_bench == pytest.approx(1 / 3), "of three right best matches"
    assert found.recall_at_100_precision_vpr_tutorial == pytest.approx(1 / 4), "of four queries with a match"
    assert found.ep == pytest.approx((1 + 1 / 3) / 2)
    assert found.roc_auc == pytest.approx((2 + 1 + 0) / 6)
    without = found.with_match
    assert (without.queries, without.recall_at_1) == (4, 3 / 4)
    # (1/3, 1), (2/3, 1), (2/3, 2/3), (1, 3/4)
    assert without.auc_2_3 == pytest.approx(1 / 3 + (2 / 3 + 3 / 4) / 6)
    assert without.recall_at_100_precision_vpr_tutorial == pytest.approx(2 / 4)
    assert without.ep == pytest.approx((1 + 2 / 3) / 2)


@pytest.mark.parametrize("score", [0.3, -math.inf])
def test_compute_quality_without_any_match(score):
    found = measure_queries((score, NEVER, False), (score, NEVER, False))
    assert (found.queries_off_map, found.with_match) == (2, None)
    shares = (found.recall_at_10, found.auc_from_zero, found.auc_2_3, found.ep, found.precision_at_100_recall)
    assert shares == (0, 0, 0, 0, 0)
    assert (found.recall_at_100_precision_vpr_tutorial, found.roc_auc) == (0, None)


def test_precision_recall_never_accepts_a_query_without_a_match():
    precision, recall = metrics.precision_recall([-math.inf, 0.5, -math.inf], [False, True, False])
    assert (precision.tolist(), recall.tolist()) == ([1], [1])


def test_rank_of_first_correct_is_the_rank_of_the_first_correct_reference():
    right = np.array([False, True, False, True])
    assert [metrics.rank_of_first_correct(np.array(order), right) for order in ([1, 0], [0, 2, 3, 1], [2, 0])] == [
        0,
        2,
        NEVER,
    ]


def test_pcu_of_the_slowest_technique_is_its_precision():
    assert metrics.pcu(0.62, 0.83, 0.83) == pytest.approx(0.62)
    # Table 6.1: CoHOG on Gardens Point, 0.90 at 0.02 s against Cross-Region-BoW's 0.83 s.
    assert metrics.pcu(0.90, 0.02, 0.83) == pytest.approx(0.9 * math.log10(50.5))


@pytest.mark.parametrize(("right", "of"), [(0, 1), (0, 20), (13, 20), (20, 20)])
def test_wilson_interval_equals_published_values(right, of):
    from scipy import stats

    expected = stats.binomtest(right, of).proportion_ci(method="wilson")
    assert metrics.wilson_interval(np.arange(of) < right) == pytest.approx((expected.low, expected.high), abs=1e-6)


# Few distinct scores, so that ties are usual; and the rank of the first right one, infinite where there is none.
QUERIES = st.lists(st.tuples(st.integers(-3, 3), st.sampled_from([0.0, 1.0, 7.0, NEVER])), min_size=1, max_size=60)


@pytest.mark.slow
@settings(deadline=None)
@given(QUERIES)
def test_compute_figures_equal_those_of_scikit_learn(queries):
    import sklearn.metrics  # takes a second, which every process of the tests would spend to collect this file

    scores, ranks = (np.array(column, float) for column in zip(*queries, strict=True))
    right = ranks == 0
    found = metrics.compute_figures(scores, ranks, np.isfinite(ranks))
    assert found.recall_at_1 == right.mean()
    if not right.any():
        return
    # As VPR-Bench does, of all queries: performance_comparison.py.
    precision, recall, _ = sklearn.metrics.precision_recall_curve(right, scores)
    assert found.auc_from_zero == pytest.approx(sklearn.metrics.auc(recall, precision), abs=1e-12)
    certain = max(recall[:-1][precision[:-1] == 1], default=0)
    assert found.recall_at_100_precision_vpr_bench == certain
    assert found.ep == pytest.approx((precision[-2] + certain) / 2)
    assert found.precision_at_100_recall == max(precision[recall == 1])
    # As VPR_Tutorial does: evaluation/metrics.py, with a threshold at every score.
    accepted = [right[scores >= threshold] for threshold in np.unique(scores)]
    certain = max((each.sum() for each in accepted if each.all()), default=0) / np.isfinite(ranks).sum()
    assert found.recall_at_100_precision_vpr_tutorial == pytest.approx(certain)
    if not right.all():
        assert found.roc_auc == pytest.approx(sklearn.metrics.roc_auc_score(right, scores), abs=1e-12)


@pytest.mark.data
def test_compute_figures_gives_the_published_figures_of_eight_matrices():
    if not PUBLISHED.is_dir():
        pytest.skip("the published matrices are not here")
    references, truth = list_names(DATA / "corridor" / "ref"), read_truth(DATA / "corridor" / "ground_truth.csv")
    correct = np.array([[name in answers[0] for name in references] for answers in truth.values()])
    with open(PUBLISHED / "corridor_figures.csv") as handle:
        published = {row.pop("technique"): row for row in csv.DictReader(handle)}
    assert len(published) == 8
    ours = {"auc_eq_2_3": "auc_2_3", "auc_scikit_learn": "auc_from_zero"}
    for name, row in published.items():
        scores = np.load(PUBLISHED / f"corridor_{name}.npy")
        ranks = [
            metrics.rank_of_first_correct(np.argsort(-row, kind="stable"), is_correct)
            for row, is_correct in zip(scores, correct, strict=True)
        ]
        found = metrics.compute_figures(scores.max(axis=1), np.array(ranks), correct.any(axis=1))
        for figure, value in row.items():
            if not figure.startswith("t_"):
                assert getattr(found, ours.get(figure, figure)) == pytest.approx(float(value), abs=5e-4)
        if name == "CALC":
            assert found.recall_at_100_precision_vpr_bench == pytest.approx(8 / 36)
            assert found.recall_at_100_precision_vpr_tutorial == pytest.approx(8 / 111)
