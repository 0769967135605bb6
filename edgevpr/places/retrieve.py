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
from collections.abc import Callable, Collection
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar

import numpy as np

from edgevpr.core.arrays import Array, Bools, Doubles, Ints, LatLon, Singles
from edgevpr.core.contract import Descriptor, FineMatch, Technique
from edgevpr.core.errors import MapError, PlaceError
from edgevpr.core.geodesy import distance_m
from edgevpr.core.types import Candidate
from edgevpr.places.index import PlaceIndex
from edgevpr.places.mapfile import PlaceMap

T = TypeVar("T")
Choice = tuple[int, list[int] | None]  # a slot, and the hypotheses to try (None: all)
Glance = tuple[float, Choice]  # about the score of a place, and the best of the hypotheses to try

_NEIGHBOURS_WITHOUT_POSITION = 2
_COMPARED_ELSEWHERE = 5
_TRIED_EACH = 6  # hypotheses of a place
_MANY = 3  # unreadable places of one query, that may be the file's fault
# On corridor (tune), wherever the right places were left out and a wrong one had the margin to be accepted, one of the
# right ones was as good in the scan as the wrong one, or among the best two.
_LIKELY = 3


@dataclass(frozen=True, slots=True)
class Expectation:
    """Knowledge about the place of a query before the search (None: nothing known). `in_reach` bool (N,), at least one
    True, tells which places the aircraft can be at. `turned_deg` float (N,) is the expected rotation of the camera
    since each place was mapped, and `height_ratio` the camera's height above the ground over that of then (see
    `Technique.coarse_scores`)."""

    in_reach: Bools | None = None
    turned_deg: Doubles | None = None
    height_ratio: float | None = None


NOTHING = Expectation()


@dataclass(frozen=True, slots=True, kw_only=True)
class Query:
    """One query, and what it is searched in: a map, its index, and what is expected of the place."""

    technique: Technique
    descriptor: Descriptor
    place_map: PlaceMap
    index: PlaceIndex
    expected: Expectation = NOTHING


@dataclass(frozen=True, slots=True)
class Scan:
    """The result of scanning all rows of the index: `scores` float32 (N,). Where a comparison has several hypotheses
    to try, `by_hypothesis` float32 (N, H) has the score of each, -inf for one that is ruled out; else None."""

    scores: Singles
    by_hypothesis: Singles | None


@dataclass(frozen=True, slots=True)
class Ranking:
    """Places best first: `slots` int (K,) of the index and `scores` float32 (K,). `compared` maps the slot of each
    place that was compared in full to its match, which has the same score. Places that were looked at for a moment only
    come after them. `unread` int (U,) are slots of places that cannot be read but may be in the picture: their scan is
    at least as good as that of the best place, or as the third best of all."""

    slots: Ints
    scores: Singles
    compared: dict[int, FineMatch]
    unread: Ints = field(default_factory=lambda: np.empty(0, np.intp))

    @property
    def compared_slots(self) -> list[int]:
        """The slots of the places that were compared in full, best first."""
        return [slot for slot in self.slots.tolist() if slot in self.compared]

    def led_by(self, slot: int) -> "Ranking":
        """Return the ranking with another place first, with its own score."""
        order = np.argsort(self.slots != slot, kind="stable")
        return replace(self, slots=self.slots[order], scores=self.scores[order])


def scan(query: Query) -> Scan:
    """Score all places of the index by their rows, in one product."""
    technique, index, expected = query.technique, query.index, query.expected
    hint: dict[str, Any] = {} if expected.turned_deg is None else {"turned_deg": expected.turned_deg}
    if technique.spec.height_ratios:
        hint["height_ratio"] = expected.height_ratio
    return Scan(*technique.coarse_scores(query.descriptor, index.rows, index.mean, **hint))


def compare(query: Query, scanned: Scan, candidates: int | None = None, neighbour_m: float = 0.0) -> Ranking:
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
    spec, index, in_reach = query.technique.spec, query.index, query.expected.in_reach
    looks = _Comparison(query, scanned, candidates)
    readable = looks.readable
    there = readable if in_reach is None else in_reach & readable
    count = len(index) if spec.fine is None or looks.is_exact or candidates is None else candidates
    chosen = looks.best(there, count, spec.in_full)
    chosen += looks.best(readable & ~there, _COMPARED_ELSEWHERE, spec.in_full and _COMPARED_ELSEWHERE)
    if not chosen:
        raise MapError(
            f"{query.place_map.path}: no place of it can be read any more: restore a copy, or build it again."
        )
    found = looks.scores_in_full(chosen)
    slots = np.array([slot for slot, _ in chosen])
    if len(slots) < np.count_nonzero(readable):
        others = elsewhere(index, slots[np.argmax(found)], np.arange(len(index)), neighbour_m)
        rivals, enough = np.count_nonzero(others[slots]), 1 if in_reach is None else _COMPARED_ELSEWHERE
        if rivals < enough:
            others[slots] = False
            more = looks.next_best(others & readable, int(_COMPARED_ELSEWHERE - rivals))
            found += looks.scores_in_full(more)
            slots = np.append(slots, [slot for slot, _ in more]).astype(np.intp)
    order = np.argsort(-np.array(found, np.float32), kind="stable")
    slots, ranked = slots[order], np.array(found, np.float32)[order]
    last = sorted((glance for glance in looks.passed_over if glance[1][0] not in looks.matches), key=lambda it: -it[0])
    return Ranking(
        np.append(slots, [slot for _, (slot, _) in last]).astype(np.intp),
        np.append(ranked, np.minimum([score for score, _ in last], ranked[-1])).astype(np.float32),
        looks.matches,
        _unread(scanned.scores, readable, slots[0]),
    )


