"""The page of a map (`edgevpr map info --page`): its places by quality over the ground that they show, the holes
between them, tags that are amiss, and places that look alike."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from edgevpr.core.geodesy import axes_of, distance_m, moved, offset_m
from edgevpr.core.text import nines
from edgevpr.core.types import Place
from edgevpr.mapmaking.lookalikes import LookAlike
from edgevpr.review.album import Album
from edgevpr.review.html import UNKNOWN, figure, figures, foreign, heading, section
from edgevpr.review.logged import Point
from edgevpr.review.overhead import Layer, at_of
from edgevpr.review.steps import Explored, Step, stepped

if TYPE_CHECKING:
    from edgevpr.frames.level import Lens

MOST_ASKED = 100  # pictures of a map that are looked for among the places elsewhere: each takes half a second
_QUALITIES = ((0.4, "low"), (0.6, "fair"), (0.8, "good"), (1.01, "best"))  # below which value it is called so
_HARDLY = 0.5  # mean confidence of a place that is hardly recognisable
_AMISS = 4.0  # times the usual distance of a tag from where its picture lies, as in refinement
_OF_MEDIAN = 1.1774  # of the length of a normally distributed vector, over the standard deviation of an axis
_LEAST_AMISS_M = 5.0  # less is no more than the receiver's error
_CELLS, _MOST_CELLS = 24, 4_000_000  # cells of a footprint; of the whole ground
_SURELY_SEEN = 0.75  # of a footprint: the short side of a picture of 4:3
_THINNEST, _WIDEST = 0.15, 1.0  # footprints: less is no hole; what is wider and open to one side is outside the map
_GAP = 3.0  # times the usual step between places


@dataclass(frozen=True, slots=True, kw_only=True)
class MapFindings:
    """Findings on a map: its `places`, `said` (lines of `map info`), `recognisable` (mean confidence of the right
    matches of a place that calibration asked for, by its number), and `alike`, what looks like each of the places whose
    picture was asked (None: nothing does)."""

    name: str
    places: Sequence[Place]
    said: Sequence[str]
    recognisable: Mapping[int, float]
    alike: Sequence[LookAlike | None]


def map_page_of(found: MapFindings, pictures: Album, lens: "Lens | None" = None) -> str:
    """Return the whole page. `pictures` finds those of the map, `lens` is that of its camera (None: unknown)."""
    ground = [place for place in found.places if place.position]
    amiss, alike = tags_amiss(ground), {each.place_id: each for each in found.alike if each}
    weak = {place_id for place_id, sure in found.recognisable.items() if sure < _HARDLY}
    holes, covered_m2, holes_m2 = holes_of(ground)
    gaps = [] if any(place.pose for place in ground) else gaps_of(ground)
    positions = {place.place_id: at_of(place) for place in ground}
    layers = [
        Layer("holes", "hole", holes, "area"),
        Layer("gaps of the track", "hole", gaps, "line"),
        Layer("look alike", "alike", _between(positions, alike.values()), "line"),
        Layer(
            "tags amiss",
            "amiss",
            [(recorded_at(place), at_of(place)) for place in ground if place.place_id in amiss],
            "line",
        ),
        Layer("hardly recognisable", "weak", [[at_of(each) for each in ground if each.place_id in weak]]),
        *(
            Layer(f"{name} quality", name, [[at_of(place) for place in ground if _quality(place) == name]])
            for _, name in _QUALITIES
        ),
    ]
    known = {
        "places": str(len(found.places)),
        "ground seen": figure(covered_m2 / 1e4 if covered_m2 else None, "ha"),
        "holes": figure(holes_m2 / 1e4 if covered_m2 else None, "ha"),
        "gaps": str(len(gaps)) if gaps else UNKNOWN,
        "tags amiss": str(len(amiss)),
        "hardly recognisable": str(len(weak)) if found.recognisable else UNKNOWN,
        "look alike": f"{len(alike)} <small>of {len(found.alike)}</small>" if found.alike else UNKNOWN,
    }
    notes = [
        "Holes lie between pictures that do not meet: of each counts the square that it shows in any case, three "
        "quarters of its longest side wide.",
        "A tag is amiss if its picture lies four times as far from it as is usual in this map.",
    ]
    if not found.alike:
        notes.append(
            "Places that look alike are looked for with --map-images, in a map of `cohog`, if its places were made of "
            "these pictures, with the lens of --config."
        )
    explored = Explored(
        unit="place",
        ground=ground,
        layers=[layer for layer in layers if any(layer.ways)],
        steps=[_step(place, found, amiss, alike.get(place.place_id), positions) for place in found.places],
        albums={"place": pictures},
        lens=lens,
        notes=notes if ground else [],
    )
    above = [heading(f"Map {found.name}", [f"{len(found.places)} places"]), section("", figures(known))]
    said = "".join(f"<p>{foreign(line.strip())}</p>" for line in found.said)
    return stepped(f"Map {found.name}", above, explored, [section("What it holds", said)])


def _quality(place: Place) -> str:
    return next(name for below, name in _QUALITIES if place.quality < below)


def _between(positions: Mapping[int, Point], alike: Iterable[LookAlike]) -> list[list[Point]]:
    pairs = [(positions.get(each.place_id), positions.get(each.other_id)) for each in alike]
    return [[one, other] for one, other in pairs if one and other]


def _step(
    place: Place,
    found: MapFindings,
    amiss: Mapping[int, float],
    alike: LookAlike | None,
    positions: Mapping[int, Point],
) -> Step:
    pose, sure = place.pose, found.recognisable.get(place.place_id)
    is_low = bool(place.salience and place.salience.is_low)
    known = {
        f"{_quality(place)} quality": True,
        "looks like another place": alike,
        "tag amiss": place.place_id in amiss,
        "hardly recognisable": sure is not None and sure < _HARDLY,
        "not laid by its neighbours": place.position and not pose,
        "kept to bound a gap": is_low,
        "without a position": not place.position,
    }
    sd_m = float(np.sqrt(sum(pose.covariance_m2[::2]) / 2)) if pose else None
    said = [
        f"quality {place.quality:.2f}: the share of its picture that holds information",
        f"known to {figure(sd_m, 'm')}; its picture shows {figure(pose.footprint_m, 'm')} of ground" if pose else "",
        f"its tag lies {amiss[place.place_id]:.0f} m from its picture" if place.place_id in amiss else "",
        "" if sure is None else f"asked for it with changed pictures, matches are right with {nines(sure)} (mean)",
        f"looks like place {alike.other_id}: confidence {nines(alike.confidence)}" if alike else "",
    ]
    images = {each.place_id: each.source_image for each in found.places} if alike else {}
    own, at = positions.get(place.place_id), {}
    if alike and (other := positions.get(alike.other_id)):
        at["alike"] = other
    if own:
        at |= {"weak": own} if sure is not None and sure < _HARDLY else {}
        at[_quality(place)] = own
    pictures = [("place", place.source_image, f"place {place.place_id}: {place.source_image}")]
    if alike:
        image = images.get(alike.other_id, "")
        pictures.append(("place", image, f"looks alike: place {alike.other_id}: {image}"))
    return Step(
        title=f"Place {place.place_id}: {place.source_image}",
        said=said,
        groups=[name for name, is_so in known.items() if is_so],
        at=at,
        circle_m=sd_m,
        place=place,
        pictures=[each for each in pictures if each[1]],
    )


def recorded_at(place: Place) -> Point:
    """Return where a place was recorded before refinement moved it."""
    recorded = (place.pose and place.pose.recorded) or place.position
    assert recorded is not None  # callers pass places with a position
    return recorded.lat_deg, recorded.lon_deg


def tags_amiss(ground: Sequence[Place]) -> dict[int, float]:
    """Return the places whose recorded position lies far from where their pictures lie, and how far: metres by the
    place's number. Far is more than four standard deviations of an axis, taken from the median of all."""
    moved_m = {
        place.place_id: float(distance_m(*recorded_at(place), *at_of(place)))
        for place in ground
        if place.pose and place.pose.recorded
    }
    far_m = max(_LEAST_AMISS_M, _AMISS * float(np.median(list(moved_m.values()) or [0.0])) / _OF_MEDIAN)
    return {place_id: off_m for place_id, off_m in moved_m.items() if off_m > far_m}


