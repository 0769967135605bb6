"""Making places: every frame is encoded, and is on the disk before the next one is taken."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass

from edgevpr.contract import Technique
from edgevpr.errors import ImageError, ModelError
from edgevpr.frames.mask import AnyMask
from edgevpr.places.index import empty_index
from edgevpr.places.mapfile import PlaceMap
from edgevpr.places.rows import readable
from edgevpr.power.meter import QueryMeter
from edgevpr.runtime.recognise.judge import AcceptRule
from edgevpr.runtime.recognise.recogniser import Recogniser
from edgevpr.types import Frame

_NO_RULE = AcceptRule(min_score=1.0, min_margin=1.0, neighbour_m=0.0)  # no place is searched for while a map is made


@dataclass(frozen=True, slots=True)
class MappingResult:
    """Counts of frames: places added, how many of those have no position, and frames that were in the map already."""

    added: int
    without_position: int
    already_here: int


def build_map(
    frames: Iterable[Frame],
    technique: Technique,
    place_map: PlaceMap,
    meter: QueryMeter,
    unusable: Callable[[ImageError], None] | None = None,
    mask: AnyMask | None = None,
) -> MappingResult:
    """Add a place for every frame that is not in the map yet, so that an interrupted map can be continued.

    A frame goes through the steps of a query, with no place to find. It is in the map already if a place has the same
    name and nearly the same descriptor; the name alone does not tell, since cameras restart their numbering. A frame
    that cannot be encoded is handed to `unusable` and left out; with `unusable` None it raises ModelError. `mask`
    leaves parts of every frame out.
    """
    place_map.require(technique.spec)
    nothing = empty_index(technique.spec, 0, None)
    walk = Recogniser(technique=technique, place_map=place_map, index=nothing, rule=_NO_RULE, meter=meter, mask=mask)
    here = place_map.by_name()
    added = without_position = already_here = 0
    for frame in frames:
        seen = walk.step(frame)
        if seen.failed:
            if unusable is None:
                raise ModelError(seen.reason)
            unusable(ImageError(f"{frame.name}: {seen.reason}"))
            continue
        if any(place_map.is_of(place_id, seen.descriptor) for place_id in here.get(readable(frame.name), ())):
            already_here += 1
            continue
        place_map.add(frame, seen.descriptor)
        added += 1
        without_position += frame.position is None
    return MappingResult(added, without_position, already_here)
