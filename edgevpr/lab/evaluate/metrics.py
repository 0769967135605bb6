"""Results of an evaluation, and their quality figures (thesis 2.7 and 6.3.1), as pure functions of the best match of
every query.

`scores` is float (N,): the score of each query's best match. `correct` is bool (N,): whether that match is right. A
match is accepted when its score is at least the threshold; false negatives are right matches below the threshold. So
each threshold gives a precision and a recall, and these are the curve. Numbers like (2.1) are equations of the thesis.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

Interval = tuple[float, float]  # lower end, upper end
SEED, RESAMPLES = 0, 2000  # of the bootstrap that gives the intervals


@dataclass(frozen=True, slots=True, kw_only=True)
class Quality:
    """Quality of a technique on a data set; all shares are 0..1. Each recall has its 95 % confidence interval (None: no
    SciPy, see `interval`). `auc` is by equation 2.3, `auc_from_zero` as scikit-learn computes it, `ep` the extended
    precision. `precision_recall` are the points (precision, recall) of the curve, from the highest threshold down.
    `roc_auc` is None if all best matches are right, or none is."""

    technique: str
    queries: int
    references: int
    recall_at_1: float
    recall_at_5: float
    recall_at_10: float
    recall_at_1_interval: Interval | None = None
    recall_at_5_interval: Interval | None = None
    recall_at_10_interval: Interval | None = None
    precision_at_100_recall: float
    recall_at_100_precision: float
    auc: float
    auc_from_zero: float | None = None
    ep: float
    roc_auc: float | None
    precision_recall: tuple[tuple[float, float], ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class TechniqueResult(Quality):
    """Result of a technique (in one form) on a data set: its quality, its weights and its cost.

    `accepted`, `accepted_wrong`, `accepted_elsewhere` and `discarded` count queries by the fields of
    `evaluate.QueryAnswer`; a discarded query counts as missed. Times are means over the queries: `t_match_s` is for all
    references, `t_match_per_ref_s` for one. `u_encode` and `u_match` are the shares of all cores that were busy, 0..1
    (5.1). `descriptor_bytes` and `fine_bytes` are the RAM and the disk of a place, as in `profile`. Charges are for all
    queries, in Ah (5.7), from the battery pack; `ah_assumes` names board, pack and efficiency. `sequence`: how many
    queries were matched together. `known`: that of `evaluate.MatchOptions`. `weights`: origin of the network's weights
    (None: no network). `pcu`: filled in by `compare`, since it depends on all techniques compared.
    """

    parameters: dict[str, int | float | str]
    accepted: int
    accepted_wrong: int
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
    pcu: float | None = None


def first_right(ranked: np.ndarray, right: np.ndarray) -> float:
    """Return the rank, from 0, of the first right reference; infinite if there is none. `ranked` are numbers of
    references, best first. `right`, bool (references,), is True for those that are right."""
    hits = np.flatnonzero(right[ranked])
    return float(hits[0]) if len(hits) else math.inf


def recall_at(k: int, ranks: np.ndarray) -> float:
    """Return the share of queries with a right reference among their first `k`. `ranks` (N,) are by `first_right`."""
    return float(np.mean(np.asarray(ranks) < k))


def precision_recall(scores: np.ndarray, correct: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compute the curve with the threshold at every distinct score, from the highest down: precision (2.1) and recall
    (2.2), float (points,). If no match at all is right, recall is taken to be 0."""
    scores, correct = np.asarray(scores), np.asarray(correct, bool)
    order = np.argsort(-scores, kind="stable")
    last_of_its_score = np.append(np.flatnonzero(np.diff(scores[order])), len(scores) - 1)
    true_positives = np.cumsum(correct[order])[last_of_its_score]
    accepted = last_of_its_score + 1
    return true_positives / accepted, true_positives / max(int(correct.sum()), 1)


def auc(precision: np.ndarray, recall: np.ndarray) -> float:
    """Compute the area under the precision-recall curve (2.3): only the points that occur, no extra one at recall 0. So
    it is at most (N-1)/N, and 0 if all scores are the same."""
    return float(np.trapezoid(precision, recall))


def auc_from_zero(precision: np.ndarray, recall: np.ndarray) -> float:
    """Compute the area under the precision-recall curve with an extra first point at recall 0 and precision 1, as
    scikit-learn and most papers do."""
    return float((1 + precision[0]) / 2 * recall[0]) + auc(precision, recall)


