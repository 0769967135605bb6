"""Several flights over the same ground (passes): the same place mapped by each becomes one place, what nobody finds
again fades, and spots that have changed are noted.

Every picture of a pass is looked for, as in flight, among the places of all others. It *finds* a place if the match is
accepted and says about where the picture was taken. A place is worth the sum of the confidences with which pictures of
other passes found it first. Pictures of different passes with near middles show the same *spot*, and if many landmarks
of both agree, in the same *condition*. Of those the worthiest place takes the others whose pictures were found. Other
conditions of the spot, such as summer and snow, stay, told by their times: a summer's place that was found from the
snow's picture is found from it more rarely than the snow's own. Only a camera that looks down knows where a picture
lies.
"""

import math
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from edgevpr.core.arrays import Doubles, Ints
from edgevpr.core.config import Config
from edgevpr.core.contract import Technique
from edgevpr.core.geodesy import distance_m, metres, moved
from edgevpr.core.types import Frame, Place
from edgevpr.frames.source import read_to_end
from edgevpr.mapmaking.making import Cuttings, FlownPictures, encoder_of
from edgevpr.places.examine import Wanted
from edgevpr.places.history import FlownPass, GroundChange, History
from edgevpr.places.index import bytes_per_place, load_index
from edgevpr.places.layers import layers_of
from edgevpr.places.mapfile import PlaceMap
from edgevpr.power.boards import load_board
from edgevpr.runtime.recognise.agreement import PROVEN, agreement
from edgevpr.runtime.recognise.decide import Matcher, WalkSettings
from edgevpr.runtime.recognise.evidence import read_calibration_for
from edgevpr.runtime.recognise.hints import RecordedPrior
from edgevpr.runtime.recognise.judge import accept_rule
from edgevpr.runtime.recognise.landmarks import Landmarks, unpacked
from edgevpr.runtime.recognise.opening import create_technique, make_meter
from edgevpr.runtime.recognise.recogniser import Recogniser

FADES_AFTER = 3  # later passes over the ground of a place, none of which found it
PASS_GAP_S = 3600.0  # between two pictures of a folder, from which on they are of two flights
SPOT = 0.25  # of the footprint: pictures with nearer middles show the same spot
_ALIKE = 1.2  # ratio of two footprints up to which their places are of use to the same flights
_ERRORS_SD = 3.0  # standard deviations by which positions may differ, where these are known worse than a spot is large
# Landmarks of two places that agree in one condition of a spot. Of one day on aerial_caliterra all but 8 of 206 pairs
# have as many, on sat_marash 66 or more; there pairs of a summer and of the winter with the earthquake have 9 or fewer.
_ONE_CONDITION = 2 * PROVEN
_KEPT = 1024  # places whose landmarks are cached


@dataclass(frozen=True, slots=True, kw_only=True)
class _Ground:
    """The N places of a map. `flight`, int (N,): the number of the pass of each, in the order of their begins, which
    are `began_s`, float (F,), inf if unknown. For each place, `spot` has those of other passes that show the same spot,
    and `alike` those of them in the same condition. `judged`: the places to be judged."""

    places: list[Place]
    flight: Ints
    began_s: Doubles
    spot: list[set[int]]
    alike: list[set[int]]
    judged: Collection[int]

    def begin_s(self, at: int) -> float:
        """Return when the pass of a place began."""
        return float(self.began_s[self.flight[at]])


# Result of looking for the picture of a place: the number of the place found (None: none), and the confidence reached
# where the picture was taken (0: the best match is elsewhere).
_Found = tuple[int | None, float]
_NOTHING: _Found = (None, 0.0)


def read_history(
    path: Path, pictures: FlownPictures | Cuttings, config: Config, folders: Mapping[str, str], inside: Wanted
) -> History:
    """Compare the passes of a map made of `pictures`, of which `folders` gives the folder of each by its name. Only
    places that are `inside` are judged. Returns what is to be removed, and what has changed; the map stays as
    it is. Raises MapError."""
    with PlaceMap.open(path) as place_map:
        technique = create_technique(place_map)
        places = list(place_map.places())
        if not technique.spec.looks_down or not places:
            return History()
        wanted = inside(place_map)
        wanted = {place.place_id for place in places} if wanted is None else set(wanted)
        judged = {at for at, place in enumerate(places) if place.place_id in wanted}
        ground = _compare_places(place_map, places, folders, judged)
        if len(np.unique(ground.flight[list(judged)])) < 2 or not any(ground.spot):
            return History()
        first, again = _find_pictures(place_map, technique, ground, pictures, config)
    linked = [set(each) for each in ground.alike]
    worth = np.zeros(len(places))
    for at in first:
        for found, _ in (first[at], again[at]):
            if found is not None:
                linked[at].add(found)
                linked[found].add(at)
        if (found := first[at][0]) is not None:
            worth[found] += first[at][1]
    merged = _merge(ground, {at for at, (found, _) in first.items() if found is not None}, worth)
    removed: dict[str, int | None] = {places[at].source_image: places[into].place_id for at, into in merged.items()}
    removed |= {places[at].source_image: None for at in _faded(ground, linked, merged)}
    confidences = {at: confidence for at, (_, confidence) in again.items()}
    return History(
        passes=tuple(_passes(ground, folders)),
        removed=removed,
        changes=tuple(_changes(ground, linked, confidences)),
    )


