"""Retrieval of the places that a query may show: one scan of the index, then a full comparison of the best ones."""

from dataclasses import dataclass, replace

import numpy as np

from edgevpr.contract import Descriptor, FineMatch, Technique
from edgevpr.errors import MapError
from edgevpr.geodesy import distance_m
from edgevpr.places.index import PlaceIndex
from edgevpr.places.mapfile import PlaceMap
from edgevpr.types import Candidate

_NEIGHBOURS_WITHOUT_POSITION = 2
_COMPARED_ELSEWHERE = 5
_TRIED_EACH = 6  # hypotheses of a place

_Chosen = tuple[int, list[int] | None]  # a slot, and the hypotheses to try (None: all)


@dataclass(frozen=True, slots=True)
class Expected:
    """Knowledge about the place of a query before the search (None: nothing known). `in_reach` bool (N,), at least one
    True, tells which places the aircraft can be at. `turned_deg` float (N,) is the expected rotation of the camera
    since each place was mapped (see `Technique.coarse_scores`)."""

    in_reach: np.ndarray | None = None
    turned_deg: np.ndarray | None = None


NOTHING = Expected()


@dataclass(frozen=True, slots=True)
class Scan:
    """The result of scanning all rows of the index: `scores` float32 (N,). Where a comparison has several hypotheses
    to try, `by_hypothesis` float32 (N, H) has the score of each, -inf for one that is ruled out; else None."""

    scores: np.ndarray
    by_hypothesis: np.ndarray | None


@dataclass(frozen=True, slots=True)
class Ranking:
    """Places best first: `slots` int (K,) of the index and `scores` float32 (K,). `compared` maps the slot of each
    place that was compared in full to its match, which has the same score."""

    slots: np.ndarray
    scores: np.ndarray
    compared: dict[int, FineMatch]


def scan(technique: Technique, query: Descriptor, index: PlaceIndex, expected: Expected = NOTHING) -> Scan:
    """Score all places of the index by their rows, in one product."""
    hint = {} if expected.turned_deg is None else {"turned_deg": expected.turned_deg}
    return Scan(*technique.coarse_scores(query, index.rows, index.mean, **hint))


def compare(
    technique: Technique,
    query: Descriptor,
    scanned: Scan,
    place_map: PlaceMap,
    index: PlaceIndex,
    *,
    candidates: int | None = None,
    neighbour_m: float = 0.0,
    expected: Expected = NOTHING,
) -> Ranking:
    """Compare the `candidates` places with the best scan scores in full, and rank them.

    Where `candidates` is None, or is at least the number of places and more than the technique's own number, all
    places are compared under every hypothesis, unless `expected` narrows them: exact, but slow. Neighbours of the best
    place are the places within `neighbour_m` metres of it. Where all candidates are its neighbours, the best-scanned
    places elsewhere are compared as well, because the margin needs one of them. A technique without a fine part is
    ranked by the scan.

    Where the scan counts (see `TechniqueSpec.scan_counts`), the score is that of the comparison times the mean of the
    scan score and 1: for a wrong place the two scores have little to do with each other.

    Where `expected.in_reach` is known, the candidates are places in reach, and five places out of reach are compared
    as well: a false expectation would otherwise hide the right place behind the best of the wrong ones. At least five
    places elsewhere are then compared, because a margin over fewer says little. Raises MapError for a place that
    cannot be read.
    """
    matches: dict[int, FineMatch] = {}
    one_stage = technique.spec.fine is None

    def scored(chosen: list[_Chosen]) -> list[float]:
        if one_stage:
            return scanned.scores[[slot for slot, _ in chosen]].tolist()
        for slot, hypotheses in chosen:
            match = technique.match(query, place_map.fine_part(index.place_ids[slot]), hypotheses)
            if technique.spec.scan_counts:
                match = replace(match, score=match.score * (1 + float(scanned.scores[slot])) / 2)
            matches[slot] = match
        return [matches[slot].score for slot, _ in chosen]

    scores, by_hypothesis, in_reach = scanned.scores, scanned.by_hypothesis, expected.in_reach
    exact = candidates is None or technique.candidates < candidates >= len(index)
    if one_stage or exact:
        candidates = len(index)
    if exact and in_reach is None and expected.turned_deg is None:
        by_hypothesis = None  # all are tried
    there = np.ones(len(index), bool) if in_reach is None else in_reach
    chosen = best_scanned(scores, by_hypothesis, there, candidates)
    chosen += best_scanned(scores, by_hypothesis, ~there, _COMPARED_ELSEWHERE)
    found = scored(chosen)
    slots = np.array([slot for slot, _ in chosen])
    if len(slots) < len(index):
        best = slots[np.argmax(found)]
        rivals = np.count_nonzero(elsewhere(index, best, slots, neighbour_m))
        if rivals < (1 if in_reach is None else _COMPARED_ELSEWHERE):
            others = elsewhere(index, best, np.arange(len(index)), neighbour_m)
            others[slots] = False
            more = best_scanned(scores, by_hypothesis, others, _COMPARED_ELSEWHERE - rivals)
            found += scored(more)
            slots = np.append(slots, [slot for slot, _ in more]).astype(np.intp)
    best_first = np.array(found, np.float32)
    order = np.argsort(-best_first, kind="stable")
    return Ranking(slots[order], best_first[order], matches)


