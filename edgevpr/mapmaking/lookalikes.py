"""Places of a map that look alike: each picture of the map is looked for among the places that do not show its ground.
What is found there is wrong, and the confidence says how likely it would be taken for right."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from edgevpr.core.arrays import Image, Mask
from edgevpr.core.config import load_config
from edgevpr.mapmaking.calibrate import looked_for, overlap_m, same_ground
from edgevpr.places.index import bytes_per_place, load_index
from edgevpr.places.layers import layers_of
from edgevpr.places.mapfile import PlaceMap
from edgevpr.power.boards import load_board
from edgevpr.runtime.recognise.decide import Matcher
from edgevpr.runtime.recognise.evidence import calibration_of, kinds_of
from edgevpr.runtime.recognise.judge import accept_rule
from edgevpr.runtime.recognise.opening import meter_of, technique_of

LEAST = 0.1  # confidence from which a place elsewhere looks alike


@dataclass(frozen=True, slots=True)
class LookAlike:
    """A place (its number), the place elsewhere that its picture was found at, and the confidence of that match."""

    place_id: int
    other_id: int
    confidence: float


def look_alikes(place_map: PlaceMap, pictures: Iterable[tuple[int, Image, Mask | None]]) -> Iterator[LookAlike | None]:
    """Look for each of the `pictures` (number of a place, its picture as it was encoded, the picture's mask) among the
    places elsewhere, and yield what looks like it (None: nothing does). Yields nothing for a picture that the place was
    not made of, for a place without a position, or for a technique without a confidence. Raises MapError for a map that
    cannot be read."""
    technique, config = technique_of(place_map), load_config(None, {})
    if not kinds_of(technique.spec):
        return
    index = load_index(place_map, technique, len(place_map) * bytes_per_place(technique.spec))
    rule = accept_rule(technique, config.match, 1, calibration_of(place_map))
    layers = layers_of(place_map)
    near_m, meter = overlap_m(layers, index, rule), meter_of(config, load_board("this"))
    slots = {int(place_id): slot for slot, place_id in enumerate(index.place_ids)}
    for place_id, image, mask in pictures:
        slot = slots.get(place_id)
        if slot is None or np.isnan(index.lat_deg[slot]):
            continue
        away = index.only(~same_ground(index, slot, near_m))
        if not len(away) or not place_map.is_of(place_id, technique.encode(image, mask).coarse):
            continue
        event = looked_for(place_id, image, mask, technique, Matcher(away, rule, layers=layers), place_map, meter)
        if event.best is None or event.confidence is None or event.confidence < LEAST:
            yield None
        else:
            yield LookAlike(place_id, event.best.place.place_id, event.confidence)
