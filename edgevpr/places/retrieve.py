"""Retrieval of the places that a query may show: scan the whole index, then compare the best places in full.

A *hypothesis* is a rotation and a camera height at which query and place may match; hypotheses are numbered. A place
that cannot be read is *left out* from then on. Its absence must never cause a wrong match to be accepted:

* The query that reveals an unreadable place is rejected.
* A place that was left out keeps its row in the index. A query that may show it (see `Ranking.unread`) is rejected.
* Without a fine part the row suffices: a place that was left out keeps its rank, and is rejected if it is the best.
* If most of the places compared with one query cannot be read, the file is at fault, and no place is left out."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from edgevpr.core.arrays import Array, Bools, Doubles, Ints, LatLon, Singles
from edgevpr.core.contract import Descriptor, FineMatch, Technique
from edgevpr.core.errors import MapError, PlaceError
from edgevpr.core.types import Candidate
from edgevpr.places.index import PlaceIndex
from edgevpr.places.mapfile import PlaceMap
from edgevpr.places.ranking import Ranking, outside_neighbourhood

Choice = tuple[int, list[int] | None]  # a slot, and the hypotheses to try (None: all)
QuickScore = tuple[float, Choice]  # approximate score, and the slot with its best hypothesis
# Scan scores of each place, float32 (N,), and each hypothesis, float32 (N, H), -inf if ruled out (None: no hypotheses).
Scan = tuple[Singles, Singles | None]

_RIVAL_PLACES = 5
_MAX_HYPOTHESES = 3  # per place
_MAX_UNMOVED_PLACES = 9
# Factor on the candidates in a map of at least this many places if the heading is unknown: on the aerial sets it finds
# 0.832 of the queries among 10,000 places (0.802 without it). Twice as many find fewer among 1,000 places.
_LARGE_MAP_PLACES = 2000
_LARGE_MAP_FACTOR = 1.6
_MIN_UNREADABLE = 3  # per query, from which on the file may be at fault
# In the data set corridor (tune), whenever the correct places were left out and a wrong one had enough margin to be
# accepted, one of the correct ones had at least the scan score of the wrong one, or one of the two best scores.
_LIKELY_PLACES = 3


@dataclass(frozen=True, slots=True)
class Expectation:
    """Prior knowledge about the place of a query (None: unknown). `in_reach` bool (N,), at least one True: the places
    where the aircraft can be. `rotation_deg` float (N,): rotation of the camera, in degrees, relative to that at which
    a place was mapped. `height_ratio`: the camera's height above the ground, divided by the mapping height."""

    in_reach: Bools | None = None
    rotation_deg: Doubles | None = None
    height_ratio: float | None = None


NO_EXPECTATION = Expectation()


@dataclass(frozen=True, slots=True, kw_only=True)
class Query:
    """One query's descriptor, the map and the index to search, and the expectation about its place."""

    technique: Technique
    descriptor: Descriptor
    place_map: PlaceMap
    index: PlaceIndex
    expected: Expectation = NO_EXPECTATION


def scan_index(query: Query) -> Scan:
    """Scan the index: compare the query with the rows of all places, which are in RAM."""
    technique, index, expected = query.technique, query.index, query.expected
    hints: dict[str, Any] = {} if expected.rotation_deg is None else {"rotation_deg": expected.rotation_deg}
    if technique.spec.height_ratios:
        hints |= {"height_ratio": expected.height_ratio, "in_reach": expected.in_reach}
    return technique.score_places(query.descriptor, index.rows, index.mean, **hints)


