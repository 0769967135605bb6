"""Visits to places in the map file: the fine part of each is read, and compared with the query.

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
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from edgevpr.core.contract import Descriptor, FineMatch, Technique
from edgevpr.core.errors import MapError, PlaceError
from edgevpr.places.candidates import Chosen
from edgevpr.places.index import PlaceIndex
from edgevpr.places.mapfile import PlaceMap

Seen = tuple[float, Chosen]  # about the score of a place, and the best of the hypotheses to try

_MANY = 3  # unreadable places of one query, that may be the file's fault


@dataclass(frozen=True, slots=True, kw_only=True)
class Visit:
    """Comparisons of one query with places of a map; `scores` float32 (N,) are those of the scan.

    Both ways raise PlaceError where a place cannot be read, after all have been tried; it is then left out. They raise
    MapError where the file cannot be read.
    """

    technique: Technique
    query: Descriptor
    scores: np.ndarray
    place_map: PlaceMap
    index: PlaceIndex

    def in_full(self, chosen: Sequence[Chosen]) -> list[FineMatch]:
        """Compare each of the places in full, under the hypotheses to try."""

        def match(slot: int, fine: np.ndarray, hypotheses: list[int] | None) -> FineMatch:
            found = self.technique.match(self.query, fine, hypotheses)
            return replace(found, score=self._with_scan(slot, found.score))

        return self._each(chosen, match)

    def at_a_glance(self, chosen: Sequence[Chosen]) -> list[Seen]:
        """Look at each of the places for a moment. Returns about the score of each, and its best hypothesis, best place
        first."""

        def glance(slot: int, fine: np.ndarray, hypotheses: list[int] | None) -> Seen:
            score, best = self.technique.glance(self.query, fine, hypotheses)
            return self._with_scan(slot, score), (slot, best)

        return sorted(self._each(chosen, glance), key=lambda seen: -seen[0])

    def _with_scan(self, slot: int, score: float) -> float:
        return score * (1 + float(self.scores[slot])) / 2 if self.technique.spec.scan_counts else score

    def _each(self, chosen: Sequence[Chosen], look: Callable) -> list:
        found, unreadable = [], []
        for slot, hypotheses in chosen:
            try:
                fine, point = self.place_map.fine_part(self.index.place_ids[slot])
                require_there(self.place_map, self.index, slot, point)
            except PlaceError as error:
                unreadable.append(error)
                continue
            found.append(look(slot, fine, hypotheses))
        if unreadable:
            raise _left_out_now(self.place_map, unreadable, len(chosen))
        return found


def left_out(place_map: PlaceMap, index: PlaceIndex) -> np.ndarray:
    """Tell which places of the index could not be read so far, bool (N,)."""
    return np.isin(index.place_ids, list(place_map.left_out)) if place_map.left_out else np.zeros(len(index), bool)


def require_there(place_map: PlaceMap, index: PlaceIndex, slot: int, point: tuple[float, float] | None) -> None:
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
