"""Verification of places by landmarks, which had no part in finding them."""

from collections.abc import Collection
from contextlib import suppress
from functools import cached_property

import numpy as np

from edgevpr.core.errors import PlaceError
from edgevpr.frames.level import Levelled
from edgevpr.places.index import PlaceIndex
from edgevpr.places.readmap import ReadMap
from edgevpr.places.retrieve import Ranking, elsewhere
from edgevpr.runtime.recognise.agreement import (
    CONFIRMED,
    Agreement,
    Overlay,
    agreement,
    compare_near,
    compose_overlays,
)
from edgevpr.runtime.recognise.encoder import FrameEncoder
from edgevpr.runtime.recognise.landmarks import OF_PLACE, OF_QUERY, Landmarks, unpacked

_MAX_SAME_GROUND = 12  # places that may show the same ground: so many overlap on kite_ochota, which has no positions


class Verifier:
    """Compares the landmarks of one query, which are computed when first needed, with those of places. All methods
    raise PlaceError if the landmarks of a place cannot be read; the place is then left out."""

    def __init__(self, encoder: FrameEncoder, picture: Levelled, index: PlaceIndex, place_map: ReadMap) -> None:
        self._encoder, self._spec = encoder, encoder.technique.spec
        self._picture, self._index, self._map = picture, index, place_map

    @cached_property
    def landmarks(self) -> Landmarks:
        """Landmarks of the query."""
        return self._encoder.detect_landmarks(self._picture, OF_QUERY if self._spec.looks_down else OF_QUERY // 2)

    def compare_best(self, ranking: Ranking) -> Agreement | None:
        """Compare the landmarks of the query with those of the best place, expected to agree on the overlay that its
        match gives. None if the place has no landmarks, or its match no shift or rotation."""
        expected, known = self._place(ranking, int(ranking.slots[0]))
        return compare_near(self.landmarks, known, expected) if expected and known is not None else None

    def count_inliers(self, ranking: Ranking) -> int:
        """Return the number of landmarks of the query and of the best place that agree on the overlay of its match: 0
        if those of the place are unknown, or if they are at rest, as a display is."""
        expected, known = self._place(ranking, int(ranking.slots[0]))
        found = None if known is None else agreement(self.landmarks, known, expected)
        return 0 if found is None or found.is_at_rest else found.inliers

    def count_rival(self, ranking: Ranking, neighbour_m: float, same: Collection[int] = ()) -> int:
        """Return the number of landmarks of the query and of the best place elsewhere (see `places.retrieve.elsewhere`)
        that agree on the overlay of its match: 0 if there is no place elsewhere, the largest possible number if its
        landmarks are unknown. Places with the numbers `same` are not elsewhere."""
        away = ranking.slots[elsewhere(self._index, int(ranking.slots[0]), ranking.slots, neighbour_m, same)]
        if not len(away):
            return 0
        expected, known = self._place(ranking, int(away[0]))
        return OF_PLACE if known is None else agreement(self.landmarks, known, expected).inliers

    def find_same_ground(self, ranking: Ranking) -> tuple[int, ...]:
        """Of the best few places compared, return the numbers of those that show the same ground as the best one: the
        landmarks of both agree, on the overlay that follows from their matches. Empty if the best place has a position,
        since distances then tell the same."""
        slots = ranking.compared_slots[:_MAX_SAME_GROUND]
        if not slots or not np.isnan(self._index.lat_deg[slots[0]]):
            return ()
        expected, known = self._place(ranking, slots[0])
        if expected is None or known is None:
            return ()
        others = {int(self._index.place_ids[slot]): self._place(ranking, slot) for slot in slots[1:]}
        return tuple(
            place_id
            for place_id, (other, landmarks) in others.items()
            if other
            and landmarks
            and agreement(known, landmarks, compose_overlays(expected, other)).inliers >= CONFIRMED
        )

    def _place(self, ranking: Ranking, slot: int) -> tuple[Overlay | None, Landmarks | None]:
        """Return the overlay of the query on the place in row `slot`, by its match, and the place's landmarks (None:
        unknown). Both are None if the match has no shift."""
        match, cells = ranking.compared.get(slot), self._spec.cells
        if match is None or match.shift_cells is None or cells is None:
            return None, None
        width, height = self._sides
        dx, dy = match.shift_cells
        shift_share = dx * width / cells, dy * height / cells
        expected = Overlay(shift_share, match.rotation_deg or 0.0, match.height_ratio)
        try:
            blob = self._map.landmarks_of(int(self._index.place_ids[slot]))
        except PlaceError as error:
            self._map.left_out.setdefault(error.place_id, error.problem)
            raise
        with suppress(ValueError):
            return expected, None if blob is None else unpacked(blob)
        return expected, None

    @property
    def _sides(self) -> tuple[float, float]:
        """Width and height of the picture that a technique has made a square of, as shares of its longest side."""
        if self._spec.looks_down:  # its picture was put into the square, and not stretched
            return 1.0, 1.0
        height, width = self._picture.image.shape[:2]
        return width / max(height, width), height / max(height, width)