def compare_places(query: Query, scan: Scan, candidates: int | None, apart_m: float) -> Ranking:
    """Compare the `candidates` places that have the best scan scores with the query, and rank them.

    If there are more than the technique's `max_matches`, only those with the best quick scores are compared in
    full. With a nadir camera, no heading and at least 2,000 places, `candidates` is multiplied by 1.6. All places are
    compared if `candidates` is None, or is at least the number of places and above the technique's default. If all
    candidates are within `apart_m` metres of the best one, those elsewhere with the best scan scores are compared too,
    to obtain a margin. If `expected.in_reach` is known, so are five out of reach and at least five elsewhere.

    Without a fine part the scan scores rank the places. With `TechniqueSpec.scan_counts`, the comparison score is
    multiplied by the mean of the scan score and 1. Raises PlaceError if a place cannot be read; it is then left out.
    Raises MapError if the file cannot be read."""
    spec, index, in_reach = query.technique.spec, query.index, query.expected.in_reach
    comparison = _Comparison(query, scan, candidates)
    readable = comparison.readable
    eligible = readable if in_reach is None else in_reach & readable
    count = candidates
    if count is None or spec.fine is None or comparison.is_exact:
        count = len(index)
    elif query.expected.rotation_deg is None:
        count = round(count * compute_candidate_factor(bool(spec.height_ratios), int(np.count_nonzero(eligible))))
    choices = comparison.choose_candidates(eligible, count, spec.max_matches)
    choices += comparison.choose_candidates(readable & ~eligible, _RIVAL_PLACES, spec.max_matches and _RIVAL_PLACES)
    if not choices:
        raise MapError(f"{query.place_map.path}: none of its places can be read: restore a copy or build it again.")
    comparison.compare_places(choices)
    if len(comparison.scores) < np.count_nonzero(readable):
        compared = list(comparison.scores)
        best = max(compared, key=comparison.scores.__getitem__)
        is_elsewhere = outside_neighbourhood(index, best, np.arange(len(index)), apart_m)
        rivals = np.count_nonzero(is_elsewhere[compared])
        if rivals < (1 if in_reach is None else _RIVAL_PLACES):
            is_elsewhere[compared] = False
            comparison.compare_places(comparison.choose_more(is_elsewhere & readable, int(_RIVAL_PLACES - rivals)))
    return comparison.make_ranking()


def compute_candidate_factor(tries_rotations: bool, places: int) -> float:
    """Return the factor on the number of candidates in a map of `places` places if no heading is known."""
    return _LARGE_MAP_FACTOR if tries_rotations and places >= _LARGE_MAP_PLACES else 1


