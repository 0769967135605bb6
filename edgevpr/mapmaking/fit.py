"""Fitting of the model of confidence: on the machine that makes maps, never in flight."""

from collections.abc import Sequence

import numpy as np
from scipy.optimize import minimize

from edgevpr.runtime.recognise.confidence import Evidence, Logistic, Tail

_FEWEST = 5  # wrong matches in a tail
_LEAST_SCALE = 0.05


def matrix(rows: Sequence[Evidence], names: Sequence[str]) -> np.ndarray:
    """Return evidence as a matrix, float64 (N, F)."""
    return np.array([[row[name] for name in names] for row in rows], float).reshape(len(rows), len(names))


def nothing_known(names: Sequence[str], scales: Sequence[float]) -> Logistic:
    """Return the regression from which the first one is fitted: no evidence weighs anything."""
    return Logistic(tuple(names), (0.0,) * len(names), tuple(map(float, scales)), 0.0)


def fitted(start: Logistic, rows: Sequence[Evidence], right: np.ndarray, weights: np.ndarray, pull: float) -> Logistic:
    """Fit a logistic regression to rows that are `right` or not, bool (N,), with `weights` float (N,).

    The most probable one, where weights times scales are expected around those of `start` with the variance 1 / `pull`
    (a Gaussian prior; the bias is free). With few rows it stays at `start`.
    """
    scales, mine = np.array(start.scales), matrix(rows, start.names) / np.array(start.scales)
    middle = np.array(start.weights) * scales
    sign = np.where(right, 1.0, -1.0)

    def cost(at: np.ndarray) -> tuple[float, np.ndarray]:
        logit = mine @ at[:-1] + at[-1]
        off = at[:-1] - middle
        loss = weights @ np.logaddexp(0, -sign * logit) + pull / 2 * off @ off
        slope = -weights * sign * np.exp(-np.logaddexp(0, sign * logit))
        return float(loss), np.append(mine.T @ slope + pull * off, slope.sum())

    found = minimize(cost, np.append(middle, start.bias), jac=True, method="L-BFGS-B").x
    return Logistic(start.names, tuple((found[:-1] / scales).tolist()), start.scales, float(found[-1]))


def tail_of(wrong: np.ndarray, shares: np.ndarray, part: float) -> Tail:
    """Fit the tail of the logits of wrong matches, float (N,), each of which is this share of all matches, float (N,):
    to the highest `part` of them."""
    order = np.argsort(-wrong, kind="stable")
    wrong, shares = wrong[order], shares[order]
    count = max(_FEWEST, int(np.searchsorted(np.cumsum(shares), part * shares.sum())) + 1)
    start, high, weight = float(wrong[min(count, len(wrong) - 1)]), wrong[:count], shares[:count]
    return Tail(start, float(weight.sum()), max(float(weight @ (high - start) / weight.sum()), _LEAST_SCALE))
