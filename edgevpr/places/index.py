"""The index: the part of a map that is held in RAM, in arrays that are allocated once, within a memory budget.

`load_index` makes it, and `retrieve` searches it."""

import logging
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import islice

import numpy as np

from edgevpr.core.arrays import Array, Bools, Doubles, Floats, Ints, LatLon, Singles
from edgevpr.core.contract import Technique, TechniqueSpec
from edgevpr.core.errors import MapError
from edgevpr.core.geodesy import distance_m, project_to_metres
from edgevpr.core.types import Position
from edgevpr.places.mapfile import PlaceMap

_log = logging.getLogger(__name__)
_METADATA_BYTES = 8 + 8 + 8 + 2  # id, latitude, longitude, heading
_MIN_STEP_M = 1.0  # between two positions; below it, they are one
_PACK_BATCH = 32  # places
_BLOCK_PLACES = 256  # the minimum of each block is stored, to find the overall minimum quickly
_OUTLINE_DTYPE = np.dtype([("id", np.int64), ("lat_deg", float), ("lon_deg", float), ("quality", float)])

CoarsePart = tuple[int, LatLon | None, float | None, Array]  # one item of `PlaceMap.read_coarse_parts`


@dataclass(frozen=True, slots=True, kw_only=True)
class PlaceIndex:
    """The part of a map that is held in RAM to be scanned: contiguous arrays of N places, in the order in which they
    were mapped. A place's index in these arrays is its *slot*.

    `place_ids` is int64 (N,). `lat_deg` and `lon_deg` are float64 (N,), NaN for a place without a position.
    `heading_deg` is float16 (N,), accurate to a quarter of a degree, NaN if unknown. `rows` (N, *row shape) has the
    coarse parts. If the technique packs them, `mean` is the mean coarse part of the map; otherwise None."""

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
        """The arrays that have one entry per place, by name of the field."""
        return {name: getattr(self, name) for name in ("place_ids", "lat_deg", "lon_deg", "heading_deg", "rows")}

    @property
    def nbytes(self) -> int:
        return sum(array.nbytes for array in self.arrays.values())

    def select(self, slots: slice | Array) -> "PlaceIndex":
        """Return the index of the places at `slots` only. Its arrays are views if `slots` is a slice, and copies if it
        is an array of slots or a mask, bool (N,)."""
        return replace(self, **{name: array[slots] for name, array in self.arrays.items()})

    def spacing_m(self) -> float | None:
        """Return the median distance in metres between successive places, without those taken at one position (exposure
        brackets); None if no two in a row have positions."""
        steps_m = distance_m(self.lat_deg[:-1], self.lon_deg[:-1], self.lat_deg[1:], self.lon_deg[1:])
        steps_m = steps_m[~np.isnan(steps_m)]
        apart_m = steps_m[steps_m >= _MIN_STEP_M]
        return float(np.median(apart_m if len(apart_m) else steps_m)) if len(steps_m) else None

    def find_within(self, position: Position, radius_m: float) -> Bools:
        """Return bool (N,), True for each place within `radius_m` metres of `position`; False if it has no position."""
        return distance_m(position.lat_deg, position.lon_deg, self.lat_deg, self.lon_deg) <= radius_m


def compute_place_bytes(spec: TechniqueSpec) -> int:
    """Return the number of bytes of RAM that one place of the index needs."""
    return spec.row.nbytes + _METADATA_BYTES