def _compare_places(
    place_map: PlaceMap, places: list[Place], folders: Mapping[str, str], judged: Collection[int]
) -> _Ground:
    flight, began_s = _flights(places, folders)

    @lru_cache(_KEPT)
    def landmarks(at: int) -> Landmarks | None:
        blob = place_map.landmarks_of(places[at].place_id)
        return None if blob is None else unpacked(blob)

    spot: list[set[int]] = [set() for _ in places]
    alike: list[set[int]] = [set() for _ in places]
    for a, b in _pairs(places, flight):
        one, other = landmarks(a), landmarks(b)
        is_alike = one is not None and other is not None and agreement(one, other).inliers >= _ONE_CONDITION
        for of in (spot, alike) if is_alike else (spot,):
            of[a].add(b)
            of[b].add(a)
    return _Ground(places=places, flight=flight, began_s=began_s, spot=spot, alike=alike, judged=judged)


def _pairs(places: list[Place], flight: Ints) -> list[tuple[int, int]]:
    """Return the pairs of places of different passes that show one spot, from about the same height."""
    known = [(at, place.position, place.pose) for at, place in enumerate(places)]
    lying = [(at, position, pose) for at, position, pose in known if position and pose]
    if not lying:
        return []
    numbers = np.array([at for at, _, _ in lying])
    at_m = np.column_stack(metres(*np.array([(where.lat_deg, where.lon_deg) for _, where, _ in lying]).T))
    footprint_m = np.array([pose.footprint_m for _, _, pose in lying])
    one, other = cKDTree(at_m).query_pairs(SPOT * footprint_m.max(), output_type="ndarray").T
    away_m = np.hypot(*(at_m[one] - at_m[other]).T)
    small_m, large_m = (each(footprint_m[one], footprint_m[other]) for each in (np.minimum, np.maximum))
    one, other = (numbers[each[(away_m < SPOT * small_m) & (large_m < _ALIKE * small_m)]] for each in (one, other))
    others = flight[one] != flight[other]
    return sorted(zip(one[others].tolist(), other[others].tolist(), strict=True))


def _flights(places: list[Place], folders: Mapping[str, str]) -> tuple[Ints, Doubles]:
    """Divide places into passes. Returns the number of the pass of each, and the begins; see `_Ground`."""
    taken = [
        (folders.get(place.source_image, ""), -math.inf if place.t_utc_s is None else place.t_utc_s) for place in places
    ]
    order = sorted(range(len(places)), key=lambda at: taken[at])
    flight, began = np.zeros(len(places), int), [taken[order[0]]]
    for before, at in pairwise(order):
        if taken[at][0] != taken[before][0] or taken[at][1] - taken[before][1] > PASS_GAP_S:
            began.append(taken[at])
        flight[at] = len(began) - 1
    began_s = np.array([t_s if math.isfinite(t_s) else math.inf for _, t_s in began])
    by_time = np.argsort(began_s, kind="stable")
    return np.argsort(by_time, kind="stable")[flight], began_s[by_time]


def _find_pictures(
    place_map: PlaceMap, technique: Technique, ground: _Ground, pictures: FlownPictures | Cuttings, config: Config
) -> tuple[dict[int, _Found], dict[int, _Found]]:
    """Look for the picture of each place whose spot other passes show, among the places of all others. Those of its
    condition hide the others: it is looked for again without the passes found, if more show its spot. Returns what was
    found first, and last."""
    index = load_index(place_map, technique, len(place_map) * bytes_per_place(technique.spec))
    at_of = {place.place_id: at for at, place in enumerate(ground.places)}
    flight = ground.flight[[at_of[place_id] for place_id in index.place_ids.tolist()]]
    rule = accept_rule(technique, config.match, calibration=read_calibration_for(place_map))
    candidates, layers = config.match.candidates or technique.candidates, layers_of(place_map)
    settings = WalkSettings(candidates=candidates, verify=config.match.verify)
    at_its_height = RecordedPrior(("height",), None)  # those of one spot are of one scale: no other needs to be tried
    meter, encoder = make_meter(config, load_board("this")), encoder_of(config, pictures, technique)

    def without(passes: Collection[int]) -> Recogniser:
        matcher = Matcher(index.only(~np.isin(flight, list(passes))), rule, layers=layers)
        return Recogniser(encoder, place_map, matcher, meter, settings=settings, prior=at_its_height)

    firsts: dict[int, _Found] = {}
    lasts: dict[int, _Found] = {}
    for number in range(len(ground.began_s)):
        here = np.flatnonzero(ground.flight == number).tolist()
        asked = {ground.places[at].source_image: at for at in here if ground.spot[at]}
        walk = without({number})
        for frame in filter(None, read_to_end(pictures.open(asked), lambda error: None) if asked else ()):
            at = asked[frame.name]
            firsts[at] = lasts[at] = found, _ = _find(walk, frame, ground.places[at], at_of)
            if found is not None:
                seen = {number, *(int(ground.flight[each]) for each in ground.alike[at] | {found})}
                if any(ground.flight[each] not in seen for each in ground.spot[at]):
                    lasts[at] = _find(without(seen), frame, ground.places[at], at_of)
    return firsts, lasts


