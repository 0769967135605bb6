"""From a query to the places that it may be: one scan of the index, then the best candidates compared in full."""

from dataclasses import dataclass

import numpy as np

from edgevpr.geodesy import distance_m
from edgevpr.places.index import PlaceIndex
from edgevpr.places.mapfile import PlaceMap
from edgevpr.types import Candidate, Descriptor, FineMatch, Technique

_NEIGHBOURS_WITHOUT_POSITION = 2


@dataclass(frozen=True, slots=True)
class Ranking:
    """Places best first: `slots` int (K,) of the index, `scores` float32 (K,), and what is known of each match."""

    slots: np.ndarray
    scores: np.ndarray
    matches: tuple[FineMatch, ...]


def rank(
    technique: Technique, query: Descriptor, place_map: PlaceMap, index: PlaceIndex, candidates: int | None = None
) -> Ranking:
    """Scan all places of the index, and compare the best `candidates` of them in full.

    None, or as many as there are: all places in full under every hypothesis, without a scan (exact, and slow).
    """
    if technique.spec.fine is None:
        scores, _ = technique.coarse_scores(query, index.rows, index.mean)
        slots = np.argsort(-scores, kind="stable")
        return Ranking(slots, scores[slots], tuple(FineMatch(float(score)) for score in scores[slots]))
    if candidates is None or candidates >= len(index):
        chosen, hypotheses = np.arange(len(index)), None
    else:
        scores, hypotheses = technique.coarse_scores(query, index.rows, index.mean)
        chosen = np.argpartition(-scores, candidates)[:candidates]
    matches = [
        technique.match(
            query, place_map.fine_part(index.place_ids[slot]), None if hypotheses is None else int(hypotheses[slot])
        )
        for slot in chosen
    ]
    scores = np.array([match.score for match in matches], np.float32)
    order = np.argsort(-scores, kind="stable")
    return Ranking(chosen[order], scores[order], tuple(matches[i] for i in order))


def margin(ranking: Ranking, index: PlaceIndex, neighbour_m: float) -> float:
    """By how much the best place beats the best one elsewhere: score difference, the whole score if there is none.

    Elsewhere: more than `neighbour_m` metres from the best place, or, where either has no position, more than two
    places before or after it in the map.
    """
    best, others = ranking.slots[0], ranking.slots[1:]
    away_m = distance_m(index.lat_deg[best], index.lon_deg[best], index.lat_deg[others], index.lon_deg[others])
    unknown = np.isnan(away_m)
    elsewhere = np.where(unknown, abs(others - best) > _NEIGHBOURS_WITHOUT_POSITION, away_m > neighbour_m)
    runners_up = ranking.scores[1:][elsewhere]
    return float(ranking.scores[0] - (runners_up[0] if len(runners_up) else 0))


def named(ranking: Ranking, index: PlaceIndex, place_map: PlaceMap, first: int | None = None) -> list[Candidate]:
    """The `first` places of a ranking (None: all) with what the map file says of them, best first."""
    places = place_map.places(index.place_ids[ranking.slots[:first]])
    return [Candidate(place, match) for place, match in zip(places, ranking.matches[:first], strict=True)]


def retrieve(
    technique: Technique,
    query: Descriptor,
    place_map: PlaceMap,
    index: PlaceIndex,
    candidates: int | None = None,
    first: int | None = 10,
) -> list[Candidate]:
    """`rank`, then `named`: the `first` places that the query may be, best first."""
    return named(rank(technique, query, place_map, index, candidates), index, place_map, first)
