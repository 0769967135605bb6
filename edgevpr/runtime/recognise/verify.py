"""Verification: checks the best place by landmarks, which had no part in finding it. The recogniser uses it.

It is for cameras that look straight down only: ahead, near and far landmarks shift by different amounts.
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

_MAY_BE_THE_SAME = 12  # places that may show the same ground: so many overlap on kite_ochota, which has no positions


def landmarks_of(technique: Technique, picture: Levelled) -> bytes | None:
    """Return the landmarks of a picture as a map stores them; None for a technique that does not look straight down."""
    return packed(describe(picture.image, picture.mask, OF_PLACE)) if technique.spec.cells else None


class Verification:
    """Compares the landmarks of one query with those of places. They are computed when first needed."""

    def __init__(self, spec: TechniqueSpec, picture: Levelled, index: PlaceIndex, place_map: PlaceMap) -> None:
        self._spec, self.picture = spec, picture
        self._index, self._map = index, place_map
        self._query: Landmarks | None = None

    def proof(self, ranking: Ranking) -> Agreement | None:
        """Compare the landmarks of the query with those of the best place, expected as its match says. None if they
        cannot be compared: the place has no landmarks, or its match no shift or rotation.

        Raises PlaceError if the landmarks of the place cannot be read; the place is then left out.
        """
        expected, known = self._place(ranking, int(ranking.slots[0]))
        return held_against(self._of_query(), known, expected) if expected and known is not None else None

    def rival(self, ranking: Ranking, neighbour_m: float, same: Collection[int]) -> int:
        """Return the number of landmarks of the best place elsewhere (see `places.retrieve.elsewhere`) that agree as
        its own match expects: 0 if there is no such place, and the largest possible number if its landmarks are
        unknown. The places with the numbers `same` are not elsewhere. Raises PlaceError as `proof`."""
        away = ranking.slots[elsewhere(self._index, int(ranking.slots[0]), ranking.slots, neighbour_m, same)]
        if not len(away):
            return 0
        expected, known = self._place(ranking, int(away[0]))
        return OF_PLACE if known is None else agreement(self._of_query(), known, expected).inliers

    def same_ground(self, ranking: Ranking) -> tuple[int, ...]:
        """Return the numbers of the first places that show the same ground as the best one: their landmarks agree with
        those of the best place as both matches expect. Empty if places have positions, which then tell. Raises as
        `proof`."""
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
        """Return

        * the overlay of the query on a place that its match gives (None: the match has none),
        * the landmarks of the place (None: it has none, or none that this version can read).
        """
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
        """Return the landmarks of the query, computed at the first call."""
        if self._query is None:
            self._query = describe(self.picture.image, self.picture.mask, OF_QUERY)
        return self._query
