"""Results of an evaluation, and their quality figures (thesis 2.7 and 6.3.1), as pure functions of the best match of
every query.

`scores`, float (N,), is the score of each query's best match, -inf if it has none. `ranks`, float (N,), is the rank,
from 0, of its first correct reference, infinite if there is none. `has_match`, bool (N,), is True if its place is in
the map. A match is accepted if its score reaches the threshold. Each threshold gives one point of the precision-recall
curve: precision is the fraction of accepted matches that are correct, recall the fraction of correct matches that are
accepted. Numbers like (2.1) are equations of the thesis."""

import math
from collections.abc import Iterable
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

Interval = tuple[float, float]  # lower end, upper end
_SIGMAS_95 = 1.959964  # 95 % of a normal distribution lies within this many standard deviations


@dataclass(frozen=True, slots=True, kw_only=True)
class Figures:
    """Quality figures of `queries` queries; all fractions are 0..1, and each recall has its 95 % confidence interval.

    `auc_from_zero` is the area under the curve with an extra first point at recall 0, as in scikit-learn and VPR-Bench;
    `auc_2_3` is the area by equation 2.3; `ep` is the extended precision (2.4). Recall at 100 % precision is relative
    to the correct best matches (VPR-Bench), or to the queries whose place is in the map (VPR_Tutorial). `roc_auc` is
    None if all best matches are correct, or none is. `precision_recall` lists the points (precision, recall) of the
    curve, from the highest threshold down."""

    queries: int
    recall_at_1: float
    recall_at_5: float
    recall_at_10: float
    recall_at_1_interval: Interval
    recall_at_5_interval: Interval
    recall_at_10_interval: Interval
    precision_at_100_recall: float
    recall_at_100_precision_vpr_bench: float
    recall_at_100_precision_vpr_tutorial: float
    auc_from_zero: float
    auc_2_3: float
    ep: float
    roc_auc: float | None
    precision_recall: tuple[tuple[float, float], ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class TechniqueResult(Figures):
    """Result of a technique (in one form) on a data set: the figures of all scored queries, its weights and its cost.

    `queries_off_map` of the queries have no place in the map, so all their matches are wrong. `with_match` are the
    figures of the others alone (None: all queries, or none). `unscored` queries have no ground truth.
    `queries_copied` are also references.

    `accepted`, `accepted_wrong`, `accepted_off_map`, `accepted_elsewhere` and `discarded` count queries by the fields
    of `evaluate.QueryAnswer`; a discarded query counts as missed. Times are means over the queries: `t_match_s` is for
    all references, `t_match_per_ref_s` for one. `u_encode` and `u_match` are the busy fractions of all cores,
    0..1 (5.1). `descriptor_bytes` and `fine_bytes` are the RAM and disk space per place, as in `profile`. `ah_total` is
    the charge drawn from the battery pack for all queries, in Ah (5.7); `ah_assumes` states board, pack and efficiency.
    `sequence`: number of queries matched together. `known`: see `evaluate.MatchOptions`. `weights`: origin of the
    network's weights (None: no network). `not_done`: sentences on steps of `map build` that failed for this map.
    `pcu`: set by `add_pcu`, because it depends on all techniques compared."""

    technique: str
    references: int
    queries_off_map: int = 0
    unscored: int = 0
    queries_copied: int = 0
    with_match: Figures | None = None
    parameters: dict[str, int | float | str]
    accepted: int
    accepted_wrong: int
    accepted_off_map: int = 0
    accepted_elsewhere: int
    t_encode_s: float
    t_match_s: float
    t_match_per_ref_s: float
    descriptor_bytes: int
    fine_bytes: int
    u_encode: float
    u_match: float
    ah_total: float
    ah_assumes: str
    sequence: int = 1
    known: str | None = None
    discarded: int = 0
    weights: str | None = None
    not_done: tuple[str, ...] = ()
    pcu: float | None = None


def rank_of_first_correct(ranked: np.ndarray, correct: np.ndarray) -> float:
    """Return the rank, from 0, of the first correct reference; infinite if there is none. `ranked` are the indices of
    references, best first. `correct`, bool (references,), is True for correct references."""
    hits = np.flatnonzero(correct[ranked])
    return float(hits[0]) if len(hits) else math.inf


def precision_recall(scores: np.ndarray, correct: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compute the curve with a threshold at each distinct score, from the highest down: precision (2.1) and recall
    (2.2), float (points,). `correct`, bool (N,), is True for correct matches. If none is correct, recall is 0."""
    scores, correct = np.asarray(scores, float), np.asarray(correct, bool)
    order = np.argsort(-scores, kind="stable")[: np.count_nonzero(scores > -math.inf)]
    if not len(order):
        return np.zeros(1), np.zeros(1)
    sorted_scores = scores[order]
    last = np.append(np.flatnonzero(sorted_scores[1:] != sorted_scores[:-1]), len(order) - 1)
    true_positives = np.cumsum(correct[order])[last]
    accepted = last + 1
    return true_positives / accepted, true_positives / max(int(correct.sum()), 1)


def auc_2_3(precision: np.ndarray, recall: np.ndarray) -> float:
    """Compute the area under the precision-recall curve by equation 2.3, without an extra point at recall 0. Even for a
    perfect technique it is therefore at most (N-1)/N, and 0 if all scores are equal."""
    return float(np.trapezoid(precision, recall))


def auc_from_zero(precision: np.ndarray, recall: np.ndarray) -> float:
    """Compute the area under the precision-recall curve with an extra first point at recall 0 and precision 1, as
    scikit-learn's `auc(*precision_recall_curve(...))` and most papers do. It is 1 for a perfect technique, whether or
    not scores are tied."""
    return float((1 + precision[0]) / 2 * recall[0]) + auc_2_3(precision, recall)


def precision_at_100_recall(precision: np.ndarray, recall: np.ndarray) -> float:
    """Return the precision with the threshold at the lowest-scoring correct match: never below recall@1."""
    return float(precision[np.argmax(recall)])


def roc_auc(scores: np.ndarray, correct: np.ndarray) -> float | None:
    """Compute the area under the ROC curve: the probability that a correct match scores higher than a wrong one, with
    ties counting half. None if all matches are correct, or none is."""
    scores, correct = np.asarray(scores), np.asarray(correct, bool)
    correct_scores, wrong_scores = scores[correct], np.sort(scores[~correct])
    if not len(correct_scores) or not len(wrong_scores):
        return None
    below = np.searchsorted(wrong_scores, correct_scores, "left")
    below_or_equal = np.searchsorted(wrong_scores, correct_scores, "right")
    return float(np.mean((below + below_or_equal) / 2) / len(wrong_scores))


def pcu(precision: float, t_encode_s: float, t_encode_max_s: float) -> float:
    """Compute the performance per compute unit (6.3.1): precision at 100 % recall times log10(t_e,max / t_e + 9).
    `t_encode_max_s` is the encoding time of the slowest technique compared, whose PCU is its precision."""
    return precision * math.log10(t_encode_max_s / t_encode_s + 9)


def wilson_interval(hits: np.ndarray) -> Interval:
    """Return the 95 % confidence interval of the fraction of `hits`, bool (N,), by Wilson's score (1927)."""
    mean, spread = float(np.mean(hits)), _SIGMAS_95**2 / len(hits)
    half = math.sqrt(spread * (mean * (1 - mean) + spread / 4))
    return max(0.0, (mean + spread / 2 - half) / (1 + spread)), min(1.0, (mean + spread / 2 + half) / (1 + spread))


def compute_figures(scores: np.ndarray, ranks: np.ndarray, has_match: np.ndarray) -> Figures:
    """Compute the figures of at least one query."""
    correct = ranks == 0
    precision, recall = precision_recall(scores, correct)
    recall_at_100 = float(recall[precision == 1].max(initial=0))  # at 100 % precision; 0 if the best match is wrong
    recalls: dict[str, Any] = {f"recall_at_{k}": float(np.mean(ranks < k)) for k in (1, 5, 10)}
    recalls |= {f"recall_at_{k}_interval": wilson_interval(ranks < k) for k in (1, 5, 10)}
    return Figures(
        queries=len(scores),
        **recalls,
        precision_at_100_recall=precision_at_100_recall(precision, recall),
        recall_at_100_precision_vpr_bench=recall_at_100,
        recall_at_100_precision_vpr_tutorial=recall_at_100 * int(correct.sum()) / max(int(has_match.sum()), 1),
        auc_from_zero=auc_from_zero(precision, recall),
        auc_2_3=auc_2_3(precision, recall),
        ep=(float(precision[0]) + recall_at_100) / 2,
        roc_auc=roc_auc(scores, correct),
        precision_recall=tuple(zip(precision.round(5).tolist(), recall.round(5).tolist(), strict=True)),
    )


def compute_quality(scores: np.ndarray, ranks: np.ndarray, has_match: np.ndarray) -> dict[str, Any]:
    """Return the fields of a `TechniqueResult`, by name, that are computed from the answers: the figures of all
    queries, and of those whose place is in the map."""
    figures = compute_figures(scores, ranks, has_match)
    is_mixed = has_match.any() and not has_match.all()
    return {
        **{field.name: getattr(figures, field.name) for field in fields(Figures)},
        "queries_off_map": int((~has_match).sum()),
        "with_match": compute_figures(*(part[has_match] for part in (scores, ranks, has_match))) if is_mixed else None,
    }


def add_pcu(results: Iterable[TechniqueResult]) -> list[TechniqueResult]:
    """Return the results with the PCU (see `pcu`) added. It depends on the slowest encoder among them."""
    results = list(results)
    slowest_s = max((result.t_encode_s for result in results), default=0.0)
    return [
        replace(result, pcu=pcu(result.precision_at_100_recall, result.t_encode_s, slowest_s)) for result in results
    ]
