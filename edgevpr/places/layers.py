"""Layers of a map: groups of places that were cut from an orthophoto at the same footprint. Most maps have one layer.

A picture matches best among places that show slightly less ground, in finer detail. So if a flight is higher or lower
than planned, a map with several footprints recognises more of its pictures."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from edgevpr.core.arrays import Doubles, Ints
from edgevpr.places.index import PlaceIndex
from edgevpr.places.mapfile import PlaceMap
from edgevpr.places.retrieve import Expectation

# Footprint of the places that match a picture best, divided by the picture's (benchmarks/results/from_space.md)
_BEST_FOOTPRINT_RATIO = 0.92
_MAX_LAYER_RATIO = 1.2  # footprints whose ratio is smaller belong to one layer


@dataclass(frozen=True, slots=True)
class Layers:
    """The `footprints_m` of a map, ascending: those at which its places were cut or, in a map with one layer,
    `median_m`, the median of all places (None: unknown, and `footprints_m` is empty). With several layers, `place_ids`
    int64 (M,), ascending, are the places that were cut, and `layer` int (M,) is the index of each one's footprint."""

    median_m: float | None
    footprints_m: tuple[float, ...]
    place_ids: Ints
    layer: Ints

    def choose_footprint(self, picture_m: float | None) -> float | None:
        """Return the footprint of the layer to search for a picture with the footprint `picture_m`; None: unknown."""
        if not picture_m or not self.footprints_m:
            return None
        return self.footprints_m[int(_find_nearest(self.footprints_m, _BEST_FOOTPRINT_RATIO * picture_m))]

    def narrow_search(self, expected: Expectation, index: PlaceIndex, footprint_m: float | None) -> Expectation:
        """Narrow a search to the places of the index that were cut at about `footprint_m` (None: search all layers), if
        any of them is in reach. Places that were not cut from an orthophoto are kept."""
        if footprint_m is None or len(self.footprints_m) < 2:
            return expected
        rows = np.minimum(np.searchsorted(self.place_ids, index.place_ids), len(self.place_ids) - 1)
        is_listed, layer = self.place_ids[rows] == index.place_ids, _find_nearest(self.footprints_m, footprint_m)
        is_other_layer = is_listed & (self.layer[rows] != layer)
        in_reach = ~is_other_layer if expected.in_reach is None else expected.in_reach & ~is_other_layer
        return replace(expected, in_reach=in_reach) if in_reach.any() else expected


def read_layers(place_map: PlaceMap) -> Layers:
    """Read the layers of a map. Raises MapError."""
    place_ids, length_m, is_surveyed = place_map.read_footprints()
    footprints_m: list[float] = []
    for footprint_m in np.unique(length_m[is_surveyed]).tolist():
        if not footprints_m or footprint_m > _MAX_LAYER_RATIO * footprints_m[-1]:
            footprints_m.append(footprint_m)
    median_m = float(np.median(length_m)) if len(length_m) else None
    if len(footprints_m) < 2:
        return Layers(median_m, (median_m,) if median_m else (), np.zeros(0, int), np.zeros(0, int))
    order = np.argsort(place_ids[is_surveyed])
    layer = _find_nearest(footprints_m, length_m[is_surveyed][order])
    return Layers(median_m, tuple(footprints_m), place_ids[is_surveyed][order], layer)


def _find_nearest(footprints_m: Sequence[float], length_m: float | Doubles) -> Ints:
    """Return the index of the footprint that is closest, by ratio, to `length_m` or to each of its lengths."""
    log_ratios = np.subtract.outer(np.log(length_m), np.log(footprints_m))
    return np.asarray(np.abs(log_ratios).argmin(axis=-1))
