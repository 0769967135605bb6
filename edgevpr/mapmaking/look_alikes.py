"""Finds places of a map that look alike.

A map for a forward camera stores, for each place, the place elsewhere that looks most like it (see
`evidence.LookAlikes`); to find it, each picture of the map is compared with the places elsewhere. With a camera that
looks down, landmarks distinguish similar places in flight, so look-alikes are only listed on the page of a map."""

from collections.abc import Iterable, Iterator, Mapping
from copy import copy
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from edgevpr.core.arrays import Bools, Image, Mask
from edgevpr.core.config import MatchConfig
from edgevpr.core.contract import Descriptor, Technique
from edgevpr.core.geodesy import distance_m
from edgevpr.core.types import Frame
from edgevpr.frames.mask import OverlayMask
from edgevpr.places.index import PlaceIndex, load_index
from edgevpr.places.layers import read_layers
from edgevpr.places.mapfile import PlaceMap
from edgevpr.places.ranking import MAX_NEIGHBOUR_SLOTS, outside_neighbourhood
from edgevpr.places.retrieve import Query, compare_places, scan_index
from edgevpr.power.boards import load_board
from edgevpr.power.meter import QueryMeter
from edgevpr.runtime.recognise import evidence
from edgevpr.runtime.recognise.calibration import read_calibration_for
from edgevpr.runtime.recognise.decide import Matcher, MatchSettings
from edgevpr.runtime.recognise.encoder import FrameEncoder
from edgevpr.runtime.recognise.judge import AcceptRule, make_accept_rule
from edgevpr.runtime.recognise.opening import create_technique
from edgevpr.runtime.recognise.recogniser import Recogniser
from edgevpr.runtime.recognise.recognition import Recognition

_MAX_OVERLAP_SLOTS = 10  # without positions, this many places before and after one may show the same ground
_MAX_OVERLAP_FOOTPRINTS = 2.0  # between two places; pictures further apart share no ground, whatever their heights
MIN_LOOK_ALIKE_CONFIDENCE = 0.1  # of the match with a place elsewhere that is listed on the page of a map
_DIGITS = 3  # decimals of stored agreements


class MapSearch:
    """Searches an open map, with all its places in `index`, for pictures, each as an independent query. `rule` decides
    whether a match is accepted. `slots`: the slot of each place in `index`. `near_m`: distance in metres within which
    places count as neighbours, at least a footprint. Raises MapError if the map cannot be read."""

    def __init__(self, place_map: PlaceMap, technique: Technique, rule: AcceptRule, meter: QueryMeter) -> None:
        self.technique, self.place_map, self.rule, self._meter = technique, place_map, rule, meter
        self.index, self._layers = load_index(place_map, technique), read_layers(place_map)
        self.near_m = max(rule.neighbour_m, self._layers.median_m or self.index.spacing_m() or 0.0)
        self.slots = {int(place_id): slot for slot, place_id in enumerate(self.index.place_ids)}

    def replace_rule(self, **changes: Any) -> "MapSearch":
        """Return the same search with these fields of its rule changed."""
        search = copy(self)
        search.rule = replace(self.rule, **changes)
        return search

    def find_same_ground(self, slot: int) -> Bools:
        """Return bool (N,), True for each place in the index that may share ground with the place `slot`."""
        index = self.index
        distances_m = distance_m(index.lat_deg[slot], index.lon_deg[slot], index.lat_deg, index.lon_deg)
        slots_away = abs(np.arange(len(index)) - slot)
        follows_route = evidence.count_neighbours(self.rule.look_alikes) > 0
        is_adjacent = slots_away <= (_MAX_OVERLAP_SLOTS if follows_route else 0)
        return np.where(np.isnan(distances_m), is_adjacent, distances_m <= _MAX_OVERLAP_FOOTPRINTS * self.near_m)

    def find(self, place_id: int, image: Image, mask: Mask | None, candidates: PlaceIndex) -> Recognition:
        """Search the places of `candidates` for a picture of the place `place_id`. `mask`, bool (H, W), is False where
        the picture shows no ground (None: it shows ground everywhere)."""
        encoder = FrameEncoder(technique=self.technique, mask=None if mask is None else OverlayMask(mask, sha256=""))
        matcher = Matcher(candidates, self.rule, layers=self._layers)
        settings = MatchSettings(candidates=self.technique.candidates, all_evidence=True)
        recogniser = Recogniser(encoder, self.place_map, matcher, self._meter, settings=settings)
        return recogniser.step(Frame(image=image, name=f"place {place_id}", t_mono_s=0.0))


