"""Making places: every frame is encoded, and is on the disk before the next one is taken."""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from edgevpr.core.contract import Technique
from edgevpr.core.errors import ImageError, ModelError
from edgevpr.core.geodesy import distance_m
from edgevpr.core.types import Frame, Position, Salience
from edgevpr.frames.mask import AnyMask
from edgevpr.places.index import empty_index
from edgevpr.places.mapfile import PlaceMap
from edgevpr.places.rows import readable
from edgevpr.power.meter import QueryMeter
from edgevpr.runtime.recognise.gate import says_nothing
from edgevpr.runtime.recognise.judge import ACCEPT_NOTHING
from edgevpr.runtime.recognise.levelling import AnyLevelling, laid
from edgevpr.runtime.recognise.recogniser import Recogniser
from edgevpr.runtime.recognise.recognition import Recognition
from edgevpr.runtime.recognise.salience_gate import GAP_FRAMES, Gate, NoGate, best_of

_NO_PIXELS = np.empty((0, 0), np.uint8)
Kept = tuple[Recognition, Salience | None]


class Gaps:
    """Takes one event after the other, and gives back those that become places, in their order."""

    def __init__(self, most_frames: int = GAP_FRAMES, most_m: float | None = None) -> None:
        self._most_frames, self._most_m = most_frames, most_m
        self._waiting: list[Recognition] = []
        self._last: Position | None = None  # of the last place; before there is one, of the first frame
        self._has_begun = False

    def take(self, event: Recognition) -> Iterator[Kept]:
        """Yield what becomes a place now that the frame of `event` is seen."""
        if event.worth is None:
            yield event, None
            return
        while self._waiting and (len(self._waiting) >= self._most_frames or self._is_too_far(event.frame.position)):
            yield from self._best_waiting()
        if event.worth.reason is None:
            self._waiting.clear()
            yield self._kept(event), event.worth.salience
        else:
            self._last = self._last or event.frame.position
            self._waiting.append(replace(event, frame=replace(event.frame, image=_NO_PIXELS)))

    def end(self) -> Iterator[Kept]:
        """Yield what becomes a place at the end: of a recording in which nothing has passed, the best of it."""
        if not self._has_begun and self._waiting:
            yield from self._best_waiting()

    def _best_waiting(self) -> Iterator[Kept]:
        """Yield the best of those that wait; those after the last of them wait on."""
        best = best_of([event.worth.short_by for event in self._waiting])
        last = max(number for number, is_best in enumerate(best) if is_best)
        chosen = [event for event, is_best in zip(self._waiting, best, strict=True) if is_best]
        self._waiting = self._waiting[last + 1 :]
        for event in chosen:
            yield self._kept(event), replace(event.worth.salience, is_low=True)

    def _kept(self, event: Recognition) -> Recognition:
        self._has_begun, self._last = True, event.frame.position or self._last
        return event

    def _is_too_far(self, position: Position | None) -> bool:
        if self._most_m is None or position is None or self._last is None:
            return False
        return distance_m(self._last.lat_deg, self._last.lon_deg, position.lat_deg, position.lon_deg) > self._most_m


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
