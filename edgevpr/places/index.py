"""The part of a map that is in RAM: one row a place, in arrays that are made once and never exceed the budget.

An index may take new places while it is in use (`GrowingIndex`): when its arrays are full, it drops its worst places.
"""

import logging
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import islice

import numpy as np

from edgevpr.core.arrays import Array, Bools, Doubles, Ints, LatLon, Singles
from edgevpr.core.contract import Technique, TechniqueSpec
from edgevpr.core.errors import MapError
from edgevpr.core.geodesy import distance_m
from edgevpr.core.types import Position
from edgevpr.places.mapfile import PlaceMap
from edgevpr.places.thin import best_places

_log = logging.getLogger(__name__)
_BYTES_BESIDE_ROW = 8 + 8 + 8 + 2  # id, latitude, longitude, heading
_PACKED_AT_ONCE = 32
_MOVED_AT_ONCE = 256

CoarsePart = tuple[int, LatLon | None, float | None, Array]  # of `PlaceMap.coarse_parts`


@dataclass(frozen=True, slots=True, kw_only=True)
class PlaceIndex:
    """The arrays of N places, all contiguous. The number of a place in them is its *slot*; slots follow the order of
    mapping.

    `place_ids` is int64 (N,). `lat_deg` and `lon_deg` are float64 (N,), NaN where a place has no position.
    `heading_deg` is float16 (N,), accurate to a quarter of a degree, NaN where unknown. `rows` is (N, *row shape).
    `mean` is the mean of the coarse parts, None for a technique that does not pack them.
    """

    place_ids: Ints
    lat_deg: Doubles
    lon_deg: Doubles
    heading_deg: Array
    rows: Array
    mean: Singles | None

    def __len__(self) -> int:
        return len(self.place_ids)

    @property
    def arrays(self) -> dict[str, Array]:
        """The arrays with one entry a place, by name."""
        return {name: getattr(self, name) for name in ("place_ids", "lat_deg", "lon_deg", "heading_deg", "rows")}

    @property
    def nbytes(self) -> int:
        return sum(array.nbytes for array in self.arrays.values())

    @property
    def knows_headings(self) -> bool:
        """True where at least one place has a heading."""
        return not np.isnan(self.heading_deg).all()

    def first(self, count: int) -> "PlaceIndex":
        """Return the index of the first `count` places: the same arrays, seen in part."""
        return replace(self, **{name: array[:count] for name, array in self.arrays.items()})

    def spacing_m(self) -> float | None:
        """Return the median distance in metres between places mapped one after the other; None where no such pair has
        positions."""
        away_m = distance_m(self.lat_deg[:-1], self.lon_deg[:-1], self.lat_deg[1:], self.lon_deg[1:])
        known = away_m[~np.isnan(away_m)]
        return float(np.median(known)) if len(known) else None

    def within(self, position: Position, radius_m: float) -> Bools:
        """Tell which places are within `radius_m` metres of `position`, bool (N,); False for one without a position.

        The map file can be searched by area too. But 10 000 distances from these arrays take less than half a
        millisecond, of a query of tens of milliseconds. They need no file, and they are ordered by slot.
        """
        return distance_m(position.lat_deg, position.lon_deg, self.lat_deg, self.lon_deg) <= radius_m


def bytes_per_place(spec: TechniqueSpec) -> int:
    """Return the resident bytes of one place of the index."""
    return spec.row.nbytes + _BYTES_BESIDE_ROW


def load_index(
    place_map: PlaceMap, technique: Technique, budget_bytes: int, into: PlaceIndex | None = None, beside_bytes: int = 0
) -> PlaceIndex:
    """Load the coarse parts of a map, packed by the technique, into new arrays or those of `into`; return the index of
    the places that were loaded.

    Where the budget does not hold all places, the best ones are loaded (see `thin`); the map file keeps all. For each
    place, `beside_bytes` of the budget are left to other arrays that grow with the index (see `sequence`). Places that
    cannot be read are left out (see `PlaceMap.left_out`). Raises MapError for a map without places, for one of which no
    place can be read, and for a budget that holds no place.
    """
    spec = technique.spec
    places, each = len(place_map), bytes_per_place(spec) + beside_bytes
    if not places:
        raise MapError(f"{place_map.path} holds no place yet: add some with `edgevpr map build --append`.")
    capacity = _capacity(place_map, each, budget_bytes, places)
    if into is None:
        into = empty_index(spec, capacity, place_map.mean_coarse() if spec.packed else None)
    # Another program may have added places since they were counted: those are left out until the next load.
    parts: Iterator[CoarsePart] = islice(place_map.coarse_parts(), places)
    if capacity < places:
        _log.warning(
            f"{place_map.path} needs {places * each / 1e6:.1f} MB in RAM for its {places} places and the budget is "
            f"{budget_bytes / 1e6:g} MB: the {capacity} best are used; raise --budget-mb to "
            f"{np.ceil(places * each / 1e5) / 10:g} for all."
        )
        place_ids, lat_deg, lon_deg, quality = _outlines(place_map, places)
        kept = place_ids[best_places(lat_deg, lon_deg, quality, capacity)]
        parts = (part for part in parts if _holds(kept, part[0]))
    loaded = 0
    for written in fill(into, parts, technique):
        loaded = written
    if not loaded:
        raise MapError(f"{place_map.path}: none of its {places} places can be read: restore a copy, or build it again.")
    if place_map.left_out:
        _log.warning(
            "%s: %d places are damaged and left out: `edgevpr map check` names them, `edgevpr map repair` drops them.",
            place_map.path,
            len(place_map.left_out),
        )
    return into.first(loaded)


