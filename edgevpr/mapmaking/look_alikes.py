"""Places of a map that look alike.

A map whose camera looks ahead knows for each place which other one looks most like it (see `evidence.LookAlikes`):
every picture of the map is compared with the places elsewhere. Looking down, landmarks tell places apart in flight, and
only the page of a map shows what looks alike.
"""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from edgevpr.core.arrays import Bools, Image
from edgevpr.core.arrays import Mask as Shown
from edgevpr.core.config import MatchConfig
from edgevpr.core.contract import Descriptor, Technique
from edgevpr.core.geodesy import distance_m
from edgevpr.core.types import Frame
from edgevpr.frames.mask import OverlayMask
from edgevpr.places.index import PlaceIndex, compute_place_bytes, load_index
from edgevpr.places.layers import read_layers
from edgevpr.places.mapfile import PlaceMap
from edgevpr.places.ranking import MAX_NEIGHBOUR_SLOTS, outside_neighbourhood
from edgevpr.places.retrieve import Query, compare_places, scan_index
from edgevpr.power.boards import load_board
from edgevpr.power.meter import QueryMeter
from edgevpr.runtime.recognise.calibration import read_calibration_for
from edgevpr.runtime.recognise.decide import Matcher, MatchSettings
from edgevpr.runtime.recognise.encoder import FrameEncoder
from edgevpr.runtime.recognise.evidence import (
    CHANCE_SHARE,
    SMALL_LEAD,
    LookAlike,
    LookAlikes,
    compute_share,
    count_neighbours,
    list_evidence_kinds,
    log_share,
)
from edgevpr.runtime.recognise.judge import AcceptRule, make_accept_rule
from edgevpr.runtime.recognise.opening import create_technique
from edgevpr.runtime.recognise.recogniser import Recogniser
from edgevpr.runtime.recognise.recognition import Recognition

_MAX_OVERLAP_SLOTS = 10  # so many places before and after one without position may show the same ground
_MAX_OVERLAP_FOOTPRINTS = 2.0  # between two places; farther apart, pictures from any heights share no ground
MIN_LOOK_ALIKE_CONFIDENCE = 0.1  # confidence from which a place elsewhere looks alike, on the page of a map
_DIGITS = 3  # of stored agreements


class MapSearch:
    """Looks for pictures in an open map, each as a query that is alone. `slots`: the slot of each place in `index`.
    `near_m`: metres within which pictures of the map count as neighbours, at least a footprint."""

    def __init__(
        self, technique: Technique, place_map: PlaceMap, index: PlaceIndex, rule: AcceptRule, *, meter: QueryMeter
    ) -> None:
        self._technique, self._place_map, self._meter = technique, place_map, meter
        self._index, self._rule = index, rule
        self._layers = read_layers(place_map)
        self.near_m = max(rule.neighbour_m, self._layers.median_m or index.spacing_m() or 0.0)
        self.slots = {int(place_id): slot for slot, place_id in enumerate(index.place_ids)}

    def find_same_ground(self, slot: int) -> Bools:
        """Return bool (N,), True for each of the index's N places that may show some ground of the place `slot`."""
        index = self._index
        away_m = distance_m(index.lat_deg[slot], index.lon_deg[slot], index.lat_deg, index.lon_deg)
        apart, is_way = abs(np.arange(len(index)) - slot), count_neighbours(self._rule.look_alikes) > 0
        beside = apart <= (_MAX_OVERLAP_SLOTS if is_way else 0)
        return np.where(np.isnan(away_m), beside, away_m <= _MAX_OVERLAP_FOOTPRINTS * self.near_m)

    def find(self, place_id: int, image: Image, shown: Shown | None, among: PlaceIndex) -> Recognition:
        """Look for a picture of the place `place_id` among some places. `shown`, bool (H, W), is False where it shows
        no ground (None: it shows ground everywhere)."""
        encoder = FrameEncoder(technique=self._technique, mask=None if shown is None else OverlayMask(shown, sha256=""))
        matcher = Matcher(among, self._rule, layers=self._layers)
        settings = MatchSettings(candidates=self._technique.candidates, all_evidence=True)
        walk = Recogniser(encoder, self._place_map, matcher, self._meter, settings=settings)
        return walk.step(Frame(image=image, name=f"place {place_id}", t_mono_s=0.0))


