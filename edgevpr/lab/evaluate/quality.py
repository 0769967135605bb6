"""Every figure of how well a technique recognises, from the best match of every query alone."""

from dataclasses import dataclass

import numpy as np

from edgevpr.lab.evaluate import metrics

Interval = tuple[float, float]
SEED, RESAMPLES = 0, 2000  # of the intervals


@dataclass(frozen=True, slots=True, kw_only=True)
class Quality:
    """Quality of a technique on a data set. Each recall has the 95 % interval of what other queries of the same kind
    would give (None: without SciPy). `auc` is by 2.3, and `auc_from_zero` as scikit-learn has it. `precision_recall`
    are the points of the curve, from the highest threshold down. `roc_auc` is None if all best matches are right, or
    none is."""

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


def figures(scores: np.ndarray, ranks: np.ndarray) -> dict[str, object]:
    """Return all figures of a `Quality` but its names and counts. `scores`, float (N,), are those of the best matches,
    `ranks`, float (N,), the ranks of the first right references (see `metrics.first_right`)."""
    precision, recall = metrics.precision_recall(scores, ranks == 0)
    recalls = {f"recall_at_{k}": metrics.recall_at(k, ranks) for k in (1, 5, 10)}
    return {
        **recalls,
        **{f"recall_at_{k}_interval": interval(ranks < k) for k in (1, 5, 10)},
        "precision_at_100_recall": metrics.precision_at_100_recall(precision, recall),
        "recall_at_100_precision": metrics.recall_at_100_precision(precision, recall),
        "auc": metrics.auc(precision, recall),
        "auc_from_zero": metrics.auc_from_zero(precision, recall),
        "ep": metrics.extended_precision(precision, recall),
        "roc_auc": metrics.roc_auc(scores, ranks == 0),
        "precision_recall": tuple(zip(precision.round(5).tolist(), recall.round(5).tolist(), strict=True)),
    }


def interval(hits: np.ndarray) -> Interval | None:
    """Return the 95 % interval of the share of hits, bool (N,), by resampling the queries. Where all hit, or none does,
    no resampling knows better, and the interval is the exact one of Clopper and Pearson. None without SciPy."""
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
