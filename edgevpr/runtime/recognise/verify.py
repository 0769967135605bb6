"""Verification: a second look at the best place, by landmarks that have no part in how it was found.

It is for cameras that look straight down: ahead, near and far landmarks move by different steps.
"""

from collections.abc import Sequence

import numpy as np

from edgevpr.core.contract import FineMatch, Technique, TechniqueSpec
from edgevpr.core.errors import PlaceError
from edgevpr.frames.level import Levelled
from edgevpr.places.index import PlaceIndex
from edgevpr.places.mapfile import PlaceMap
from edgevpr.places.retrieve import Ranking, elsewhere
from edgevpr.runtime.recognise.agreement import CONFIRMED, Agreement, Expected, agreement, held_against, onto
from edgevpr.runtime.recognise.landmarks import OF_PLACE, OF_QUERY, Landmarks, describe, packed, unpacked

_MAY_BE_THE_SAME = 12  # places; on kite_ochota, which has no positions, as many as overlap


def landmarks_of(technique: Technique, picture: Levelled) -> bytes | None:
    """Return the landmarks that a map keeps of a picture; None for a technique that does not look straight down."""
    return packed(describe(picture.image, picture.mask, OF_PLACE)) if technique.spec.cells else None


class Verification:
    """Landmarks of one query, held against those of places. They are found when a place is first asked for that has
    some."""

    def __init__(self, spec: TechniqueSpec, picture: Levelled, index: PlaceIndex, place_map: PlaceMap) -> None:
        self._spec, self.picture = spec, picture
        self._index, self._map = index, place_map
        self._query: Landmarks | None = None

    def proof(self, ranking: Ranking) -> Agreement | None:
        """Hold the landmarks of the query against those of the best place, as its match says that it lies. None where
        there is nothing to hold: the place has no landmarks, or its match no step or rotation.

        Raises PlaceError where the landmarks of the place cannot be read; the place is then left out.
        """
        slot = int(ranking.slots[0])
        expected = self._expected(ranking.compared.get(slot))
        known = self._known(slot) if expected else None
        return held_against(self._asked(), known, expected) if known is not None else None

    def rival(self, ranking: Ranking, neighbour_m: float, same: Sequence[int]) -> int:
        """Return how many landmarks of the best place elsewhere (see `places.retrieve.elsewhere`) agree, as its own
        match says that it lies: 0 where there is no such place, and of one without landmarks all that there could be.
        The places numbered `same` are not elsewhere. Raises PlaceError as `proof`."""
        away = ranking.slots[elsewhere(self._index, ranking.slots[0], ranking.slots, neighbour_m, same)]
        if not len(away):
            return 0
        expected = self._expected(ranking.compared.get(int(away[0])))
        known = self._known(int(away[0])) if expected else None
        return OF_PLACE if known is None else agreement(self._asked(), known, expected).inliers

    def same_ground(self, ranking: Ranking) -> tuple[int, ...]:
        """Return the numbers of those of the first places without a position that show ground of the best one: the
        landmarks of both lie over each other as the two matches say that they must. Where places have positions,
        these tell. Raises PlaceError as `proof`."""
        slots = [slot for slot in ranking.slots.tolist() if slot in ranking.compared][:_MAY_BE_THE_SAME]
        best = slots[0] if slots else None
        way = self._expected(ranking.compared.get(best))
        if way is None or not np.isnan(self._index.lat_deg[best]) or (known := self._known(best)) is None:
            return ()
        same = []
        for slot in slots[1:]:
            other = self._expected(ranking.compared[slot])
            landmarks = self._known(slot) if other else None
            if landmarks is not None and agreement(known, landmarks, onto(way, other)).inliers >= CONFIRMED:
                same.append(int(self._index.place_ids[slot]))
        return tuple(same)

    def _expected(self, match: FineMatch | None) -> Expected | None:
        if match is None or match.shift_cells is None or match.rotation_deg is None or self._spec.cells is None:
            return None
        dx, dy = match.shift_cells
        return Expected((dx / self._spec.cells, dy / self._spec.cells), match.rotation_deg, match.height_ratio)

    def _known(self, slot: int) -> Landmarks | None:
        """Return the landmarks of a place; None where it has none, or none that this edgevpr understands."""
        try:
            blob = self._map.landmarks_of(int(self._index.place_ids[slot]))
        except PlaceError as error:
            self._map.left_out.setdefault(error.place_id, error.problem)
            raise
        try:
            return None if blob is None else unpacked(blob)
        except ValueError:
            return None

    def _asked(self) -> Landmarks:
        if self._query is None:
            self._query = describe(self.picture.image, self.picture.mask, OF_QUERY)
        return self._query
