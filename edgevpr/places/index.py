"""The part of a map that is in RAM: one row a place, in arrays made once, never larger than the budget."""

from dataclasses import dataclass

import numpy as np

from edgevpr.errors import MapError
from edgevpr.geodesy import distance_m
from edgevpr.places.mapfile import PlaceMap
from edgevpr.types import TechniqueSpec

_BYTES_BESIDE_ROW = 8 + 8 + 8  # id, latitude, longitude


@dataclass(frozen=True, slots=True)
class PlaceIndex:
    """`place_ids` int64 (N,), `lat_deg` and `lon_deg` float64 (N,) with NaN where a place has no position, and `rows`
    (N, *coarse shape): all contiguous. A place's number in these arrays is its *slot*; slots follow the order of
    mapping."""

    place_ids: np.ndarray
    lat_deg: np.ndarray
    lon_deg: np.ndarray
    rows: np.ndarray

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
    return spec.coarse.nbytes + _BYTES_BESIDE_ROW


def load_index(place_map: PlaceMap, budget_bytes: int) -> PlaceIndex:
    """Read the coarse parts of a map. Raises MapError, before anything is allocated, where they exceed the budget."""
    places, each = len(place_map), bytes_per_place(place_map.spec)
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
        np.empty((places, *place_map.spec.coarse.shape), place_map.spec.coarse.dtype),
    )
    # A map that another program is adding to may have grown since it was counted: the new places wait for next time.
    for slot, (place_id, position, row) in zip(range(places), place_map.coarse_parts(), strict=False):
        index.place_ids[slot] = place_id
        if position:
            index.lat_deg[slot], index.lon_deg[slot] = position
        index.rows[slot] = row
    return index
