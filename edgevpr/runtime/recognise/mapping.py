"""Building a map: every frame encoded, and on the disk before the next one is taken."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass

from edgevpr.errors import ImageError, ModelError
from edgevpr.places.mapfile import PlaceMap
from edgevpr.types import Frame, Technique


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
    unusable: Callable[[ImageError], None] | None = None,
) -> MappingResult:
    """Add a place for every frame that is not in the map yet, so that a map that was broken off is continued.

    A frame is there already when one of its name looks exactly the same: cameras start their numbers anew. A frame of
    which a network makes nothing is handed to `unusable` and left out; None: it is raised, as ModelError.
    """
    place_map.require(technique.spec)
    here = place_map.fingerprints()
    added = without_position = already_here = 0
    for frame in frames:
        try:
            descriptor = technique.encode(frame.image)
        except ModelError as error:
            if unusable is None:
                raise
            unusable(ImageError(f"{frame.name}: {error}"))
            continue
        if place_map.fingerprint(frame.name, descriptor) in here:
            already_here += 1
            continue
        place_map.add(frame, descriptor)
        added += 1
        without_position += frame.position is None
    return MappingResult(added, without_position, already_here)