def best_scanned(scanned: np.ndarray, by_hypothesis: np.ndarray | None, among: np.ndarray, count: int) -> list[_Chosen]:
    """Choose the `count` best-scanned slots where `among` bool (N,) is True, and the hypotheses to try of each (None:
    all).

    With `by_hypothesis` float32 (N, H) (see `Technique.coarse_scores`), the best hypotheses of all places together are
    chosen instead: `count` times six, or `count` times the mean number possible for a place where that is less. So a
    place with only two likely hypotheses leaves room for other places. One place gets six hypotheses at most, or more
    where there are too few places.
    """
    slots = np.flatnonzero(among)
    if by_hypothesis is None or not len(slots):
        return [(slot, None) for slot in slots[_largest(scanned[slots], count)].tolist()]
    possible = round(np.isfinite(by_hypothesis[slots]).sum(axis=1).mean())
    tries = count * max(1, min(_TRIED_EACH, possible))
    slots = slots[_largest(scanned[slots], tries)]
    scores = by_hypothesis[slots]
    of_place = np.argsort(np.argsort(-scores, axis=1, kind="stable"), axis=1)
    scores = np.where(of_place < max(_TRIED_EACH, tries // len(slots)), scores, -np.inf)
    tried = np.zeros(scores.shape, bool)
    tried.flat[_largest(scores.ravel(), tries)] = True
    tried &= np.isfinite(scores)
    return [(int(slots[at]), np.flatnonzero(tried[at]).tolist()) for at in np.flatnonzero(tried.any(axis=1))]


def _largest(scores: np.ndarray, count: int) -> np.ndarray:
    """Return the indices of the `count` largest of scores (N,), in no order."""
    return np.argpartition(-scores, count)[:count] if count < len(scores) else np.arange(len(scores))


def elsewhere(index: PlaceIndex, best: int, slots: np.ndarray, neighbour_m: float) -> np.ndarray:
    """Tell which of `slots` (K,) are outside the neighbourhood of the slot `best`, bool (K,): more than `neighbour_m`
    metres away or, where either has no position, more than two places before or after it in the index."""
    away_m = distance_m(index.lat_deg[best], index.lon_deg[best], index.lat_deg[slots], index.lon_deg[slots])
    return np.where(np.isnan(away_m), abs(slots - best) > _NEIGHBOURS_WITHOUT_POSITION, away_m > neighbour_m)


def margin(ranking: Ranking, index: PlaceIndex, neighbour_m: float) -> float | None:
    """Return the margin: the best score less the best score elsewhere. None where no place elsewhere is ranked."""
    others = ranking.slots[1:]
    runners_up = ranking.scores[1:][elsewhere(index, ranking.slots[0], others, neighbour_m)]
    return float(ranking.scores[0] - runners_up[0]) if len(runners_up) else None


def named(ranking: Ranking, index: PlaceIndex, place_map: PlaceMap, first: int | None = None) -> list[Candidate]:
    """Return the `first` places of a ranking (None: all) as candidates, with their data in the map file, best first.

    Raises MapError for a place that cannot be read, or whose position has changed since the index was loaded: it is
    then unknown which position is right.
    """
    slots, scores = ranking.slots[:first].tolist(), ranking.scores[:first].tolist()
    found = []
    for slot, score, place in zip(slots, scores, place_map.places(index.place_ids[slots]), strict=True):
        position = place.position
        here = (position.lat_deg, position.lon_deg) if position else (np.nan, np.nan)
        if not np.array_equal(here, (index.lat_deg[slot], index.lon_deg[slot]), equal_nan=True):
            raise MapError(
                f"{place_map.path}: place {place.place_id} is not where it was; another program changed the map: load "
                "it again."
            )
        found.append(Candidate(place, ranking.compared.get(slot) or FineMatch(score)))
    return found