class _Comparison:
    """The comparisons of one query with places of its map: `matches` by slot, and in `passed_over` those that were only
    glanced at. `readable` bool (N,) tells which places could be read so far; of a technique without a fine part, all.

    All looks raise PlaceError where a place cannot be read, after all have been tried; it is then left out. They raise
    MapError where the file cannot be read.
    """

    def __init__(self, query: Query, scanned: Scan, candidates: int | None) -> None:
        technique, index, expected = query.technique, query.index, query.expected
        self._query, self._scores = query, scanned.scores
        self._has_one_stage = technique.spec.fine is None
        self.is_exact = candidates is None or technique.candidates < candidates >= len(index)
        self._tries_all = self.is_exact and expected.in_reach is None and expected.turned_deg is None
        is_any_height = self._tries_all and not technique.spec.height_ratios
        self._by_hypothesis = None if is_any_height else scanned.by_hypothesis
        self.readable = np.ones(len(index), bool)
        if not self._has_one_stage and query.place_map.left_out:
            self.readable = ~np.isin(index.place_ids, list(query.place_map.left_out))
        self.matches: dict[int, FineMatch] = {}
        self.passed_over: list[Glance] = []

    def best(self, among: Bools, count: int, in_full: int | None) -> list[Choice]:
        """Choose up to `count` places where `among` bool (N,) is True: the best scanned or, of more than `in_full`
        looks, those that look best at a glance."""
        if self._tries_all and self._by_hypothesis is not None:
            of_slot = self._by_hypothesis
            return [(at, np.flatnonzero(np.isfinite(of_slot[at])).tolist()) for at in np.flatnonzero(among).tolist()]
        chosen = best_scanned(self._scores, self._by_hypothesis, among, count)
        if self.is_exact or in_full is None or sum(len(tried or [None]) for _, tried in chosen) <= in_full:
            return chosen
        glances = sorted(self._look_at(chosen, self._glance), key=lambda glance: -glance[0])
        self.passed_over += glances[in_full:]
        return [choice for _, choice in glances[:in_full]]

    def next_best(self, among: Bools, count: int) -> list[Choice]:
        """Choose up to `count` more places where `among` is True, first of those that were passed over."""
        more = [choice for _, choice in self.passed_over if among[choice[0]]][:count]
        return more or best_scanned(self._scores, self._by_hypothesis, among, count)

    def scores_in_full(self, chosen: list[Choice]) -> list[float]:
        """Compare places in full, under the hypotheses to try, and return their scores."""
        slots = [slot for slot, _ in chosen]
        if self._has_one_stage:
            return [float(score) for score in self._scores[slots]]
        self.matches.update(zip(slots, self._look_at(chosen, self._match), strict=True))
        return [self.matches[slot].score for slot in slots]

    def _match(self, slot: int, fine: Array, hypotheses: list[int] | None) -> FineMatch:
        match = self._query.technique.match(self._query.descriptor, fine, hypotheses)
        return replace(match, score=self._with_scan(slot, match.score))

    def _glance(self, slot: int, fine: Array, hypotheses: list[int] | None) -> Glance:
        score, best = self._query.technique.glance(self._query.descriptor, fine, hypotheses)
        return self._with_scan(slot, score), (slot, best)

    def _with_scan(self, slot: int, score: float) -> float:
        return score * (1 + float(self._scores[slot])) / 2 if self._query.technique.spec.scan_counts else score

    def _look_at(self, chosen: list[Choice], look: Callable[[int, Array, list[int] | None], T]) -> list[T]:
        found: list[T] = []
        unreadable, place_map, index = [], self._query.place_map, self._query.index
        for slot, hypotheses in chosen:
            try:
                fine, point = place_map.fine_part(index.place_ids[slot])
                _require_there(place_map, index, slot, point)
            except PlaceError as error:
                unreadable.append(error)
                continue
            found.append(look(slot, fine, hypotheses))
        if unreadable:
            raise _left_out_now(place_map, unreadable, len(chosen))
        return found


