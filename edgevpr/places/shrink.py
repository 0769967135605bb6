"""A smaller map: the places of a map that are worth most, spread so that no wide gap is left (see `thin`)."""

from pathlib import Path

import numpy as np

from edgevpr.core.types import Place
from edgevpr.places import mapfiles
from edgevpr.places.examine import examine
from edgevpr.places.mapfile import PlaceMap
from edgevpr.places.sqlite import sentences
from edgevpr.places.thin import best_places

_EMPTY_BYTES = 45_056  # of a map without places
_LOW = 0.5  # of its worth is left to a place that was kept only to bound a gap


def places_in(file_bytes: int, place_map: PlaceMap) -> int:
    """Return how many places like those of a map a file of this size holds."""
    places = len(place_map)
    each = (place_map.path.stat().st_size - _EMPTY_BYTES) / max(places, 1)
    return places if each <= 0 else min(places, max(0, int((file_bytes - _EMPTY_BYTES) / each)))


def worth_of(place: Place) -> float:
    """Return what a place is worth, 0..1: its quality, times its memorability and staticity where they are known."""
    salience = place.salience
    if salience is None:
        return place.quality
    scores = [score for score in (salience.memorability, salience.staticity) if score is not None]
    return place.quality * float(np.prod(scores)) * (_LOW if salience.is_low else 1.0)


def shrink(path: str | Path, out: Path, count: int) -> tuple[int, int]:
    """Copy the `count` best places of a map to a new one, all or none; return how many were kept, of how many.

    The places keep their numbers, and the map its calibration, which knows places by number. A place that cannot be
    read is left behind. Raises MapError for a map that cannot be read, or an `out` that is there already or cannot be
    written.
    """
    with mapfiles.whole_or_none(out) as unfinished, PlaceMap.open(path) as place_map:
        whole = [each.place_id for each in examine(place_map) if not each.problem]
        places = list(place_map.places(whole))
        kept = {whole[number] for number in chosen(places, count)}
        with PlaceMap.create(unfinished, place_map.spec) as smaller:
            smaller.record_mask(place_map.mask_sha256)
            smaller.record_calibration(place_map.calibration)
            with sentences(unfinished), smaller.transaction():
                for each in examine(place_map):
                    if each.place_id in kept:
                        smaller.insert(each.content, each.place_id)
    return len(kept), len(whole)


def chosen(places: list[Place], count: int) -> np.ndarray:
    """Choose `count` of the places by worth and coverage; return their numbers in the list, ascending."""
    points = [
        (place.position.lat_deg, place.position.lon_deg) if place.position else (np.nan, np.nan) for place in places
    ]
    lat_deg, lon_deg = np.array(points, float).reshape(-1, 2).T
    return best_places(lat_deg, lon_deg, np.array([worth_of(place) for place in places]), count)