def recall_at_100_precision(precision: np.ndarray, recall: np.ndarray) -> float:
    """Return the largest recall at which every accepted match is right; 0 if the best-scoring match is wrong."""
    return float(recall[precision == 1].max(initial=0))


def precision_at_100_recall(precision: np.ndarray, recall: np.ndarray) -> float:
    """Return the precision with the threshold at the lowest-scoring right match: never below recall@1."""
    return float(precision[np.argmax(recall)])


def compute_extended_precision(precision: np.ndarray, recall: np.ndarray) -> float:
    """Compute EP (2.4): the mean of the precision at the smallest recall and the recall at 100 % precision."""
    return float(precision[0] + recall_at_100_precision(precision, recall)) / 2


def roc_auc(scores: np.ndarray, correct: np.ndarray) -> float | None:
    """Compute the area under the ROC curve: the chance that a right match scores higher than a wrong one. Ties count
    half. None if all matches are right, or none is."""
    scores, correct = np.asarray(scores), np.asarray(correct, bool)
    right, wrong = scores[correct], np.sort(scores[~correct])
    if not len(right) or not len(wrong):
        return None
    below = np.searchsorted(wrong, right, "left")
    below_or_equal = np.searchsorted(wrong, right, "right")
    return float(np.mean((below + below_or_equal) / 2) / len(wrong))


def pcu(precision: float, t_encode_s: float, t_encode_max_s: float) -> float:
    """Compute the performance per compute unit (6.3.1): precision at 100 % recall times log10(t_e,max / t_e + 9).
    `t_encode_max_s` is the encoding time of the slowest technique compared, whose PCU is its precision."""
    return precision * math.log10(t_encode_max_s / t_encode_s + 9)


def figures(scores: np.ndarray, ranks: np.ndarray) -> dict[str, Any]:
    """Return the fields of a `Quality`, by name, except `technique` and the counts. `ranks`, float (N,), are the ranks
    of the first right references (see `first_right`)."""
    precision, recall = precision_recall(scores, ranks == 0)
    return {
        **{f"recall_at_{k}": recall_at(k, ranks) for k in (1, 5, 10)},
        **{f"recall_at_{k}_interval": interval(ranks < k) for k in (1, 5, 10)},
        "precision_at_100_recall": precision_at_100_recall(precision, recall),
        "recall_at_100_precision": recall_at_100_precision(precision, recall),
        "auc": auc(precision, recall),
        "auc_from_zero": auc_from_zero(precision, recall),
        "ep": compute_extended_precision(precision, recall),
        "roc_auc": roc_auc(scores, ranks == 0),
        "precision_recall": tuple(zip(precision.round(5).tolist(), recall.round(5).tolist(), strict=True)),
    }


def interval(hits: np.ndarray) -> Interval | None:
    """Return the 95 % confidence interval of the share of `hits`, bool (N,), by resampling the queries (bootstrap). If
    all or none hit, every resample gives the same share; then it is the exact interval of Clopper and Pearson. None if
    SciPy is not installed."""
    try:
        from scipy import stats
    except ModuleNotFoundError:
        return None
    if hits.all() or not hits.any():
        exact = stats.binomtest(int(hits.sum()), len(hits)).proportion_ci()
        return float(exact.low), float(exact.high)
    found = stats.bootstrap(
        (hits.astype(float),), np.mean, n_resamples=RESAMPLES, method="percentile", random_state=SEED
    )
    return float(found.confidence_interval.low), float(found.confidence_interval.high)


def compare(results: Iterable[TechniqueResult]) -> list[TechniqueResult]:
    """Return the results with the PCU (see `pcu`) filled in. It depends on the slowest encoder among them."""
    results = list(results)
    slowest_s = max((result.t_encode_s for result in results), default=0.0)
    return [
        replace(result, pcu=pcu(result.precision_at_100_recall, result.t_encode_s, slowest_s)) for result in results
    ]


def from_json(row: dict[str, Any]) -> TechniqueResult:
    """Return the result whose fields are in `row`, as read from JSON. Other keys of `row` are left out."""
    return TechniqueResult(**{field.name: row[field.name] for field in fields(TechniqueResult) if field.name in row})