def measure_look_alikes(
    technique: Technique,
    place_map: PlaceMap,
    index: PlaceIndex,
    near_m: float,
    pictures: Iterable[tuple[int, Descriptor]],
) -> LookAlikes:
    """Compare the `pictures` of a map whose camera looks ahead, pairs of a place's number and the descriptor of its
    picture, with the map's places: with its neighbours in the order of mapping, and with those elsewhere that a search
    finds. `near_m`: as in `outside_neighbourhood`. Raises MapError for a map that cannot be read."""
    slots = {int(place_id): slot for slot, place_id in enumerate(index.place_ids)}
    all_slots = np.arange(len(index))

    def find_elsewhere(slot: int, beside: int) -> Bools:
        is_elsewhere: Bools = outside_neighbourhood(index, slot, all_slots, near_m, max_slots=beside)
        return np.asarray(is_elsewhere & (all_slots != slot))

    def is_beside(slot: int) -> Bools:
        return np.asarray(abs(all_slots - slot) == 1)

    def is_opposite(slot: int) -> Bools:
        """As many places as are beside one, from half the map away."""
        return np.isin(all_slots, (slot + len(index) // 2 + np.array([0, 1])) % len(index))

    # Logarithms, by the slots of both places. It depends a little on which of two pictures asks.
    agree: dict[int, dict[int, float]] = {slot: {} for slot in slots.values()}
    for place_id, descriptor in pictures:
        if (slot := slots.get(place_id)) is None:
            continue
        far = find_elsewhere(slot, MAX_NEIGHBOUR_SLOTS) & ~is_beside(slot)
        near = ~far & (all_slots != slot)
        for other, found in _compare_among(technique, place_map, index, descriptor, (far, near, is_opposite(slot))):
            for one, two in ((slot, other), (other, slot)):
                agree[one][two] = max(found, agree[one].get(two, found))
    best_beside = {slot: _find_best(others, is_beside(slot))[1] for slot, others in agree.items()}
    best_opposite = [_find_best(others, is_opposite(slot))[1] for slot, others in agree.items()]
    usual, chance = float(np.median(list(best_beside.values()))), log_share(CHANCE_SHARE)
    # Along a way, pictures agree better with those before and after them than with as many others.
    overlap = usual >= max(chance, float(np.median(best_opposite)) + SMALL_LEAD)
    places = {}
    for slot, others in agree.items():
        twin, found = _find_best(others, find_elsewhere(slot, MAX_NEIGHBOUR_SLOTS if overlap else 0))
        own = max(usual, best_beside[slot]) if overlap else chance
        if twin is not None:
            twin_id = int(index.place_ids[twin])
            places[int(index.place_ids[slot])] = LookAlike(twin_id, round(found, _DIGITS), round(own, _DIGITS))
    return LookAlikes(overlap=overlap, places=places)


def _find_best(agree: Mapping[int, float], among: Bools) -> tuple[int | None, float]:
    """Return the slot of the place that agrees best of those where `among`, bool (N,), is True, and how well; None, and
    the agreement with nothing, if it is known of none."""
    slot = max((slot for slot in agree if among[slot]), key=agree.__getitem__, default=None)
    return slot, log_share(0.0) if slot is None else agree[slot]


def _compare_among(
    technique: Technique, place_map: PlaceMap, index: PlaceIndex, descriptor: Descriptor, parts: Iterable[Bools]
) -> Iterator[tuple[int, float]]:
    """Search each of some parts of an index, bool (N,) each, for a picture. Yield the slots of the places that are
    compared in full, and the logarithms of their agreement."""
    for part in parts:
        slots = np.flatnonzero(part)
        if len(slots):
            among = index.select(slots)
            query = Query(technique=technique, descriptor=descriptor, place_map=place_map, index=among)
            for at, match in compare_places(query, scan_index(query), technique.candidates, 0.0).compared.items():
                yield int(slots[at]), log_share(compute_share(match))


@dataclass(frozen=True, slots=True)
class FoundLookAlike:
    """A place (its number), the place elsewhere that its picture was found at, and the confidence of that match."""

    place_id: int
    other_id: int
    confidence: float


def find_look_alikes(
    place_map: PlaceMap, pictures: Iterable[tuple[int, Image, Shown | None]]
) -> Iterator[FoundLookAlike | None]:
    """Look for each of the `pictures` (number of a place, its picture as it was encoded, the picture's mask) among the
    places elsewhere, and yield what looks like it (None: nothing does). Yields nothing for a picture that the place was
    not made of, for a place without a position, or for a technique without a confidence. Raises MapError for a map that
    cannot be read."""
    technique = create_technique(place_map)
    if not list_evidence_kinds(technique.spec):
        return
    index = load_index(place_map, technique, len(place_map) * compute_place_bytes(technique.spec))
    rule = make_accept_rule(technique, MatchConfig(), 1, read_calibration_for(place_map))
    search = MapSearch(technique, place_map, index, rule, meter=QueryMeter(load_board("this")))
    for place_id, image, mask in pictures:
        slot = search.slots.get(place_id)
        if slot is None or np.isnan(index.lat_deg[slot]):
            continue
        away = index.select(~search.find_same_ground(slot))
        if not len(away) or not place_map.has_descriptor(place_id, technique.encode(image, mask).coarse):
            continue
        event = search.find(place_id, image, mask, away)
        if event.best is None or event.confidence is None or event.confidence < MIN_LOOK_ALIKE_CONFIDENCE:
            yield None
        else:
            yield FoundLookAlike(place_id, event.best.place.place_id, event.confidence)
