"""Making places: every frame is encoded, and is on the disk before the next one is taken."""

from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass

from edgevpr.core.contract import Technique
from edgevpr.core.errors import ImageError, ModelError
from edgevpr.core.types import Frame
from edgevpr.frames.mask import AnyMask
from edgevpr.mapmaking.gaps import Gaps, Kept
from edgevpr.places.index import empty_index
from edgevpr.places.mapfile import PlaceMap
from edgevpr.places.rows import readable
from edgevpr.power.meter import QueryMeter
from edgevpr.runtime.recognise.gate import says_nothing
from edgevpr.runtime.recognise.judge import ACCEPT_NOTHING
from edgevpr.runtime.recognise.levelling import AnyLevelling, laid
from edgevpr.runtime.recognise.recogniser import Recogniser
from edgevpr.runtime.recognise.salience_gate import Gate, NoGate


@dataclass(frozen=True, slots=True, kw_only=True)
class MappingResult:
    """Counts of frames: places added, how many of those have no position and how many are of low quality, frames that
    were in the map already, frames that say nothing, and frames that were not memorable, by what they lacked."""

    added: int
    without_position: int
    already_here: int
    of_low_quality: int
    says_nothing: int
    not_memorable: dict[str, int]


def build_map(
    frames: Iterable[Frame],
    technique: Technique,
    place_map: PlaceMap,
    meter: QueryMeter,
    unusable: Callable[[ImageError], None] | None = None,
    mask: AnyMask | None = None,
    gate: Gate | NoGate | None = None,
    gaps: Gaps | None = None,
    levelling: AnyLevelling | None = None,
    min_quality: float = 0.0,
) -> MappingResult:
    """Add a place for every frame that is not in the map yet, so that an interrupted map can be continued.

    A frame goes through the steps of a query, with no place to find. It is in the map already if a place has the same
    name and nearly the same descriptor; the name alone does not tell, since cameras restart their numbering. A frame
    that cannot be encoded is handed to `unusable` and left out; with `unusable` None it raises ModelError. `mask`
    leaves parts of every frame out, and `levelling` lays each on the ground. Frames whose quality is below
    `min_quality` are left out, and so are those that do not pass the `gate`, but for those that `gaps` keeps.
    """
    place_map.require(technique.spec)
    nothing = empty_index(technique.spec, 0, None)
    walk = Recogniser(
        technique=technique,
        place_map=place_map,
        index=nothing,
        rule=ACCEPT_NOTHING,
        meter=meter,
        mask=mask,
        gate=gate,
        levelling=levelling,
    )
    gaps = gaps or Gaps()
    here = place_map.ids_by("source_image")
    added = without_position = already_here = of_low_quality = silent = 0
    not_memorable: Counter[str] = Counter()

    def keep(kept: Iterable[Kept]) -> None:
        nonlocal added, without_position, of_low_quality
        for event, salience in kept:
            place_map.add(laid(event.frame, event.view), event.descriptor, salience, walk.landmarks(event))
            added += 1
            without_position += event.frame.position is None
            if salience and salience.is_low:
                of_low_quality += 1
                not_memorable[event.worth.lacks] -= 1

    for frame in frames:
        seen = walk.step(frame)
        if seen.failed:
            if unusable is None:
                raise ModelError(seen.reason)
            unusable(ImageError(f"{frame.name}: {seen.reason}"))
            continue
        if says_nothing(seen.descriptor, min_quality):
            silent += 1
            continue
        if any(place_map.is_of(place_id, seen.descriptor.coarse) for place_id in here.get((readable(frame.name),), ())):
            already_here += 1
            continue
        if seen.worth and seen.worth.lacks:
            not_memorable[seen.worth.lacks] += 1
        keep(gaps.take(seen))
    keep(gaps.end())
    return MappingResult(
        added=added,
        without_position=without_position,
        already_here=already_here,
        of_low_quality=of_low_quality,
        says_nothing=silent,
        not_memorable=dict(+not_memorable),
    )
