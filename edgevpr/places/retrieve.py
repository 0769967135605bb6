"""Retrieval of the places that a query may show: one scan of the index, then a full comparison of the best ones.

A place that cannot be read must never turn a refused match into an accepted wrong one: see `visit`.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from edgevpr.core.contract import Descriptor, FineMatch, Technique
from edgevpr.core.errors import MapError, PlaceError
from edgevpr.core.geodesy import distance_m
from edgevpr.core.types import Candidate
from edgevpr.places.candidates import Chosen, best_scanned, every_possible
from edgevpr.places.index import PlaceIndex
from edgevpr.places.mapfile import PlaceMap
from edgevpr.places.visit import Seen, Visit, left_out, require_there

_NEIGHBOURS_WITHOUT_POSITION = 2
_COMPARED_ELSEWHERE = 5
# On corridor (tune), wherever the right places were left out and a wrong one had the margin to be accepted, one of the
# right ones was as good in the scan as the wrong one, or among the best two.
_LIKELY = 3


@dataclass(frozen=True, slots=True)
class Expected:
    """Knowledge about the place of a query before the search (None: nothing known). `in_reach` bool (N,), at least one
    True, tells which places the aircraft can be at. `turned_deg` float (N,) is the expected rotation of the camera
    since each place was mapped, and `height_ratio` the camera's height above the ground over that of then (see
    `Technique.coarse_scores`)."""

    in_reach: np.ndarray | None = None
    turned_deg: np.ndarray | None = None
    height_ratio: float | None = None


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
    place that was compared in full to its match, which has the same score. Places that were looked at for a moment only
    come after them. `unread` int (U,) are slots of places that
    cannot be read but may be in the picture: their scan is at least as good as that of the best place, or as the third
    best of all."""

    slots: np.ndarray
    scores: np.ndarray
    compared: dict[int, FineMatch]
    unread: np.ndarray = field(default_factory=lambda: np.empty(0, np.intp))

    def led_by(self, slot: int) -> "Ranking":
        """Return the ranking with another place first, with its own score."""
        order = np.argsort(self.slots != slot, kind="stable")
        return replace(self, slots=self.slots[order], scores=self.scores[order])


def scan(technique: Technique, query: Descriptor, index: PlaceIndex, expected: Expected = NOTHING) -> Scan:
    """Score all places of the index by their rows, in one product."""
    hint = {} if expected.turned_deg is None else {"turned_deg": expected.turned_deg}
    if technique.spec.height_ratios:
        hint["height_ratio"] = expected.height_ratio
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
    """Compare the `candidates` places with the best scan scores, and rank them.

    Of more than the technique's `in_full` of them, those that look best at a glance are compared in full.

    Where `candidates` is None, or is at least the number of places and more than the technique's own number, all
    places are compared under every hypothesis of the expected height, unless `expected` says more: exact, but slow.
    Neighbours of the best place are the places within `neighbour_m` metres of it. Where all candidates are its
    neighbours, the best-scanned places elsewhere are compared as well, because the margin needs one of them. A
    technique without a fine part is ranked by the scan.

    Where the scan counts (see `TechniqueSpec.scan_counts`), the score is that of the comparison times the mean of the
    scan score and 1: for a wrong place the two scores have little to do with each other.

    Where `expected.in_reach` is known, the candidates are places in reach, and five places out of reach are compared
    as well: a false expectation would otherwise hide the right place behind the best of the wrong ones. At least five
    places elsewhere are then compared, because a margin over fewer says little.

    Raises PlaceError where a place cannot be read, after all candidates have been tried. It is then left out (see the
    top of this file). Raises MapError where the file cannot be read.
    """
    spec, scores, in_reach = technique.spec, scanned.scores, expected.in_reach
    one_stage = spec.fine is None
    exact = candidates is None or technique.candidates < candidates >= len(index)
    every = exact and in_reach is None and expected.turned_deg is None
    by_hypothesis = None if every and not spec.height_ratios else scanned.by_hypothesis
    if one_stage or exact:
        candidates = len(index)
    readable = np.ones(len(index), bool) if one_stage else ~left_out(place_map, index)
    visit = Visit(technique=technique, query=query, scores=scores, place_map=place_map, index=index)
    matches: dict[int, FineMatch] = {}
    passed_over: list[Seen] = []

    def best(among: np.ndarray, count: int, in_full: int | None) -> list[Chosen]:
        if every and by_hypothesis is not None:
            return every_possible(by_hypothesis, among)
        chosen = best_scanned(scores, by_hypothesis, among, count)
        if exact or in_full is None or sum(len(tried or [None]) for _, tried in chosen) <= in_full:
            return chosen
        seen = visit.at_a_glance(chosen)
        passed_over.extend(seen[in_full:])
        return [found for _, found in seen[:in_full]]

    def scored(chosen: list[Chosen]) -> list[float]:
        slots = [slot for slot, _ in chosen]
        if one_stage:
            return scores[slots].tolist()
        matches.update(zip(slots, visit.in_full(chosen), strict=True))
        return [matches[slot].score for slot in slots]

    there = readable if in_reach is None else in_reach & readable
    chosen = best(there, candidates, spec.in_full)
    chosen += best(readable & ~there, _COMPARED_ELSEWHERE, spec.in_full and _COMPARED_ELSEWHERE)
    if not chosen:
        raise MapError(f"{place_map.path}: no place of it can be read any more: restore a copy, or build it again.")
    found = scored(chosen)
    slots = np.array([slot for slot, _ in chosen])
    if len(slots) < np.count_nonzero(readable):
        others = elsewhere(index, slots[np.argmax(found)], np.arange(len(index)), neighbour_m)
        rivals, enough = np.count_nonzero(others[slots]), 1 if in_reach is None else _COMPARED_ELSEWHERE
        if rivals < enough:
            others[slots] = False
            others &= readable
            more = [found for _, found in passed_over if others[found[0]]][: _COMPARED_ELSEWHERE - rivals]
            more = more or best_scanned(scores, by_hypothesis, others, _COMPARED_ELSEWHERE - rivals)
            found += scored(more)
            slots = np.append(slots, [slot for slot, _ in more]).astype(np.intp)
    order = np.argsort(-np.array(found, np.float32), kind="stable")
    slots, ranked = slots[order], np.array(found, np.float32)[order]
    last = sorted((each for each in passed_over if each[1][0] not in matches), key=lambda seen: -seen[0])
    return Ranking(
        np.append(slots, [slot for _, (slot, _) in last]).astype(np.intp),
        np.append(ranked, np.minimum([score for score, _ in last], ranked[-1])).astype(np.float32),
        matches,
        _unread(scores, readable, slots[0]),
    )


