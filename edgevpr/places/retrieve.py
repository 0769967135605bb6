"""From a query to the places that it may be: one scan of the index, then the best candidates compared in full."""

from dataclasses import dataclass, replace

import numpy as np

from edgevpr.geodesy import distance_m
from edgevpr.places.index import PlaceIndex
from edgevpr.places.mapfile import PlaceMap
from edgevpr.types import Candidate, Descriptor, FineMatch, Technique

_NEIGHBOURS_WITHOUT_POSITION = 2
_COMPARED_ELSEWHERE = 5
_TRIED_EACH = 6  # hypotheses of a place

_Chosen = tuple[int, list[int] | None]  # a slot, and the hypotheses to try (None: all there are)


@dataclass(frozen=True, slots=True)
class Ranking:
    """Places best first: `slots` int (K,) of the index, `scores` float32 (K,), and what is known of each match."""

    slots: np.ndarray
    scores: np.ndarray
    matches: tuple[FineMatch, ...]


def rank(
    technique: Technique,
    query: Descriptor,
    place_map: PlaceMap,
    index: PlaceIndex,
    candidates: int | None = None,
    neighbour_m: float = 0.0,
    allowed: np.ndarray | None = None,
    turned_deg: np.ndarray | None = None,
) -> Ranking:
    """Scan all places of the index, and compare the best `candidates` of them in full.

    None, or as many as there are and more than the technique's own number: all places in full under every hypothesis,
    whatever the scan says (exact, and slow). Where all candidates turn out to be neighbours of the best one, the
    best-scanned places elsewhere are compared as well: without them nobody could say how far ahead it is.

    Of a technique with `scan_counts` the score is that of the comparison times the mean of that of the scan and 1: what
    the two say of a wrong place has little to do with each other.

    `allowed` bool (N,), at least one True, says where the aircraft should be: the candidates are taken from there, and
    five candidates of all others are compared as well. Where it is false, it would hide the right place behind the
    best of the wrong ones; and to be ahead of the few that are left would say little, so five places elsewhere are
    compared at least. `turned_deg` (N,) goes to `Technique.coarse_scores`.
    """
    one_stage = technique.spec.fine is None
    scan_counts = getattr(technique, "scan_counts", False)
    hint = {} if turned_deg is None else {"turned_deg": turned_deg}
    scanned, by_hypothesis = technique.coarse_scores(query, index.rows, index.mean, **hint)

    def compared(slot: int, hypotheses: list[int] | None) -> FineMatch:
        if one_stage:
            return FineMatch(float(scanned[slot]))
        match = technique.match(query, place_map.fine_part(index.place_ids[slot]), hypotheses)
        return replace(match, score=match.score * (1 + float(scanned[slot])) / 2) if scan_counts else match

    exact = candidates is None or technique.candidates < candidates >= len(index)
    if one_stage or exact:
        candidates = len(index)
    if exact and allowed is None and turned_deg is None:
        by_hypothesis = None  # all are tried
    there = np.ones(len(index), bool) if allowed is None else allowed
    chosen = best_scanned(scanned, by_hypothesis, there, candidates)
    chosen += best_scanned(scanned, by_hypothesis, ~there, _COMPARED_ELSEWHERE)
    matches = [compared(*each) for each in chosen]
    slots = np.array([slot for slot, _ in chosen])
    if len(slots) < len(index):
        best = slots[max(range(len(slots)), key=lambda at: matches[at].score)]
        rivals = np.count_nonzero(elsewhere(index, best, slots, neighbour_m))
        if rivals < (1 if allowed is None else _COMPARED_ELSEWHERE):
            others = elsewhere(index, best, np.arange(len(index)), neighbour_m)
            others[slots] = False
            more = best_scanned(scanned, by_hypothesis, others, _COMPARED_ELSEWHERE - rivals)
            matches += [compared(*each) for each in more]
            slots = np.append(slots, [slot for slot, _ in more]).astype(np.intp)
    scores = np.array([match.score for match in matches], np.float32)
    order = np.argsort(-scores, kind="stable")
    return Ranking(slots[order], scores[order], tuple(matches[i] for i in order))


def best_scanned(scanned: np.ndarray, by_hypothesis: np.ndarray | None, among: np.ndarray, count: int) -> list[_Chosen]:
    """The `count` best-scanned slots of those `among` (N,) bool is True of, and which hypotheses to try of each (None:
    all).

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
    """Where the `count` largest of scores (N,) are, in no order."""
    return np.argpartition(-scores, count)[:count] if count < len(scores) else np.arange(len(scores))


def elsewhere(index: PlaceIndex, best: int, slots: np.ndarray, neighbour_m: float) -> np.ndarray:
    """Which of `slots` are not in the neighbourhood of `best`, bool: more than `neighbour_m` metres away or, where
    either has no position, more than two places before or after it in the map."""
    away_m = distance_m(index.lat_deg[best], index.lon_deg[best], index.lat_deg[slots], index.lon_deg[slots])
    return np.where(np.isnan(away_m), abs(slots - best) > _NEIGHBOURS_WITHOUT_POSITION, away_m > neighbour_m)


def margin(ranking: Ranking, index: PlaceIndex, neighbour_m: float) -> float | None:
    """By how much the best place beats the best one elsewhere; None where no place elsewhere was compared."""
    others = ranking.slots[1:]
    runners_up = ranking.scores[1:][elsewhere(index, ranking.slots[0], others, neighbour_m)]
    return float(ranking.scores[0] - runners_up[0]) if len(runners_up) else None


def named(ranking: Ranking, index: PlaceIndex, place_map: PlaceMap, first: int | None = None) -> list[Candidate]:
    """The `first` places of a ranking (None: all) with what the map file says of them, best first."""
    places = place_map.places(index.place_ids[ranking.slots[:first]])
    return [Candidate(place, match) for place, match in zip(places, ranking.matches[:first], strict=True)]
