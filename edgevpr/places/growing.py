"""An index that takes new places while it is in use. Its arrays never grow: when they are full, it drops its worst
places."""

from collections.abc import Iterator

import numpy as np

from edgevpr.core.contract import Technique
from edgevpr.core.errors import MapError
from edgevpr.core.types import Position
from edgevpr.places.index import CoarsePart, PlaceIndex, bytes_per_place, empty_index, fill, load_index
from edgevpr.places.mapfile import PlaceMap
from edgevpr.places.thin import best_places

_MOVED_AT_ONCE = 256


class GrowingIndex:
    """The index of an open map, with free slots for more places.

    Retrieval takes `index`, which holds views that are valid until the next `add`. When all slots are taken, the best
    three quarters of the places stay (see `thin`). The map file keeps every place.
    """

    def __init__(
        self, place_map: PlaceMap, technique: Technique, *, budget_bytes: int, room: int, beside_bytes: int = 0
    ) -> None:
        """Read the map, which may be empty, and leave slots for `room` more places as far as the budget allows.

        For each place, `beside_bytes` of the budget are left to other arrays that grow with the index (see
        `sequence`). Raises MapError for a budget that holds no place.
        """
        each = bytes_per_place(technique.spec) + beside_bytes
        self._in_file = len(place_map)
        capacity = min(budget_bytes // each, self._in_file + room)
        if not capacity:
            raise MapError(
                f"{place_map.path}: a place takes {each} bytes in RAM and the budget is {budget_bytes}: "
                "raise --budget-mb."
            )
        self._map, self._technique = place_map, technique
        self._packs = technique.spec.packed is not None
        self._mean = place_map.mean_coarse() if self._packs else None
        self._mean_of = self._in_file  # number of places in this mean
        self._slots = empty_index(technique.spec, capacity, self._mean)
        self._taken = 0
        if self._in_file:
            free = self._slots.part(0, min(self._in_file, capacity), self._mean)
            loaded = load_index(place_map, technique, len(free) * each, into=free, beside_bytes=beside_bytes)
            self._taken = len(loaded)

    @property
    def index(self) -> PlaceIndex:
        return self._slots.part(0, self._taken, self._mean)

    @property
    def nbytes(self) -> int:
        """Bytes of all slots, taken or free: the index never takes more."""
        return self._slots.nbytes

    def add(
        self, place_id: int, position: Position | None, coarse: np.ndarray, heading_deg: float | None = None
    ) -> None:
        """Add a place that `PlaceMap.add` has confirmed. Its id must be larger than all ids in the index.

        Raises MapError where the file cannot be read. The index can still be used after that: it holds the places
        that it could read, all packed with the same mean. A place that is damaged is left out, and raises nothing.
        """
        if self._taken == len(self._slots):
            self._thin()
        at, slots = self._taken, self._slots
        slots.place_ids[at] = place_id
        slots.lat_deg[at], slots.lon_deg[at] = (position.lat_deg, position.lon_deg) if position else (np.nan, np.nan)
        slots.heading_deg[at] = np.nan if heading_deg is None else heading_deg
        slots.rows[at] = self._technique.pack(coarse[None], self._mean)[0] if self._packs else coarse
        self._taken += 1
        self._in_file += 1
        # Rows are packed as differences from the mean, and the first few places are a poor estimate of the mean.
        if self._packs and self._in_file >= 2 * self._mean_of:
            self._repack()

    def _thin(self) -> None:
        index = self.index
        # Quality is read from the file: thinning is too rare to justify four more bytes a place in RAM.
        quality = np.fromiter(self._map.qualities(index.place_ids), float, len(index))
        kept = best_places(index.lat_deg, index.lon_deg, quality, 3 * len(index) // 4, index.place_ids)
        # A place moves to a lower slot or stays, so an overwritten place has already been moved or is dropped.
        for start in range(0, len(kept), _MOVED_AT_ONCE):
            block = kept[start : start + _MOVED_AT_ONCE]
            for array in index.arrays.values():
                array[start : start + len(block)] = array[block]
        self._taken = len(kept)

    def _repack(self) -> None:
        """Pack all places anew. One that can no longer be read is dropped: its row is packed with the old mean."""
        mean = self._map.mean_coarse()
        packed = 0
        try:
            for written in fill(self._slots.part(0, self._taken, mean), self._held_parts(), self._technique):
                packed = written
        finally:
            if packed:  # rows packed with the old mean and with the new one must not be mixed
                self._mean, self._mean_of, self._taken = mean, self._in_file, packed

    def _held_parts(self) -> Iterator[CoarsePart]:
        """Yield the parts of the places in the index that can be read. What is written into the index meanwhile is what
        has been yielded, so it never overtakes the ids that are still to be found."""
        held = 0
        for part in self._map.coarse_parts():
            while held < self._taken and self._slots.place_ids[held] < part[0]:
                held += 1
            if held < self._taken and self._slots.place_ids[held] == part[0]:
                held += 1
                yield part