class _Comparison:
    """The comparisons of one query with places of its map: by slot, the `scores` and `matches` of the places compared
    in full (without a fine part: scan scores, and no matches), and those skipped after a quick score. `readable` bool
    (N,) is False for places left out (all True without a fine part)."""

    def __init__(self, query: Query, scan: Scan, candidates: int | None) -> None:
        technique, index, expected = query.technique, query.index, query.expected
        self._query, (self._scan, self._hypothesis_scores) = query, scan
        self._has_one_stage = technique.spec.fine is None
        self.is_exact = candidates is None or technique.candidates < candidates >= len(index)
        self._tries_all = self.is_exact and expected.in_reach is None and expected.rotation_deg is None
        self._used_scores = None if self._tries_all and not technique.spec.height_ratios else self._hypothesis_scores
        self.readable = np.ones(len(index), bool)
        if not self._has_one_stage and query.place_map.left_out:
            self.readable = ~np.isin(index.place_ids, list(query.place_map.left_out))
        self.scores: dict[int, float] = {}
        self.matches: dict[int, FineMatch] = {}
        self._skipped: list[QuickScore] = []

    def choose_candidates(self, is_eligible: Bools, count: int, max_matches: int | None) -> list[Choice]:
        """Choose up to `count` places by scan score where `is_eligible` bool (N,) is True. If together they have more
        than `max_matches` hypotheses to try, keep only that many places, by best quick score (None: keep all)."""
        if self._tries_all and self._used_scores is not None:
            count = self._used_scores.size
        choices = choose_best(self._scan, self._used_scores, is_eligible, count)
        if self.is_exact or max_matches is None or sum(len(tried or [None]) for _, tried in choices) <= max_matches:
            return choices
        quick_scores: list[QuickScore] = []
        for slot, fine, hypotheses in _read_fine_parts(self._query, choices):
            score, best_hypotheses = self._query.technique.score_quickly(self._query.descriptor, fine, hypotheses)
            quick_scores.append((self._weigh_by_scan(slot, score), (slot, best_hypotheses)))
        quick_scores.sort(key=lambda quick_score: -quick_score[0])
        self._skipped += quick_scores[max_matches:]
        return [choice for _, choice in quick_scores[:max_matches]]

    def choose_more(self, is_eligible: Bools, count: int) -> list[Choice]:
        """Choose up to `count` more places where `is_eligible` is True: skipped ones or, if there are none, those with
        the best scan scores."""
        skipped = [choice for _, choice in self._skipped if is_eligible[choice[0]]][:count]
        return skipped or choose_best(self._scan, self._used_scores, is_eligible, count)

    def compare_places(self, choices: list[Choice]) -> None:
        """Compare the chosen places in full. Raises the errors of `_read_fine_parts`."""
        if self._has_one_stage:
            self.scores.update((slot, float(self._scan[slot])) for slot, _ in choices)
            return
        for slot, fine, hypotheses in _read_fine_parts(self._query, choices):
            match = self._query.technique.match(self._query.descriptor, fine, hypotheses)
            self.scores[slot] = self._weigh_by_scan(slot, match.score)
            self.matches[slot] = replace(match, score=self.scores[slot])

    def make_ranking(self) -> Ranking:
        """Return the ranking of the places compared so far."""
        slots, scores = np.array(list(self.scores), np.intp), np.array(list(self.scores.values()), np.float32)
        order = np.argsort(-scores, kind="stable")
        slots, scores = slots[order], scores[order]
        skipped = [(score, slot) for score, (slot, _) in self._skipped if slot not in self.scores]
        skipped.sort(key=lambda item: -item[0])
        unread: Ints = np.flatnonzero(~self.readable)
        if len(unread):
            likely = min(_LIKELY_PLACES, len(self._scan))
            min_score = min(self._scan[slots[0]], np.partition(self._scan, -likely)[-likely])
            unread = unread[self._scan[unread] >= min_score]
        tried = 1.0
        if self._hypothesis_scores is not None:
            heights = max(len(self._query.technique.spec.height_ratios), 1)
            tried_per_slot = np.isfinite(self._hypothesis_scores[slots]).mean(axis=1) * heights
            tried = float(np.minimum(tried_per_slot, 1.0).mean())
        slots = np.append(slots, [slot for _, slot in skipped]).astype(np.intp)
        scores = np.append(scores, np.minimum([score for score, _ in skipped], scores[-1])).astype(np.float32)
        return Ranking(slots=slots, scores=scores, compared=self.matches, unread=unread, tried=tried)

    def _weigh_by_scan(self, slot: int, score: float) -> float:
        return score * (1 + float(self._scan[slot])) / 2 if self._query.technique.spec.scan_counts else score


def _read_fine_parts(query: Query, choices: list[Choice]) -> Iterator[tuple[int, Array, list[int] | None]]:
    """Yield the slots of the chosen places with their fine parts and hypotheses. After all have been tried, raises
    PlaceError if one cannot be read; it is then left out. Raises MapError if the file cannot be read."""
    failures, place_map, index = [], query.place_map, query.index
    for slot, hypotheses in choices:
        try:
            fine, point = place_map.read_fine_part(index.place_ids[slot])
            _require_position(place_map, index, slot, point)
        except PlaceError as error:
            failures.append(error)
        else:
            yield slot, fine, hypotheses
    if not failures:
        return
    first = failures[0]
    if len(failures) >= _MIN_UNREADABLE and 2 * len(failures) > len(choices):
        raise MapError(
            f"{place_map.path}: {len(failures)} of the {len(choices)} compared places cannot be read (place "
            f"{first.place_id}: {first.problem}): the file is damaged or was replaced: restore a copy."
        )
    for failure in failures:
        place_map.left_out.setdefault(failure.place_id, failure.problem)
    raise first