def together(one: Ranking, other: Ranking) -> Ranking:
    """Join two rankings of the same query, that looked at the same places under different expectations: of a place that
    both compared the better match counts."""
    compared = dict(one.compared)
    for slot, match in other.compared.items():
        if slot not in compared or match.score > compared[slot].score:
            compared[slot] = match
    best = sorted(compared, key=lambda slot: -compared[slot].score)
    last: dict[int, float] = {}
    for ranking in (one, other):
        for slot, score in zip(ranking.slots.tolist(), ranking.scores.tolist(), strict=True):
            if slot not in compared:
                last[slot] = max(score, last.get(slot, score))
    rest = sorted(last, key=lambda slot: -last[slot])
    least = compared[best[-1]].score
    scores = [compared[slot].score for slot in best] + [min(last[slot], least) for slot in rest]
    unread = np.union1d(one.unread, other.unread).astype(np.intp)
    return Ranking(np.array(best + rest, np.intp), np.array(scores, np.float32), compared, unread)


def _unread(scanned: np.ndarray, readable: np.ndarray, best: int) -> np.ndarray:
    """Return the slots of the places left out that a query may show (see `Ranking`)."""
    slots = np.flatnonzero(~readable)
    if not len(slots):
        return slots
    likely = min(_LIKELY, len(scanned))
    least = min(scanned[best], np.partition(scanned, -likely)[-likely])
    return slots[scanned[slots] >= least]


def elsewhere(
    index: PlaceIndex, best: int, slots: np.ndarray, neighbour_m: float, same: Sequence[int] = ()
) -> np.ndarray:
    """Tell which of `slots` (K,) are outside the neighbourhood of the slot `best`, bool (K,): more than `neighbour_m`
    metres away or, where either has no position, more than two places before or after it in the index. The places
    numbered `same` are inside, however far away: they show the same ground."""
    away_m = distance_m(index.lat_deg[best], index.lon_deg[best], index.lat_deg[slots], index.lon_deg[slots])
    away = np.where(np.isnan(away_m), abs(slots - best) > _NEIGHBOURS_WITHOUT_POSITION, away_m > neighbour_m)
    return away & ~np.isin(index.place_ids[slots], same) if same else away


def margin(ranking: Ranking, index: PlaceIndex, neighbour_m: float, same: Sequence[int] = ()) -> float | None:
    """Return the margin: the best score less the best score elsewhere. None where no place elsewhere is ranked. The
    places numbered `same` are not elsewhere."""
    others = ranking.slots[1:]
    runners_up = ranking.scores[1:][elsewhere(index, ranking.slots[0], others, neighbour_m, same)]
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
            require_there(place_map, index, slot, (position.lat_deg, position.lon_deg) if position else None)
        except PlaceError as error:
            place_map.left_out.setdefault(place_id, error.problem)
            raise
        found.append(Candidate(place, ranking.compared.get(slot) or FineMatch(score)))
    return found
