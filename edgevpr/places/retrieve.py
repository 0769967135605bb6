"""From a query to the places that it may be: one scan of the index, then the best candidates compared in full."""

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

_Chosen = tuple[int, list[int] | None]  # a slot, and the hypotheses to try (None: all there are)


@dataclass(frozen=True, slots=True)
class Expected:
    """What is known of the place of a query before it is asked, None where nothing is: `in_reach` bool (N,), at least
    one True, says which places the aircraft can be at; `turned_deg` float (N,) how far the camera should have turned
    since each place was mapped (see `Technique.coarse_scores`)."""

    in_reach: np.ndarray | None = None
    turned_deg: np.ndarray | None = None


NOTHING = Expected()


@dataclass(frozen=True, slots=True)
class Scan:
    """All places by their rows of the index: `scores` float32 (N,) and, where a comparison has several hypotheses to
    try, the scores of each, `by_hypothesis` float32 (N, H), -inf for one that is out of the question."""

    scores: np.ndarray
    by_hypothesis: np.ndarray | None


@dataclass(frozen=True, slots=True)
class Ranking:
    """Places best first: `slots` int (K,) of the index, `scores` float32 (K,), and by its slot the match of each place
    that was compared in full, with that score."""

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
    """Compare the best-scanned `candidates` places in full, and rank them.

    None, or as many as there are and more than the technique's own number: all places in full under every hypothesis,
    whatever the scan says (exact, and slow). Where all candidates turn out to be neighbours of the best one (nearer
    than `neighbour_m`), the best-scanned places elsewhere are compared as well: without them nobody could say how far
    ahead it is. A technique without a fine part is ranked by the scan.

    Of a technique whose scan counts (see `TechniqueSpec`) the score is that of the comparison times the mean of that of
    the scan and 1: what the two say of a wrong place has little to do with each other.

    Of places in reach the candidates are taken, and five candidates of all others are compared as well. Where what is
    expected is false, it would hide the right place behind the best of the wrong ones; and to be ahead of the few that
    are left would say little, so five places elsewhere are compared at least. Raises MapError for a place that cannot
    be read.
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
    """Choose the `count` best-scanned slots of those `among` (N,) bool is True of, and which hypotheses to try of each
    (None: all).

    Where there are several (`by_hypothesis` float32 (N, H), see `Technique.coarse_scores`), it is the best hypotheses
    of all places, `count` times six or, where fewer are possible, so many: a place of which only two look likely leaves
    room for others. Of one place they are six at most, or more where there are not enough places.
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
    """Find where the `count` largest of scores (N,) are, in no order."""
    return np.argpartition(-scores, count)[:count] if count < len(scores) else np.arange(len(scores))


def elsewhere(index: PlaceIndex, best: int, slots: np.ndarray, neighbour_m: float) -> np.ndarray:
    """Tell which of `slots` are not in the neighbourhood of `best`, bool: more than `neighbour_m` metres away or, where
    either has no position, more than two places before or after it in the map."""
    away_m = distance_m(index.lat_deg[best], index.lon_deg[best], index.lat_deg[slots], index.lon_deg[slots])
    return np.where(np.isnan(away_m), abs(slots - best) > _NEIGHBOURS_WITHOUT_POSITION, away_m > neighbour_m)


def margin(ranking: Ranking, index: PlaceIndex, neighbour_m: float) -> float | None:
    """Say by how much the best place beats the best one elsewhere; None where no place elsewhere was compared."""
    others = ranking.slots[1:]
    runners_up = ranking.scores[1:][elsewhere(index, ranking.slots[0], others, neighbour_m)]
    return float(ranking.scores[0] - runners_up[0]) if len(runners_up) else None


def named(ranking: Ranking, index: PlaceIndex, place_map: PlaceMap, first: int | None = None) -> list[Candidate]:
    """Name the `first` places of a ranking (None: all) with what the map file says of them, best first. Raises MapError
    for a place that cannot be read, or is not where it was when the index was loaded: nobody knows what is right."""
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