def measure_look_alikes(search: MapSearch, pictures: Iterable[tuple[int, Descriptor]]) -> evidence.LookAlikes:
    """Compare the pictures of a map for a forward camera with its places: the neighbours in mapping order, and those
    elsewhere that a search finds. `pictures`: pairs of a place id and the descriptor of its picture. Raises MapError if
    the map cannot be read."""
    index, slots = search.index, search.slots
    all_slots = np.arange(len(index))

    def select_elsewhere(slot: int, max_slots: int) -> Bools:
        is_elsewhere: Bools = outside_neighbourhood(index, slot, all_slots, search.near_m, max_slots=max_slots)
        return np.asarray(is_elsewhere & (all_slots != slot))

    def select_adjacent(slot: int) -> Bools:
        return np.asarray(abs(all_slots - slot) == 1)

    def select_opposite(slot: int) -> Bools:
        """Select two places half the map away, as many as there are adjacent ones."""
        return np.isin(all_slots, (slot + len(index) // 2 + np.array([0, 1])) % len(index))

    # Log agreement by the slots of both places. It depends slightly on which of the two is the query.
    agreements: dict[int, dict[int, float]] = {slot: {} for slot in slots.values()}
    for place_id, descriptor in pictures:
        if (slot := slots.get(place_id)) is None:
            continue
        elsewhere = select_elsewhere(slot, MAX_NEIGHBOUR_SLOTS) & ~select_adjacent(slot)
        parts = elsewhere, ~elsewhere & (all_slots != slot), select_opposite(slot)
        for other, agreement in _search_parts(search, descriptor, parts):
            for one, two in ((slot, other), (other, slot)):
                agreements[one][two] = max(agreement, agreements[one].get(two, agreement))
    best_adjacent = {slot: _find_best(others, select_adjacent(slot))[1] for slot, others in agreements.items()}
    best_opposite = [_find_best(others, select_opposite(slot))[1] for slot, others in agreements.items()]
    typical, chance = float(np.median(list(best_adjacent.values()))), evidence.log_share(evidence.CHANCE_SHARE)
    # Along a route, pictures agree better with the adjacent ones than with as many others.
    overlaps = typical >= max(chance, float(np.median(best_opposite)) + evidence.SMALL_LEAD)
    places = {}
    for slot, others in agreements.items():
        look_alike, agreement = _find_best(others, select_elsewhere(slot, MAX_NEIGHBOUR_SLOTS if overlaps else 0))
        usual = max(typical, best_adjacent[slot]) if overlaps else chance
        if look_alike is not None:
            place_id, other_id = int(index.place_ids[slot]), int(index.place_ids[look_alike])
            places[place_id] = evidence.LookAlike(other_id, round(agreement, _DIGITS), round(usual, _DIGITS))
    return evidence.LookAlikes(overlap=overlaps, places=places)


def _find_best(agreements: Mapping[int, float], is_selected: Bools) -> tuple[int | None, float]:
    """Return the slot and the log agreement of the best-agreeing place where `is_selected`, bool (N,), is True. If no
    agreement is known there, return None and the log of no agreement."""
    slot = max((slot for slot in agreements if is_selected[slot]), key=agreements.__getitem__, default=None)
    return slot, evidence.log_share(0.0) if slot is None else agreements[slot]


def _search_parts(search: MapSearch, descriptor: Descriptor, parts: Iterable[Bools]) -> Iterator[tuple[int, float]]:
    """Search each of the `parts` of the index, bool (N,) each, for a picture. Yield the slots of the places compared in
    full, and the logarithms of their agreement."""
    technique, place_map, index = search.technique, search.place_map, search.index
    for part in parts:
        slots = np.flatnonzero(part)
        if len(slots):
            query = Query(technique=technique, descriptor=descriptor, place_map=place_map, index=index.select(slots))
            for position, match in compare_places(query, scan_index(query), technique.candidates, 0.0).compared.items():
                yield int(slots[position]), evidence.log_share(evidence.compute_share(match))


@dataclass(frozen=True, slots=True)
class FoundLookAlike:
    """The id of a place, the id of the place elsewhere that its picture matched, and the confidence of that match."""

    place_id: int
    other_id: int
    confidence: float


def find_look_alikes(
    place_map: PlaceMap, pictures: Iterable[tuple[int, Image, Mask | None]]
) -> Iterator[FoundLookAlike | None]:
    """Search the places elsewhere for each of the `pictures` (place id, encoded picture, its mask), and yield the place
    that looks like it (None: no such place). Skipped are places without a position, and pictures from which their place
    was not made; nothing is yielded for a technique without a confidence. Raises MapError if the map cannot be read."""
    technique = create_technique(place_map)
    if not evidence.list_evidence_kinds(technique.spec):
        return
    rule = make_accept_rule(technique, MatchConfig(), 1, read_calibration_for(place_map))
    search = MapSearch(place_map, technique, rule, QueryMeter(load_board("this")))
    index = search.index
    for place_id, image, mask in pictures:
        slot = search.slots.get(place_id)
        if slot is None or np.isnan(index.lat_deg[slot]):
            continue
        candidates = index.select(~search.find_same_ground(slot))
        if not len(candidates) or not place_map.has_descriptor(place_id, technique.encode(image, mask).coarse):
            continue
        event = search.find(place_id, image, mask, candidates)
        if event.best is None or event.confidence is None or event.confidence < MIN_LOOK_ALIKE_CONFIDENCE:
            yield None
        else:
            yield FoundLookAlike(place_id, event.best.place.place_id, event.confidence)