def _find(walk: Recogniser, frame: Frame, place: Place, at_of: Mapping[int, int]) -> _Found:
    """Look for the picture of a place; `at_of` gives the numbers of places by their ids."""
    event, here, pose = walk.step(frame), place.position, place.pose
    best, where = event.best, event.located
    if best is None or best.place.position is None or here is None or pose is None:
        return _NOTHING
    there = best.place.position
    away_m = float(distance_m(here.lat_deg, here.lon_deg, there.lat_deg, there.lon_deg))
    confidence = event.confidence or 0.0 if away_m < pose.footprint_m else 0.0
    if where is None:
        return None, confidence
    east_m, north_m = event.view.lean_m or (0.0, 0.0)  # from the picture's middle to the aircraft
    middle = moved(where.position.lat_deg, where.position.lon_deg, -east_m, -north_m)
    sd_m = math.hypot(where.sd_m, math.sqrt((pose.covariance_m2[0] + pose.covariance_m2[2]) / 2))
    if float(distance_m(here.lat_deg, here.lon_deg, *middle)) > max(SPOT * pose.footprint_m, _ERRORS_SD * sd_m):
        return None, confidence
    return at_of[best.place.place_id], confidence


def _merge(ground: _Ground, found: Collection[int], worth: Doubles) -> dict[int, int]:
    """Return for each place that becomes part of another which one that is: of one condition of a spot the worthiest,
    of equals the newest, absorbs those whose pictures were `found`. A merged place absorbs no further ones, so that
    chains of similar places are not collapsed."""
    merged: dict[int, int] = {}
    left = set(ground.judged)
    for at in sorted(ground.judged, key=lambda at: (-worth[at], -ground.flight[at], at)):
        if at in left:
            absorbed = ground.alike[at] & left & set(found)
            merged |= dict.fromkeys(absorbed, at)
            left -= absorbed | {at}
    return merged


def _faded(ground: _Ground, linked: list[set[int]], merged: Mapping[int, int]) -> Iterator[int]:
    """Yield the places that stay, and whose spot so many later passes saw without finding it or what became part of it.
    What the newest passes saw stays: the ground is covered."""
    parts: dict[int, set[int]] = {at: {at} for at in ground.judged if at not in merged}
    for at, into in merged.items():
        parts[into].add(at)
    for at, of in sorted(parts.items()):
        seen_s = max(ground.begin_s(each) for part in of for each in (part, *linked[part]))
        over = {int(ground.flight[each]) for each in ground.spot[at] if seen_s < ground.begin_s(each) < math.inf}
        if len(over) >= FADES_AFTER:
            yield at


def _changes(ground: _Ground, linked: list[set[int]], confidences: Mapping[int, float]) -> Iterator[GroundChange]:
    """Yield a change for each picture that was looked for, over a spot of earlier passes, and is linked with none."""
    for at in sorted(set(ground.judged) & confidences.keys()):
        here, began_s = ground.places[at], ground.begin_s(at)
        earlier = [each for each in ground.spot[at] if ground.begin_s(each) < began_s < math.inf]
        if not earlier or any(ground.begin_s(each) < began_s for each in linked[at]):
            continue
        there = ground.places[max(earlier, key=lambda each: (ground.begin_s(each), each))]
        if here.position and here.t_utc_s is not None and there.t_utc_s is not None:
            yield GroundChange(
                position=here.position,
                from_s=there.t_utc_s,
                to_s=here.t_utc_s,
                confidence=confidences[at],
                from_image=there.source_image,
                to_image=here.source_image,
            )


def _passes(ground: _Ground, folders: Mapping[str, str]) -> Iterator[FlownPass]:
    for number in range(len(ground.began_s)):
        of = [ground.places[at] for at in np.flatnonzero(ground.flight == number).tolist()]
        times_s = [place.t_utc_s for place in of if place.t_utc_s is not None]
        name = folders.get(of[0].source_image, "").rstrip("/").rpartition("/")[2]
        yield FlownPass(name, min(times_s, default=None), max(times_s, default=None))
