"""Building a map: every frame of a source encoded, and added to the file before the next one is read."""

import logging
from collections.abc import Callable
from dataclasses import dataclass

from edgevpr.errors import ImageError
from edgevpr.places.mapfile import PlaceMap
from edgevpr.runtime.frames import Source
from edgevpr.types import Technique

_log = logging.getLogger(__name__)
_READ_TIMEOUT_S = 1.0


@dataclass(frozen=True, slots=True)
class MappingResult:
    """What became of the frames: added, added without a position, here already, and not usable."""

    added: int
    without_position: int
    already_here: int
    unusable: int


def build_map(
    source: Source,
    technique: Technique,
    place_map: PlaceMap,
    on_place: Callable[[int, str], None] = lambda place_id, name: None,
) -> MappingResult:
    """Add a place for every frame until the source ends; `on_place(place_id, name)` is called once it is on the disk.

    An image that cannot be used is logged and left out; one whose name is in the map already is left out, so that a
    map that was broken off can be continued.
    """
    place_map.require(technique.spec)
    here = {place.source_image for place in place_map.places()}
    added = without_position = already_here = unusable = 0
    while not source.ended:
        try:
            frame = source.read(_READ_TIMEOUT_S)
        except ImageError as error:
            _log.warning("%s", error)
            unusable += 1
            continue
        if frame is None:
            continue
        if frame.name in here:
            already_here += 1
            continue
        place_id = place_map.add(frame, technique.encode(frame.image))
        added += 1
        without_position += frame.position is None
        on_place(place_id, frame.name)
    return MappingResult(added, without_position, already_here, unusable)