def gaps_of(ground: Sequence[Place]) -> list[list[Point]]:
    """Return the gaps of a track: pairs of successive places that are three times as far apart as is usual."""
    points = [at_of(place) for place in ground]
    away_m = [float(distance_m(*one, *other)) for one, other in pairwise(points)]
    usual_m = float(np.median(away_m)) if away_m else 0.0
    return [points[at : at + 2] for at, each_m in enumerate(away_m) if each_m > _GAP * usual_m > 0]


def holes_of(ground: Sequence[Place]) -> tuple[list[list[Point]], float, float]:
    """Find ground between pictures that none of them shows. Returns its outlines, the area that is shown and that of
    the holes, m2; nothing if no place has a pose."""
    posed = [(place, place.pose) for place in ground if place.pose]
    if not posed:
        return [], 0.0, 0.0
    from edgevpr.frames.images import cv2

    origin = at_of(posed[0][0])
    middles = np.array([offset_m(*origin, *at_of(place)) for place, _ in posed])
    footprint_m = float(np.median([pose.footprint_m for _, pose in posed]))
    low, high = middles.min(axis=0) - 2 * footprint_m, middles.max(axis=0) + 2 * footprint_m
    cell_m = max(footprint_m / _CELLS, float(np.sqrt(np.prod(high - low) / _MOST_CELLS)))
    shown = np.zeros(np.ceil((high - low) / cell_m).astype(int)[::-1], np.uint8)
    square = np.array([[-1, 1, 1, -1], [-1, -1, 1, 1]]) * _SURELY_SEEN / 2
    for middle, (_, pose) in zip(middles, posed, strict=True):
        corners = (middle - low)[:, None] + axes_of(pose.up_deg) @ square * pose.footprint_m
        cv2.fillConvexPoly(shown, np.rint(corners.T / cell_m).astype(np.int32), (1,))
    disc = {
        share: cv2.getStructuringElement(cv2.MORPH_ELLIPSE, [max(1, round(share * footprint_m / cell_m))] * 2)
        for share in (_THINNEST, _WIDEST)
    }
    closed = cv2.morphologyEx(shown, cv2.MORPH_CLOSE, disc[_WIDEST])
    around, _ = cv2.findContours(closed, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(closed, around, -1, (1,), cv2.FILLED)  # what is surrounded, however wide
    between = cv2.morphologyEx(closed & (1 - shown), cv2.MORPH_OPEN, disc[_THINNEST])
    outlines, _ = cv2.findContours(between, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    holes = [[moved(*origin, *(low + cell_m * point)) for point in each[:, 0]] for each in outlines]
    return holes, float(shown.sum()) * cell_m**2, float(between.sum()) * cell_m**2
