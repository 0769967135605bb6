"""Results of an evaluation, and their quality figures (thesis 2.7 and 6.3.1), as pure functions of the best match of
every query.

`scores` is float (N,): the score of each query's best match, -inf for a query that found none. `ranks` is float (N,):
the rank, from 0, of its first right reference, infinite if there is none. `has_match` is bool (N,): whether its place
is in the map. A match is accepted when its score is at least the threshold. So each threshold gives a precision, the
share of right ones among the accepted matches, and a recall, the share of accepted ones among the right matches, and
these are the curve. Numbers like (2.1) are equations of the thesis.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

Interval = tuple[float, float]  # lower end, upper end
_SIGMAS_95 = 1.959964  # of a normal distribution, within which 95 % lie


@dataclass(frozen=True, slots=True, kw_only=True)
class Figures:
    """Figures of quality of `queries`; all shares are 0..1, and each recall has its 95 % confidence interval.

    `auc_from_zero` is the area under the curve with a first point at recall 0, as scikit-learn and VPR-Bench compute
    it, `auc_2_3` that by equation 2.3, `ep` the extended precision (2.4). R@100P is the recall at 100 % precision: of
    the right best matches (VPR-Bench), and of the queries whose place is in the map (VPR_Tutorial). `roc_auc` is None
    if all best matches are right, or none is. `precision_recall` are the points (precision, recall) of the curve, from
    the highest threshold down."""

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
class Quality(Figures):
    """Quality of a technique on a data set: the figures of all queries that are scored.

    `queries_off_map` of them have no place in the map, where every match is wrong. `with_match` are the figures of the
    others alone (None: they are all queries, or there are none). `unscored` queries have no truth to score them by."""

    technique: str
    references: int
    queries_off_map: int = 0
    unscored: int = 0
    with_match: Figures | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class TechniqueResult(Quality):
    """Result of a technique (in one form) on a data set: its quality, its weights and its cost.

    `accepted`, `accepted_wrong`, `accepted_off_map`, `accepted_elsewhere` and `discarded` count queries by the fields
    of `evaluate.QueryAnswer`; a discarded query counts as missed. Times are means over the queries: `t_match_s` is for
    all references, `t_match_per_ref_s` for one. `u_encode` and `u_match` are the shares of all cores that were busy,
    0..1 (5.1). `descriptor_bytes` and `fine_bytes` are the RAM and the disk of a place, as in `profile`. Charges are
    for all queries, in Ah (5.7), from the battery pack; `ah_assumes` names board, pack and efficiency. `sequence`: how
    many queries were matched together. `known`: that of `evaluate.MatchOptions`. `weights`: origin of the network's
    weights (None: no network). `not_done`: sentences on what `map build` does to a map and could not be done to this
    one. `pcu`: filled in by `add_pcu`, since it depends on all techniques compared.
    """

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


def rank_first_right(ranked: np.ndarray, right: np.ndarray) -> float:
    """Return the rank, from 0, of the first right reference; infinite if there is none. `ranked` are numbers of
    references, best first. `right`, bool (references,), is True for those that are right."""
    hits = np.flatnonzero(right[ranked])
    return float(hits[0]) if len(hits) else math.inf


def precision_recall(scores: np.ndarray, correct: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compute the curve with the threshold at every distinct score, from the highest down: precision (2.1) and recall
    (2.2), float (points,). `correct`, bool (N,), tells right matches. If none is right, recall is taken to be 0."""
    scores, correct = np.asarray(scores, float), np.asarray(correct, bool)
    order = np.argsort(-scores, kind="stable")[: np.count_nonzero(scores > -math.inf)]
    if not len(order):
        return np.zeros(1), np.zeros(1)
    falling = scores[order]
    last = np.append(np.flatnonzero(falling[1:] != falling[:-1]), len(order) - 1)
    true_positives = np.cumsum(correct[order])[last]
    accepted = last + 1
    return true_positives / accepted, true_positives / max(int(correct.sum()), 1)


def auc_2_3(precision: np.ndarray, recall: np.ndarray) -> float:
    """Compute the area under the precision-recall curve by equation 2.3: only the points that occur, no extra one at
    recall 0. So it is at most (N-1)/N, and 0 if all scores are the same, even of a faultless technique."""
    return float(np.trapezoid(precision, recall))


def auc_from_zero(precision: np.ndarray, recall: np.ndarray) -> float:
    """Compute the area under the precision-recall curve with an extra first point at recall 0 and precision 1, as
    scikit-learn's `auc(*precision_recall_curve(...))` and most papers do. It is 1 for a faultless technique, whatever
    the ties."""
    return float((1 + precision[0]) / 2 * recall[0]) + auc_2_3(precision, recall)


def recall_at_100_precision(precision: np.ndarray, recall: np.ndarray) -> float:
    """Return the largest recall at which every accepted match is right; 0 if the best-scoring match is wrong."""
    return float(recall[precision == 1].max(initial=0))


def precision_at_100_recall(precision: np.ndarray, recall: np.ndarray) -> float:
    """Return the precision with the threshold at the lowest-scoring right match: never below recall@1."""
    return float(precision[np.argmax(recall)])


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


def wilson_interval(hits: np.ndarray) -> Interval:
    """Return the 95 % confidence interval of the share of `hits`, bool (N,), by Wilson's score (1927)."""
    share, spread = float(np.mean(hits)), _SIGMAS_95**2 / len(hits)
    half = math.sqrt(spread * (share * (1 - share) + spread / 4))
    return max(0.0, (share + spread / 2 - half) / (1 + spread)), min(1.0, (share + spread / 2 + half) / (1 + spread))


def compute_figures(scores: np.ndarray, ranks: np.ndarray, has_match: np.ndarray) -> Figures:
    """Compute the figures of one query or more."""
    correct = ranks == 0
    precision, recall = precision_recall(scores, correct)
    recall_at_100 = recall_at_100_precision(precision, recall)
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
    """Return the fields of a `Quality`, by name, that follow from the answers: the figures of all queries, and of those
    whose place is in the map."""
    figures = compute_figures(scores, ranks, has_match)
    is_mixed = has_match.any() and not has_match.all()
    return {
        **{field.name: getattr(figures, field.name) for field in fields(Figures)},
        "queries_off_map": int((~has_match).sum()),
        "with_match": compute_figures(*(part[has_match] for part in (scores, ranks, has_match))) if is_mixed else None,
    }


def add_pcu(results: Iterable[TechniqueResult]) -> list[TechniqueResult]:
    """Return the results with the PCU (see `pcu`) filled in. It depends on the slowest encoder among them."""
    results = list(results)
    slowest_s = max((result.t_encode_s for result in results), default=0.0)
    return [
        replace(result, pcu=pcu(result.precision_at_100_recall, result.t_encode_s, slowest_s)) for result in results
    ]


def read_result(row: dict[str, Any]) -> TechniqueResult:
    """Return the result whose fields are in `row`, as read from JSON. Other keys of `row` are left out."""
    values = {field.name: row[field.name] for field in fields(TechniqueResult) if field.name in row}
    return TechniqueResult(**{**values, "with_match": values.get("with_match") and Figures(**values["with_match"])})
