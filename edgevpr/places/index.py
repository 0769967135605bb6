"""The part of a map that is in RAM: one row a place, in arrays made once, never larger than the budget."""

from dataclasses import dataclass
from itertools import islice

import numpy as np

from edgevpr.errors import MapError
from edgevpr.geodesy import distance_m
from edgevpr.places.mapfile import PlaceMap
from edgevpr.types import Technique, TechniqueSpec

_BYTES_BESIDE_ROW = 8 + 8 + 8  # id, latitude, longitude
_PACKED_AT_ONCE = 64


@dataclass(frozen=True, slots=True)
class PlaceIndex:
    """`place_ids` int64 (N,), `lat_deg` and `lon_deg` float64 (N,) with NaN where a place has no position, and `rows`
    (N, *row shape): all contiguous. A place's number in these arrays is its *slot*; slots follow the order of mapping.
    `mean` is that of the coarse parts, None for a technique that does not pack them."""

    place_ids: np.ndarray
    lat_deg: np.ndarray
    lon_deg: np.ndarray
    rows: np.ndarray
    mean: np.ndarray | None

    def __len__(self) -> int:
        return len(self.place_ids)

    @property
    def nbytes(self) -> int:
        return self.place_ids.nbytes + self.lat_deg.nbytes + self.lon_deg.nbytes + self.rows.nbytes

    def spacing_m(self) -> float | None:
        """Median distance from a place to the next one mapped, metres; None where no two have a position."""
        away_m = distance_m(self.lat_deg[:-1], self.lon_deg[:-1], self.lat_deg[1:], self.lon_deg[1:])
        known = away_m[~np.isnan(away_m)]
        return float(np.median(known)) if len(known) else None


def bytes_per_place(spec: TechniqueSpec) -> int:
    """Resident bytes of one place of the index."""
    return spec.row.nbytes + _BYTES_BESIDE_ROW


def load_index(place_map: PlaceMap, technique: Technique, budget_bytes: int) -> PlaceIndex:
    """Read the coarse parts of a map, packed as the technique wants them.

    Raises MapError, before anything is allocated, where the index would exceed the budget.
    """
    spec = technique.spec
    places, each = len(place_map), bytes_per_place(spec)
    if not places:
        raise MapError(f"{place_map.path} holds no place yet: add some with `edgevpr map build --append`.")
    if places * each > budget_bytes:
        raise MapError(
            f"{place_map.path} needs {places * each / 1e6:.1f} MB in RAM for {places} places and the budget of "
            f"{budget_bytes / 1e6:g} MB holds {budget_bytes // each}: raise --budget-mb to "
            f"{np.ceil(places * each / 1e5) / 10:g}, map fewer places, or use a technique with smaller rows "
            "(see `edgevpr profile`)."
        )
    index = PlaceIndex(
        np.empty(places, np.int64),
        np.full(places, np.nan),
        np.full(places, np.nan),
        np.empty((places, *spec.row.shape), spec.row.dtype),
        place_map.mean_coarse() if spec.packed else None,
    )
    # A map that another program is adding to may have grown since it was counted: the new places wait for next time.
    parts = islice(place_map.coarse_parts(), places)
    waiting = np.empty((_PACKED_AT_ONCE, *spec.coarse.shape), spec.coarse.dtype)
    for start in range(0, places, _PACKED_AT_ONCE):
        count = min(_PACKED_AT_ONCE, places - start)
        for at, (place_id, position, coarse) in enumerate(islice(parts, count)):
            index.place_ids[start + at] = place_id
            if position:
                index.lat_deg[start + at], index.lon_deg[start + at] = position
            waiting[at] = coarse
        rows = technique.pack(waiting[:count], index.mean) if spec.packed else waiting[:count]
        index.rows[start : start + count] = rows
    return index
