"""Making places: every frame encoded, and on the disk before the next one is taken."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass

from edgevpr.contract import Technique
from edgevpr.errors import ImageError, ModelError
from edgevpr.places.index import empty_index
from edgevpr.places.mapfile import PlaceMap
from edgevpr.power.meter import QueryMeter
from edgevpr.runtime.recognise.judge import AcceptRule
from edgevpr.runtime.recognise.recogniser import Recogniser
from edgevpr.types import Frame

_NO_RULE = AcceptRule(min_score=1.0, min_margin=1.0, neighbour_m=0.0)  # nothing is looked for while a map is made


@dataclass(frozen=True, slots=True)
class MappingResult:
    """What became of the frames: places added, how many of those without a position, and frames mapped before."""

    added: int
    without_position: int
    already_here: int


def build_map(
    frames: Iterable[Frame],
    technique: Technique,
    place_map: PlaceMap,
    meter: QueryMeter,
    unusable: Callable[[ImageError], None] | None = None,
) -> MappingResult:
    """Add a place for every frame that is not in the map yet, so that a map that was broken off is continued.

    A frame takes the walk of a query, with no place to find. It is there already when one of its name looks exactly the
    same: cameras start their numbers anew. A frame that cannot be encoded is handed to `unusable` and left out; None:
    it is raised, as ModelError.
    """
    place_map.require(technique.spec)
    nothing = empty_index(technique.spec, 0, None)
    walk = Recogniser(technique=technique, place_map=place_map, index=nothing, rule=_NO_RULE, meter=meter)
    here = place_map.fingerprints()
    added = without_position = already_here = 0
    for frame in frames:
        seen = walk.step(frame)
        if seen.failed:
            if unusable is None:
                raise ModelError(seen.reason)
            unusable(ImageError(f"{frame.name}: {seen.reason}"))
            continue
        if place_map.fingerprint(frame.name, seen.descriptor) in here:
            already_here += 1
            continue
        place_map.add(frame, seen.descriptor)
        added += 1
        without_position += frame.position is None
    return MappingResult(added, without_position, already_here)
