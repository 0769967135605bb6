"""Rankings of places for a query: merging two of them, and the margin of the best place over places elsewhere."""

from collections.abc import Collection
from dataclasses import dataclass, field, replace

import numpy as np

from edgevpr.core.arrays import Bools, Ints, Singles
from edgevpr.core.contract import FineMatch
from edgevpr.core.geodesy import distance_m
from edgevpr.places.index import PlaceIndex

MAX_NEIGHBOUR_SLOTS = 2  # the neighbours of a place without a position, on each side


@dataclass(frozen=True, slots=True, kw_only=True)
class Ranking:
    """The places that a query may show, best first: their `slots` in the index, int (K,), and their `scores`, float32
    (K,). `compared` maps the slot of each place that was compared in full to its match, which has this score; places
    that were only scored quickly (see `Technique.score_quickly`) come last. `unread` int (U,): slots of places that
    cannot be read from the file, but that the query may show, because their scan score (see `Scan`) is at least that of
    the best place or among the three best. `tried`: fraction (0..1) of the rotations of the query that were tried."""

    slots: Ints
    scores: Singles
    compared: dict[int, FineMatch]
    unread: Ints = field(default_factory=lambda: np.empty(0, np.intp))
    tried: float = 1.0

    @property
    def compared_slots(self) -> list[int]:
        """The slots of the places that were compared in full, best first."""
        return [slot for slot in self.slots.tolist() if slot in self.compared]

    def promote(self, slot: int) -> "Ranking":
        """Return the ranking with the place `slot` moved to the front; it keeps its own score."""
        order = np.argsort(self.slots != slot, kind="stable")
        return replace(self, slots=self.slots[order], scores=self.scores[order])


def merge_rankings(first: Ranking, second: Ranking) -> Ranking:
    """Merge two rankings of the same query, by other expectations. Of two full comparisons, the better one counts."""
    compared = dict(first.compared)
    for slot, match in second.compared.items():
        if slot not in compared or match.score > compared[slot].score:
            compared[slot] = match
    quick = dict[int, float]()
    for ranking in (first, second):
        for slot, score in zip(ranking.slots.tolist(), ranking.scores.tolist(), strict=True):
            if slot not in compared:
                quick[slot] = max(score, quick.get(slot, score))
    scores = {slot: compared[slot].score for slot in sorted(compared, key=lambda slot: -compared[slot].score)}
    lowest = min(scores.values())
    scores |= {slot: min(quick[slot], lowest) for slot in sorted(quick, key=lambda slot: -quick[slot])}
    return Ranking(
        slots=np.array(list(scores), np.intp),
        scores=np.array(list(scores.values()), np.float32),
        compared=compared,
        unread=np.union1d(first.unread, second.unread).astype(np.intp),
        tried=min(1.0, first.tried + second.tried),
    )


def outside_neighbourhood(
    index: PlaceIndex,
    best: int,
    slots: Ints,
    neighbour_m: float,
    same_ids: Collection[int] = (),
    max_slots: int = MAX_NEIGHBOUR_SLOTS,
) -> Bools:
    """Return bool (K,), True for each of `slots` (K,) that is not a neighbour of the slot `best`: it is more than
    `neighbour_m` metres or, without a position, `max_slots` slots away, and its id is not in `same_ids`."""
    away_m = distance_m(index.lat_deg[best], index.lon_deg[best], index.lat_deg[slots], index.lon_deg[slots])
    is_outside = np.where(np.isnan(away_m), abs(slots - best) > max_slots, away_m > neighbour_m)
    return is_outside & ~np.isin(index.place_ids[slots], tuple(same_ids)) if same_ids else is_outside


def margin(ranking: Ranking, index: PlaceIndex, neighbour_m: float, same_ids: Collection[int] = ()) -> float | None:
    """Return the best score minus that of the best place elsewhere (see `outside_neighbourhood`; None: none)."""
    is_rival = outside_neighbourhood(index, int(ranking.slots[0]), ranking.slots[1:], neighbour_m, same_ids)
    runners_up = ranking.scores[1:][is_rival]
    return float(ranking.scores[0] - runners_up[0]) if len(runners_up) else None