def together(one: Ranking, other: Ranking) -> Ranking:
    """Join two rankings of the same query, that looked at the same places under different expectations: of a place that
    both compared the better match counts."""
    compared = dict(one.compared)
    for slot, match in other.compared.items():
        if slot not in compared or match.score > compared[slot].score:
            compared[slot] = match
    best, last = sorted(compared, key=lambda slot: -compared[slot].score), dict[int, float]()
    for ranking in (one, other):
        for slot, score in zip(ranking.slots.tolist(), ranking.scores.tolist(), strict=True):
            if slot not in compared:
                last[slot] = max(score, last.get(slot, score))
    rest = sorted(last, key=lambda slot: -last[slot])
    least = compared[best[-1]].score
    scores = [compared[slot].score for slot in best] + [min(last[slot], least) for slot in rest]
    unread = np.union1d(one.unread, other.unread).astype(np.intp)
    return Ranking(np.array(best + rest, np.intp), np.array(scores, np.float32), compared, unread)


def elsewhere(index: PlaceIndex, best: int, slots: Ints, neighbour_m: float, same: Collection[int] = ()) -> Bools:
    """Tell which of `slots` (K,) are outside the neighbourhood of the slot `best`, bool (K,): more than `neighbour_m`
    metres away or, where either has no position, more than two places before or after it in the index. The places
    numbered `same` are inside, however far away: they show the same ground."""
    away_m = distance_m(index.lat_deg[best], index.lon_deg[best], index.lat_deg[slots], index.lon_deg[slots])
    away = np.where(np.isnan(away_m), abs(slots - best) > _NEIGHBOURS_WITHOUT_POSITION, away_m > neighbour_m)
    return away & ~np.isin(index.place_ids[slots], tuple(same)) if same else away


def margin(ranking: Ranking, index: PlaceIndex, neighbour_m: float, same: Collection[int] = ()) -> float | None:
    """Return the margin: the best score less the best score elsewhere. None where no place elsewhere is ranked. The
    places numbered `same` are not elsewhere."""
    others = ranking.slots[1:]
    runners_up = ranking.scores[1:][elsewhere(index, int(ranking.slots[0]), others, neighbour_m, same)]
    return float(ranking.scores[0] - runners_up[0]) if len(runners_up) else None


def named(ranking: Ranking, index: PlaceIndex, place_map: PlaceMap, first: int | None = None) -> list[Candidate]:
    """Return the `first` places of a ranking (None: all) as candidates, with their data in the map file, best first.

    Raises PlaceError for a place that cannot be read, that was left out, or whose position has changed since the index
    was loaded: it is then unknown which position is right. It is left out from then on.
    """
    candidates = []
    for slot, score in zip(ranking.slots[:first].tolist(), ranking.scores[:first].tolist(), strict=True):
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
        candidates.append(Candidate(place, ranking.compared.get(slot) or FineMatch(score)))
    return candidates


def best_scanned(scores: Singles, by_hypothesis: Singles | None, among: Bools, count: int) -> list[Choice]:
    """Choose the `count` best-scanned slots where `among` bool (N,) is True, and the hypotheses to try of each (None:
    all). They come in the order of the map file, in which a card reads them fastest.

    With `by_hypothesis` float32 (N, H) (see `Technique.coarse_scores`), the best hypotheses of all places together are
    chosen instead: `count` times six, or `count` times a third of the mean number possible for a place where that is
    less. So a place with only two likely hypotheses leaves room for other places. One place gets six hypotheses at
    most, or more where there are too few places.
    """
    slots = np.flatnonzero(among)
    if by_hypothesis is None or not len(slots):
        return [(slot, None) for slot in slots[np.sort(_largest(scores[slots], count))].tolist()]
    possible = np.isfinite(by_hypothesis[slots]).sum(axis=1).mean()
    tries = round(count * max(1.0, min(_TRIED_EACH, possible / 3)))
    slots = slots[np.sort(_largest(scores[slots], tries))]
    each = by_hypothesis[slots]
    of_place = np.argsort(np.argsort(-each, axis=1, kind="stable"), axis=1)
    each = np.where(of_place < max(_TRIED_EACH, tries // len(slots)), each, -np.inf)
    tried = np.zeros(each.shape, bool)
    tried.flat[_largest(each.ravel(), tries)] = True
    tried &= np.isfinite(each)
    return [(int(slots[at]), np.flatnonzero(tried[at]).tolist()) for at in np.flatnonzero(tried.any(axis=1))]


def _largest(scores: Singles, count: int) -> Ints:
    """Return the indices of the `count` largest of scores (N,), in no order."""
    return np.argpartition(-scores, count)[:count] if count < len(scores) else np.arange(len(scores))


def _unread(scores: Singles, readable: Bools, best: int) -> Ints:
    """Return the slots of the places left out that a query may show (see `Ranking`)."""
    slots: Ints = np.flatnonzero(~readable)
    if not len(slots):
        return slots
    likely = min(_LIKELY, len(scores))
    least = min(scores[best], np.partition(scores, -likely)[-likely])
    return np.asarray(slots[scores[slots] >= least])


def _require_there(place_map: PlaceMap, index: PlaceIndex, slot: int, point: LatLon | None) -> None:
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
