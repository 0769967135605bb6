"""From a query to the places that it may be: one scan of the index, then the best candidates compared in full."""

from dataclasses import dataclass

import numpy as np

from edgevpr.geodesy import distance_m
from edgevpr.places.index import PlaceIndex
from edgevpr.places.mapfile import PlaceMap
from edgevpr.types import Candidate, Descriptor, FineMatch, Technique

_NEIGHBOURS_WITHOUT_POSITION = 2
_COMPARED_ELSEWHERE = 5


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
) -> Ranking:
    """Scan all places of the index, and compare the best `candidates` of them in full.

    None, or as many as there are: all places in full under every hypothesis, without a scan (exact, and slow). Where
    all candidates turn out to be neighbours of the best one, the best-scanned places elsewhere are compared as well:
    without them nobody could say how far ahead it is.
    """
    if technique.spec.fine is None:
        scores, _ = technique.coarse_scores(query, index.rows, index.mean)
        slots = np.argsort(-scores, kind="stable")
        return Ranking(slots, scores[slots], tuple(FineMatch(float(score)) for score in scores[slots]))
    if candidates is None or candidates >= len(index):
        chosen, hypotheses = np.arange(len(index)), None
    else:
        scanned, hypotheses = technique.coarse_scores(query, index.rows, index.mean)
        chosen = np.argpartition(-scanned, candidates)[:candidates]

    def compared(slots: np.ndarray) -> list[FineMatch]:
        return [
            technique.match(
                query, place_map.fine_part(index.place_ids[slot]), None if hypotheses is None else int(hypotheses[slot])
            )
            for slot in slots
        ]

    matches = compared(chosen)
    if len(chosen) < len(index):
        best = chosen[max(range(len(chosen)), key=lambda at: matches[at].score)]
        if not elsewhere(index, best, chosen, neighbour_m).any():
            others = np.flatnonzero(elsewhere(index, best, np.arange(len(index)), neighbour_m))
            others = others[np.argsort(-scanned[others])[:_COMPARED_ELSEWHERE]]
            matches += compared(others)
            chosen = np.append(chosen, others)
    scores = np.array([match.score for match in matches], np.float32)
    order = np.argsort(-scores, kind="stable")
    return Ranking(chosen[order], scores[order], tuple(matches[i] for i in order))


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