def load_index(
    place_map: PlaceMap, technique: Technique, budget_bytes: int | None = None, extra_bytes: int = 0
) -> PlaceIndex:
    """Load the coarse parts of a map, packed by the technique. Return the index of the loaded places.

    If `budget_bytes` (None: no limit) is too small for all, only those chosen by `choose_places` are loaded.
    `extra_bytes` per place are reserved for other arrays that grow with the index (see `sequence`). Places that cannot
    be read are recorded in `PlaceMap.left_out`. Raises MapError if none can be read, or the budget is too small."""
    spec = technique.spec
    places, place_bytes = len(place_map), compute_place_bytes(spec) + extra_bytes
    if not places:
        raise MapError(f"{place_map.path} is empty: add places with `edgevpr map build --append`.")
    if budget_bytes is None:
        budget_bytes = places * place_bytes
    if budget_bytes < place_bytes:
        raise MapError(
            f"{place_map.path}: the budget of {budget_bytes} bytes of RAM is too small for one place ({place_bytes}): "
            "raise --budget-mb."
        )
    capacity = min(places, budget_bytes // place_bytes)
    index = allocate_index(spec, capacity, place_map.compute_mean_coarse() if spec.packed else None)
    # Places that another program has added since they were counted are ignored until the next load.
    parts: Iterator[CoarsePart] = islice(place_map.read_coarse_parts(), places)
    if capacity < places:
        _log.warning(
            f"{place_map.path}: its {places} places need {places * place_bytes / 1e6:.1f} MB of RAM, but the budget is "
            f"{budget_bytes / 1e6:g} MB: only the {capacity} best are loaded; raise --budget-mb to "
            f"{np.ceil(places * place_bytes / 1e5) / 10:g} for all."
        )
        rows = np.fromiter(islice(place_map.read_outlines(), places), _OUTLINE_DTYPE)
        chosen_ids = rows["id"][choose_places(rows["lat_deg"], rows["lon_deg"], rows["quality"], capacity)]
        parts = _filter_parts(parts, chosen_ids)
    count = _fill_index(index, parts, technique)
    if not count:
        raise MapError(f"{place_map.path}: none of its {places} places can be read: restore a copy, or build it again.")
    if place_map.left_out:
        _log.warning(
            "%s: %d damaged places are left out: `edgevpr map check` lists them, `edgevpr map repair` removes them.",
            place_map.path,
            len(place_map.left_out),
        )
    return index.select(slice(count))


def allocate_index(spec: TechniqueSpec, capacity: int, mean: Singles | None) -> PlaceIndex:
    """Allocate arrays for `capacity` places, with `mean` as in `PlaceIndex`. The operating system provides memory for
    `place_ids` and `rows` only when they are written."""
    return PlaceIndex(
        place_ids=np.empty(capacity, np.int64),
        lat_deg=np.full(capacity, np.nan),
        lon_deg=np.full(capacity, np.nan),
        heading_deg=np.full(capacity, np.nan, np.float16),
        rows=np.empty((capacity, *spec.row.shape), spec.row.dtype),
        mean=mean,
    )


def _fill_index(index: PlaceIndex, parts: Iterator[CoarsePart], technique: Technique) -> int:
    """Write coarse parts (from `PlaceMap.read_coarse_parts`), packed by the technique, to the slots of `index` in
    blocks, until parts or slots run out. Return the number of slots written."""
    spec = technique.spec
    batch = np.empty((_PACK_BATCH, *spec.coarse.shape), spec.coarse.dtype)
    count = 0
    while block := list(islice(parts, min(_PACK_BATCH, len(index) - count))):
        for row, (*_, coarse) in enumerate(block):
            batch[row] = coarse
        rows = batch[: len(block)] if index.mean is None else technique.pack(batch[: len(block)], index.mean)
        index.rows[count : count + len(block)] = rows
        for slot, (place_id, point, heading_deg, _) in enumerate(block, start=count):
            index.place_ids[slot] = place_id
            index.lat_deg[slot], index.lon_deg[slot] = point or (np.nan, np.nan)
            index.heading_deg[slot] = np.nan if heading_deg is None else heading_deg
        count += len(block)
    return count


def _filter_parts(parts: Iterator[CoarsePart], place_ids: Ints) -> Iterator[CoarsePart]:
    """Yield the parts of the places whose ids are in `place_ids`, which is ascending."""
    for part in parts:
        row = int(np.searchsorted(place_ids, part[0]))
        if row < len(place_ids) and place_ids[row] == part[0]:
            yield part


def choose_places(lat_deg: Floats, lon_deg: Floats, quality: Floats, capacity: int) -> Ints:
    """Choose `capacity` of N places, which must be in the order in which they were mapped; return their indices, int,
    ascending. `lat_deg`, `lon_deg` (NaN: unknown) and `quality` (0..1) are float (N,).

    Places are dropped one at a time, always the one with the lowest value: its quality times the distance to the nearer
    of its two remaining neighbours along the track. So gaps stay small, and good places are kept. The first and the
    last place are always kept."""
    count = len(quality)
    if count <= capacity:
        return np.arange(count)
    east_m, north_m = project_to_metres(lat_deg, lon_deg)
    # If a position is unknown, the median distance of successive places is used instead.
    steps_m = np.hypot(np.diff(east_m), np.diff(north_m))
    median_m = (float(np.nanmedian(steps_m)) if np.isfinite(steps_m).any() else 0.0) or 1.0

    def measure_distance_m(a: int, b: int) -> float:
        gap_m = math.hypot(east_m[b] - east_m[a], north_m[b] - north_m[a])
        return median_m * (b - a) if math.isnan(gap_m) else gap_m

    def rate_place(left: int, place: int, right: int) -> float:
        if left < 0 or right >= count:
            return math.inf
        # A tiny fraction of the distance between its neighbours breaks ties among places at the same position.
        nearer_m = min(measure_distance_m(left, place), measure_distance_m(place, right))
        return (nearer_m + 1e-6 * measure_distance_m(left, right)) * max(float(quality[place]), 1e-3)

    # No lists, and few arrays: a map may have a million places.
    lefts, rights = np.arange(-1, count - 1, dtype=np.int32), np.arange(1, count + 1, dtype=np.int32)
    values = np.full(-(-count // _BLOCK_PLACES) * _BLOCK_PLACES, np.inf)  # infinite for dropped places too
    for place in range(count):
        values[place] = rate_place(place - 1, place, place + 1)
    blocks = values.reshape(-1, _BLOCK_PLACES)
    block_minima = blocks.min(axis=1)
    is_kept = np.ones(count, bool)
    for _ in range(count - max(capacity, 2)):
        block = int(block_minima.argmin())
        place = block * _BLOCK_PLACES + int(blocks[block].argmin())
        is_kept[place], values[place] = False, np.inf
        neighbours = int(lefts[place]), int(rights[place])
        rights[neighbours[0]], lefts[neighbours[1]] = neighbours[1], neighbours[0]
        for neighbour in neighbours:
            values[neighbour] = rate_place(int(lefts[neighbour]), neighbour, int(rights[neighbour]))
        for changed_block in {block, *(neighbour // _BLOCK_PLACES for neighbour in neighbours)}:
            block_minima[changed_block] = blocks[changed_block].min()
    return np.flatnonzero(is_kept)[:capacity]