def match_unmoved_places(query: Query, best: int, apart_m: float) -> list[FineMatch]:
    """Compare a nadir query with a few places spread over the map, but not near the slot `best`, as if it had been
    taken at their height and heading (see `Technique.match_at_rest`). Raises the errors of `compare_places`."""
    index, left_out = query.index, list(query.place_map.left_out)
    slots = np.flatnonzero(
        outside_neighbourhood(index, best, np.arange(len(index)), apart_m) & ~np.isin(index.place_ids, left_out)
    )
    choices: list[Choice] = [(slot, None) for slot in slots[:: -(-len(slots) // _MAX_UNMOVED_PLACES) or 1].tolist()]
    return [query.technique.match_at_rest(query.descriptor, fine) for _, fine, _ in _read_fine_parts(query, choices)]


def load_candidates(
    ranking: Ranking, index: PlaceIndex, place_map: PlaceMap, first: int | None = None
) -> list[Candidate]:
    """Return the best `first` places of a ranking (None: all) as candidates, best first, with data from the map file.
    Raises PlaceError if one of them cannot be read, was left out before, or has moved since the index was loaded. That
    place is left out from then on."""
    candidates = []
    for slot, score in zip(ranking.slots[:first].tolist(), ranking.scores[:first].tolist(), strict=True):
        place_id = int(index.place_ids[slot])
        try:
            if place_id in place_map.left_out:
                raise PlaceError(place_map.path, place_id, place_map.left_out[place_id])
            (place,) = place_map.read_places([place_id])
            position = place.position
            _require_position(place_map, index, slot, (position.lat_deg, position.lon_deg) if position else None)
        except PlaceError as error:
            place_map.left_out.setdefault(place_id, error.problem)
            raise
        candidates.append(Candidate(place, ranking.compared.get(slot) or FineMatch(score)))
    return candidates


def choose_best(scores: Singles, hypothesis_scores: Singles | None, is_eligible: Bools, count: int) -> list[Choice]:
    """Choose the `count` slots with the best `scores` where `is_eligible` bool (N,) is True, each with the hypotheses
    to try (None: all), in the order of the map file, which an SD card reads fastest. With `hypothesis_scores` float32
    (N, H) (see `Scan`), the `count` best pairs of a place and a hypothesis are chosen instead, at most three per place,
    or more if there are too few places."""
    slots = np.flatnonzero(is_eligible)
    if hypothesis_scores is None or not len(slots):
        return [(slot, None) for slot in slots[np.sort(_find_largest(scores[slots], count))].tolist()]
    slots = slots[np.sort(_find_largest(hypothesis_scores.max(axis=1)[slots], count))]
    pairs = hypothesis_scores[slots]
    rank_in_place = np.argsort(np.argsort(-pairs, axis=1, kind="stable"), axis=1)
    pairs = np.where(rank_in_place < max(_MAX_HYPOTHESES, count // len(slots)), pairs, -np.inf)
    is_tried = np.zeros(pairs.shape, bool)
    is_tried.flat[_find_largest(pairs.ravel(), count)] = True
    is_tried &= np.isfinite(pairs)
    return [(int(slots[row]), np.flatnonzero(is_tried[row]).tolist()) for row in np.flatnonzero(is_tried.any(axis=1))]


def _find_largest(scores: Singles, count: int) -> Ints:
    """Return the indices of the `count` largest of `scores` (N,), in any order."""
    return np.argpartition(-scores, count)[:count] if count < len(scores) else np.arange(len(scores))


def _require_position(place_map: PlaceMap, index: PlaceIndex, slot: int, point: LatLon | None) -> None:
    """Raise PlaceError unless `point`, the position in the file, equals that in the index (None: no position)."""
    lat_deg = float(index.lat_deg[slot])
    if (None if math.isnan(lat_deg) else (lat_deg, float(index.lon_deg[slot]))) != point:
        raise PlaceError(place_map.path, int(index.place_ids[slot]), "its position has changed")
