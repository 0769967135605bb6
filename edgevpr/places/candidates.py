"""The places that a query is compared with: those with the best scores of the scan, and under which hypotheses."""

import numpy as np

_TRIED_EACH = 6  # hypotheses of a place

Chosen = tuple[int, list[int] | None]  # a slot, and the hypotheses to try (None: all)


def best_scanned(scanned: np.ndarray, by_hypothesis: np.ndarray | None, among: np.ndarray, count: int) -> list[Chosen]:
    """Choose the `count` best-scanned slots where `among` bool (N,) is True, and the hypotheses to try of each (None:
    all). They come in the order of the map file, in which a card reads them fastest.

    With `by_hypothesis` float32 (N, H) (see `Technique.coarse_scores`), the best hypotheses of all places together are
    chosen instead: `count` times six, or `count` times a third of the mean number possible for a place where that is
    less. So a place with only two likely hypotheses leaves room for other places. One place gets six hypotheses at
    most, or more where there are too few places.
    """
    slots = np.flatnonzero(among)
    if by_hypothesis is None or not len(slots):
        return [(slot, None) for slot in slots[np.sort(_largest(scanned[slots], count))].tolist()]
    possible = np.isfinite(by_hypothesis[slots]).sum(axis=1).mean()
    tries = round(count * max(1.0, min(_TRIED_EACH, possible / 3)))
    slots = slots[np.sort(_largest(scanned[slots], tries))]
    scores = by_hypothesis[slots]
    of_place = np.argsort(np.argsort(-scores, axis=1, kind="stable"), axis=1)
    scores = np.where(of_place < max(_TRIED_EACH, tries // len(slots)), scores, -np.inf)
    tried = np.zeros(scores.shape, bool)
    tried.flat[_largest(scores.ravel(), tries)] = True
    tried &= np.isfinite(scores)
    return [(int(slots[at]), np.flatnonzero(tried[at]).tolist()) for at in np.flatnonzero(tried.any(axis=1))]


def every_possible(by_hypothesis: np.ndarray, among: np.ndarray) -> list[Chosen]:
    """Choose all slots where `among` bool (N,) is True, and of each all hypotheses that are not ruled out."""
    slots = np.flatnonzero(among).tolist()
    return [(slot, np.flatnonzero(np.isfinite(by_hypothesis[slot])).tolist()) for slot in slots]


def _largest(scores: np.ndarray, count: int) -> np.ndarray:
    """Return the indices of the `count` largest of scores (N,), in no order."""
    return np.argpartition(-scores, count)[:count] if count < len(scores) else np.arange(len(scores))
