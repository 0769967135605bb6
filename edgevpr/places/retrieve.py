"""Retrieval of the places that a query may show: one scan of the index, then a full comparison of the best ones.

A place that cannot be read is left out from then on, and the others are used. This must never turn a refused match into
an accepted wrong one, by taking the right place, or the rival that kept the margin small, out of the way. So:

* The query in which a place turns out to be unreadable is refused.
* A place that was left out keeps its row in the index, and so its score in the scan. A later query that may show it
  (see `Ranking.unread`) is refused, whichever place it matches.
* A technique without a fine part needs nothing but the row. A place that was left out then keeps its rank and its
  score, and is refused when it is the best.
* Where most of the places compared with one query cannot be read, the file is at fault, not the places: the query is
  refused, and none is left out. So all are used again as soon as the file can be read again.
"""

import math
from dataclasses import dataclass, field, replace

import numpy as np

from edgevpr.contract import Descriptor, FineMatch, Technique
from edgevpr.errors import MapError, PlaceError
from edgevpr.geodesy import distance_m
from edgevpr.places.index import PlaceIndex
from edgevpr.places.mapfile import PlaceMap
from edgevpr.types import Candidate

_NEIGHBOURS_WITHOUT_POSITION = 2
_COMPARED_ELSEWHERE = 5
_TRIED_EACH = 6  # hypotheses of a place
# On corridor (tune), wherever the right places were left out and a wrong one had the margin to be accepted, one of the
# right ones was as good in the scan as the wrong one, or among the best two.
_LIKELY = 3
_MANY = 3  # unreadable places of one query, that may be the file's fault

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
    place that was compared in full to its match, which has the same score. `unread` int (U,) are slots of places that
    cannot be read but may be in the picture: their scan is at least as good as that of the best place, or as the third
    best of all."""

    slots: np.ndarray
    scores: np.ndarray
    compared: dict[int, FineMatch]
    unread: np.ndarray = field(default_factory=lambda: np.empty(0, np.intp))


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
    places elsewhere are then compared, because a margin over fewer says little.

    Raises PlaceError where a place cannot be read, after all candidates have been tried. It is then left out (see the
    top of this file). Raises MapError where the file cannot be read.
    """
    matches: dict[int, FineMatch] = {}
    one_stage = technique.spec.fine is None
    readable = np.ones(len(index), bool) if one_stage else ~left_out(place_map, index)

    def scored(chosen: list[_Chosen]) -> list[float]:
        if one_stage:
            return scanned.scores[[slot for slot, _ in chosen]].tolist()
        unreadable = []
        for slot, hypotheses in chosen:
            try:
                fine, point = place_map.fine_part(index.place_ids[slot])
                _require_there(place_map, index, slot, point)
            except PlaceError as error:
                unreadable.append(error)
                continue
            match = technique.match(query, fine, hypotheses)
            if technique.spec.scan_counts:
                match = replace(match, score=match.score * (1 + float(scanned.scores[slot])) / 2)
            matches[slot] = match
        if unreadable:
            raise _left_out_now(place_map, unreadable, len(chosen))
        return [matches[slot].score for slot, _ in chosen]

    scores, by_hypothesis, in_reach = scanned.scores, scanned.by_hypothesis, expected.in_reach
    exact = candidates is None or technique.candidates < candidates >= len(index)
    if one_stage or exact:
        candidates = len(index)
    if exact and in_reach is None and expected.turned_deg is None:
        by_hypothesis = None  # all are tried
    there = readable if in_reach is None else in_reach & readable
    chosen = best_scanned(scores, by_hypothesis, there, candidates)
    chosen += best_scanned(scores, by_hypothesis, readable & ~there, _COMPARED_ELSEWHERE)
    if not chosen:
        raise MapError(f"{place_map.path}: no place of it can be read any more: restore a copy, or build it again.")
    found = scored(chosen)
    slots = np.array([slot for slot, _ in chosen])
    if len(slots) < np.count_nonzero(readable):
        best = slots[np.argmax(found)]
        rivals = np.count_nonzero(elsewhere(index, best, slots, neighbour_m))
        if rivals < (1 if in_reach is None else _COMPARED_ELSEWHERE):
            others = elsewhere(index, best, np.arange(len(index)), neighbour_m)
            others[slots] = False
            others &= readable
            more = best_scanned(scores, by_hypothesis, others, _COMPARED_ELSEWHERE - rivals)
            found += scored(more)
            slots = np.append(slots, [slot for slot, _ in more]).astype(np.intp)
    best_first = np.array(found, np.float32)
    order = np.argsort(-best_first, kind="stable")
    return Ranking(slots[order], best_first[order], matches, _unread(scores, readable, slots[order[0]]))


def left_out(place_map: PlaceMap, index: PlaceIndex) -> np.ndarray:
    """Tell which places of the index could not be read so far, bool (N,)."""
    return np.isin(index.place_ids, list(place_map.left_out)) if place_map.left_out else np.zeros(len(index), bool)


def _require_there(place_map: PlaceMap, index: PlaceIndex, slot: int, point: tuple[float, float] | None) -> None:
    """Raise PlaceError unless a place is exactly where it was when the index was loaded."""
    lat_deg = float(index.lat_deg[slot])
    if (None if math.isnan(lat_deg) else (lat_deg, float(index.lon_deg[slot]))) != point:
        raise PlaceError(place_map.path, int(index.place_ids[slot]), "its position has changed")


def _left_out_now(place_map: PlaceMap, unreadable: list[PlaceError], tried: int) -> MapError:
    """Leave places out that could not be read, and return the error of this query. Where they are most of the `tried`,
    return one of the file, and leave none out."""
    first = unreadable[0]
    if len(unreadable) >= _MANY and 2 * len(unreadable) > tried:
        return MapError(
            f"{place_map.path}: {len(unreadable)} of the {tried} places compared cannot be read (place "
            f"{first.place_id}: {first.problem}): the file is damaged or another map; restore a copy."
        )
    for error in unreadable:
        place_map.left_out.setdefault(error.place_id, error.problem)
    return first


def _unread(scanned: np.ndarray, readable: np.ndarray, best: int) -> np.ndarray:
    """Return the slots of the places left out that a query may show (see `Ranking`)."""
    slots = np.flatnonzero(~readable)
    if not len(slots):
        return slots
    likely = min(_LIKELY, len(scanned))
    least = min(scanned[best], np.partition(scanned, -likely)[-likely])
    return slots[scanned[slots] >= least]


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

    Raises PlaceError for a place that cannot be read, that was left out, or whose position has changed since the index
    was loaded: it is then unknown which position is right. It is left out from then on.
    """
    slots, scores = ranking.slots[:first].tolist(), ranking.scores[:first].tolist()
    found = []
    for slot, score in zip(slots, scores, strict=True):
        place_id = int(index.place_ids[slot])
        try:
            if place_id in place_map.left_out:
                raise PlaceError(place_map.path, place_id, place_map.left_out[place_id])
            (place,) = place_map.places([place_id])
            position = place.position
            _require_there(place_map, index, slot, (position.lat_deg, position.lon_deg) if position else None)
        except PlaceError as error:
            place_map.left_out.setdefault(place_id, error.problem)
            raise
        found.append(Candidate(place, ranking.compared.get(slot) or FineMatch(score)))
    return found
