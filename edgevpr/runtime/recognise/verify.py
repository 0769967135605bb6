"""Verification: a second look at the best place, by landmarks that have no part in how it was found.

It is for cameras that look straight down: ahead, near and far landmarks move by different steps.
"""

from collections.abc import Collection
from contextlib import suppress

import numpy as np

from edgevpr.core.contract import Technique, TechniqueSpec
from edgevpr.core.errors import PlaceError
from edgevpr.frames.level import Levelled
from edgevpr.places.index import PlaceIndex
from edgevpr.places.mapfile import PlaceMap
from edgevpr.places.retrieve import Ranking, elsewhere
from edgevpr.runtime.recognise.agreement import CONFIRMED, Agreement, Overlay, agreement, held_against, onto
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
        expected, known = self._place(ranking, int(ranking.slots[0]))
        return held_against(self._of_query(), known, expected) if expected and known is not None else None

    def rival(self, ranking: Ranking, neighbour_m: float, same: Collection[int]) -> int:
        """Return how many landmarks of the best place elsewhere (see `places.retrieve.elsewhere`) agree, as its own
        match says that it lies: 0 where there is no such place, and of one without landmarks all that there could be.
        The places numbered `same` are not elsewhere. Raises PlaceError as `proof`."""
        away = ranking.slots[elsewhere(self._index, int(ranking.slots[0]), ranking.slots, neighbour_m, same)]
        if not len(away):
            return 0
        expected, known = self._place(ranking, int(away[0]))
        return OF_PLACE if known is None else agreement(self._of_query(), known, expected).inliers

    def same_ground(self, ranking: Ranking) -> tuple[int, ...]:
        """Return the numbers of those of the first places without a position that show ground of the best one: the
        landmarks of both lie over each other as the two matches say that they must. Where places have positions,
        these tell. Raises PlaceError as `proof`."""
        slots = ranking.compared_slots[:_MAY_BE_THE_SAME]
        if not slots or not np.isnan(self._index.lat_deg[slots[0]]):
            return ()
        expected, known = self._place(ranking, slots[0])
        if expected is None or known is None:
            return ()
        same = []
        for slot in slots[1:]:
            other, landmarks = self._place(ranking, slot)
            if other is None or landmarks is None:
                continue
            if agreement(known, landmarks, onto(expected, other)).inliers >= CONFIRMED:
                same.append(int(self._index.place_ids[slot]))
        return tuple(same)

    def _place(self, ranking: Ranking, slot: int) -> tuple[Overlay | None, Landmarks | None]:
        """Return how the query is expected to lie on a place by its match, and the landmarks of the place. None where
        the match does not say it, and where the place has no landmarks, or none that this edgevpr understands."""
        match, cells = ranking.compared.get(slot), self._spec.cells
        if match is None or match.shift_cells is None or match.rotation_deg is None or cells is None:
            return None, None
        dx, dy = match.shift_cells
        expected = Overlay((dx / cells, dy / cells), match.rotation_deg, match.height_ratio)
        try:
            blob = self._map.landmarks_of(int(self._index.place_ids[slot]))
        except PlaceError as error:
            self._map.left_out.setdefault(error.place_id, error.problem)
            raise
        with suppress(ValueError):
            return expected, None if blob is None else unpacked(blob)
        return expected, None

    def _of_query(self) -> Landmarks:
        if self._query is None:
            self._query = describe(self.picture.image, self.picture.mask, OF_QUERY)
        return self._query
