"""The figures against literal transcriptions of the equations, and against published similarity matrices."""

import math
from itertools import pairwise

import numpy as np
import pytest

from edgevpr.lab.evaluate import metrics


def literal_curve(scores, correct):
    """2.1 and 2.2, one threshold after the other."""
    points = []
    for threshold in sorted(set(scores), reverse=True):
        true_positives = sum(1 for s, c in zip(scores, correct, strict=True) if c and s >= threshold)
        false_positives = sum(1 for s, c in zip(scores, correct, strict=True) if not c and s >= threshold)
        false_negatives = sum(1 for s, c in zip(scores, correct, strict=True) if c and s < threshold)
        right = true_positives + false_negatives
        points.append((true_positives / (true_positives + false_positives), true_positives / right if right else 0.0))
    return points


def literal_auc(points):
    """2.3, term by term."""
    total = 0.0
    for (p, r), (p_next, r_next) in pairwise(points):
        total += (p + p_next) / 2 * (r_next - r)
    return total


def literal_roc_auc(scores, correct):
    wins = [
        1.0 if right > wrong else 0.5 if right == wrong else 0.0
        for right, is_right in zip(scores, correct, strict=True)
        if is_right
        for wrong, also_right in zip(scores, correct, strict=True)
        if not also_right
    ]
    return sum(wins) / len(wins) if wins else None


@pytest.mark.parametrize("distinct", [3, 7, 1000])
@pytest.mark.parametrize("share_right", [0.1, 0.5, 0.9])
def test_the_curve_and_its_figures_agree_with_a_literal_transcription(distinct, share_right):
    random = np.random.default_rng(distinct)
    for _ in range(20):
        scores = random.integers(distinct, size=40) / distinct
        correct = random.random(40) < share_right
        precision, recall = metrics.precision_recall(scores, correct)
        points = literal_curve(scores.tolist(), correct.tolist())
        assert np.array_equal(np.column_stack([precision, recall]), points)
        assert metrics.auc(precision, recall) == pytest.approx(literal_auc(points), abs=1e-12)
        full_recall = [p for p, r in points if r == 1]
        assert metrics.precision_at_100_recall(precision, recall) == (full_recall[0] if full_recall else 0)
        certain = max([r for p, r in points if p == 1], default=0)
        assert metrics.recall_at_100_precision(precision, recall) == certain
        smallest = min(r for _, r in points)
        highest = max(p for p, r in points if r == smallest)
        assert metrics.extended_precision(precision, recall) == (highest + certain) / 2
        expected = literal_roc_auc(scores.tolist(), correct.tolist())
        assert metrics.roc_auc(scores, correct) == (expected if expected is None else pytest.approx(expected))


def test_recall_at_k_counts_queries_with_a_right_reference_among_the_first_k():
    right = np.array([False, True, False, True])
    ranks = [metrics.first_right(np.array(order), right) for order in ([1, 0, 2, 3], [0, 2, 3, 1], [2, 0])]
    assert ranks == [0, 2, math.inf]
    assert metrics.recall_at(1, ranks) == 1 / 3
    assert metrics.recall_at(2, ranks) == 1 / 3
    assert metrics.recall_at(3, ranks) == 2 / 3
    assert metrics.recall_at(10, ranks) == 2 / 3


def test_an_ignored_reference_leaves_its_rank_to_the_next():
    ranked, ignored = np.array([3, 2, 0, 1]), np.array([True, False, False, True])
    at = metrics.counting(ranked, ignored)
    assert at.tolist() == [1, 3]
    assert metrics.first_right(ranked[at], right=np.array([False, True, False, False])) == 1


def test_pcu_of_the_slowest_technique_is_its_precision():
    assert metrics.pcu(0.62, 0.83, 0.83) == pytest.approx(0.62)
    # Table 6.1: CoHOG on Gardens Point, 0.90 at 0.02 s against Cross-Region-BoW's 0.83 s.
    assert metrics.pcu(0.90, 0.02, 0.83) == pytest.approx(0.9 * math.log10(50.5))