def empty_index(spec: TechniqueSpec, capacity: int, mean: Singles | None) -> PlaceIndex:
    """Make arrays for `capacity` places. The system provides the memory of ids and rows only as they are written."""
    return PlaceIndex(
        place_ids=np.empty(capacity, np.int64),
        lat_deg=np.full(capacity, np.nan),
        lon_deg=np.full(capacity, np.nan),
        heading_deg=np.full(capacity, np.nan, np.float16),
        rows=np.empty((capacity, *spec.row.shape), spec.row.dtype),
        mean=mean,
    )


def fill(index: PlaceIndex, parts: Iterator[CoarsePart], technique: Technique) -> Iterator[int]:
    """Write as many `parts` as the index has slots, a block at a time, and yield how many are written after each block:
    in the end fewer than there are slots, where there are fewer parts. A slot is written completely or not at all."""
    spec = technique.spec
    waiting = np.empty((_PACKED_AT_ONCE, *spec.coarse.shape), spec.coarse.dtype)
    filled = 0
    while block := list(islice(parts, min(_PACKED_AT_ONCE, len(index) - filled))):
        for at, (*_, coarse) in enumerate(block):
            waiting[at] = coarse
        rows = waiting[: len(block)] if index.mean is None else technique.pack(waiting[: len(block)], index.mean)
        index.rows[filled : filled + len(block)] = rows
        for at, (place_id, point, heading_deg, _) in enumerate(block, start=filled):
            index.place_ids[at] = place_id
            index.lat_deg[at], index.lon_deg[at] = point or (np.nan, np.nan)
            index.heading_deg[at] = np.nan if heading_deg is None else heading_deg
        filled += len(block)
        yield filled


def _capacity(place_map: PlaceMap, place_bytes: int, budget_bytes: int, wanted: int) -> int:
    """Return how many places the budget holds, `wanted` at most. Raises MapError for none."""
    if budget_bytes < place_bytes:
        raise MapError(
            f"{place_map.path}: a place takes {place_bytes} bytes in RAM and the budget is {budget_bytes}: "
            "raise --budget-mb."
        )
    return min(wanted, budget_bytes // place_bytes)


def _outlines(place_map: PlaceMap, places: int) -> Doubles:
    """Return id, lat_deg, lon_deg and quality of the first `places` places that can be read, float64 (4, N)."""
    columns = np.empty((4, places))
    count = 0
    for count, outline in enumerate(islice(place_map.outlines(), places), start=1):
        columns[:, count - 1] = outline
    return columns[:, :count]


def _holds(ascending: Array, number: int) -> bool:
    at = int(np.searchsorted(ascending, number))
    return at < len(ascending) and ascending[at] == number


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
        capacity = _capacity(place_map, each, budget_bytes, self._in_file + room)
        self._map, self._technique = place_map, technique
        self._packs = technique.spec.packed is not None
        self._mean = place_map.mean_coarse() if self._packs else None
        self._mean_of = self._in_file  # number of places in this mean
        self._slots = empty_index(technique.spec, capacity, self._mean)
        self._taken = 0
        if self._in_file:
            free = self._slots.first(min(self._in_file, capacity))
            loaded = load_index(place_map, technique, len(free) * each, into=free, beside_bytes=beside_bytes)
            self._taken = len(loaded)

    @property
    def index(self) -> PlaceIndex:
        return replace(self._slots.first(self._taken), mean=self._mean)

    @property
    def nbytes(self) -> int:
        """Bytes of all slots, taken or free: the index never takes more."""
        return self._slots.nbytes

    def add(self, place_id: int, position: Position | None, coarse: Array, heading_deg: float | None = None) -> None:
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
        slots.rows[at] = coarse if self._mean is None else self._technique.pack(coarse[None], self._mean)[0]
        self._taken += 1
        self._in_file += 1
        # Rows are packed as differences from the mean, and the first few places are a poor estimate of the mean.
        if self._packs and self._in_file >= 2 * self._mean_of:
            self._repack()

    def _thin(self) -> None:
        index = self.index
        # Quality is read from the file: thinning is too rare to justify four more bytes a place in RAM.
        quality = np.full(len(index), np.nan)
        for place_id, _, _, known in self._map.outlines():
            at = int(np.searchsorted(index.place_ids, place_id))
            if at < len(index) and index.place_ids[at] == place_id:
                quality[at] = known
        for place_id in index.place_ids[np.isnan(quality)].tolist():
            self._map.left_out.setdefault(place_id, "its row is gone")
        kept = best_places(index.lat_deg, index.lon_deg, np.nan_to_num(quality), 3 * len(index) // 4, index.place_ids)
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
            for written in fill(replace(self.index, mean=mean), self._held_parts(), self._technique):
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
