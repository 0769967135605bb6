"""The page of a map (`edgevpr map info --page`): its places by quality over the ground that they show, the gaps between
them, GPS tags that do not fit, and places that look alike."""

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from edgevpr.core.geodesy import distance_m, offset_m, offset_position, picture_axes
from edgevpr.core.text import format_probability
from edgevpr.core.types import Place
from edgevpr.mapmaking.look_alikes import FoundLookAlike
from edgevpr.review.album import Album
from edgevpr.review.logged import Point
from edgevpr.review.webpage import UNKNOWN, Layer, Section, Step, format_number, make_layer, make_page, to_point

if TYPE_CHECKING:
    from edgevpr.frames.level import Lens

MAX_QUERIES = 100  # images of a map that are searched among the places elsewhere; each takes half a second
_QUALITY_CLASSES = {"low": 0.4, "fair": 0.6, "good": 0.8, "best": 1.01}  # below which value it is called so
_MAX_HARD_CONFIDENCE = 0.5  # mean confidence of a place that is hard to recognise
_MAX_TAG_SIGMA = 4.0  # times the usual distance of a tag from where its picture lies, as in refinement
_MEDIAN_PER_SIGMA = 1.1774  # median length of a normally distributed vector over the standard deviation of an axis
_MIN_TAG_OFF_M = 5.0  # less is the receiver's error
_CELLS_PER_FOOTPRINT = 24  # of a footprint
_MAX_CELLS = 4_000_000  # of the whole ground
_COVERED_SHARE = 0.75  # of a footprint: the short side of a picture of 4:3
_MIN_GAP_FOOTPRINTS = 0.15  # footprints: less is no gap
_MAX_GAP_FOOTPRINTS = 1.0  # footprints: what is wider and open to one side is outside the map
_NOTES = (
    "Coverage gaps lie between pictures that do not meet: each picture is assumed to show at least a square of three "
    "quarters of its long side.",
    "A GPS tag is inconsistent if it is four times farther from its picture than is usual in this map.",
)
_NO_PICTURES = (
    "Look-alikes are searched with --map-images, in a map of `cohog`, if its places were made from these images with "
    "the lens of --config."
)


def make_map_page(
    name: str,
    lines: Sequence[str],
    places: Sequence[Place],
    recognisable: Mapping[int, float],
    look_alikes: Sequence[FoundLookAlike | None],
    pictures: Album,
    lens: "Lens | None",
) -> str:
    """Return the whole page of the map `name`. `lines` are those of `map info`. `recognisable` is the mean confidence
    of the right matches of a place that calibration asked for, by its number; `look_alikes` are what looks like each of
    the places whose picture was looked for (None: nothing does). `pictures` finds those of the map, `lens` is that of
    its camera (None: unknown)."""
    ground = [place for place in places if place.position]
    points = {place.place_id: to_point(place) for place in ground}
    tags_off_m, twins = find_inconsistent_tags(ground), {alike.place_id: alike for alike in look_alikes if alike}
    hard = {place_id for place_id, confidence in recognisable.items() if confidence < _MAX_HARD_CONFIDENCE}
    gaps, covered_m2, gaps_m2 = find_gaps(ground)
    steps = list(_make_steps(places, recognisable, tags_off_m, twins, points))
    pairs = [(points.get(twin.place_id), points.get(twin.other_id)) for twin in twins.values()]
    tags = [(read_recorded_position(place), to_point(place)) for place in ground if place.place_id in tags_off_m]
    layers = [
        Layer("coverage gaps", "hole", gaps, "area"),
        Layer("look alike", "alike", [(one, other) for one, other in pairs if one and other], "line"),
        Layer("inconsistent GPS tags", "amiss", tags, "line"),
        make_layer(steps, "hard to recognise", "weak"),
        *(make_layer(steps, f"{quality} quality", quality) for quality in _QUALITY_CLASSES),
    ]
    figures = {
        "places": str(len(places)),
        "ground seen": format_number(covered_m2 / 1e4 if covered_m2 else None, "ha"),
        "coverage gaps": format_number(gaps_m2 / 1e4 if covered_m2 else None, "ha"),
        "inconsistent GPS tags": str(len(tags_off_m)),
        "hard to recognise": str(len(hard)) if recognisable else UNKNOWN,
        "look alike": f"{len(twins)} of {len(look_alikes)}" if look_alikes else UNKNOWN,
    }
    notes = [*_NOTES, *([] if look_alikes else [_NO_PICTURES])]
    head = {
        "title": f"Map {name}",
        "known": [f"{len(places)} places"],
        "figures": figures,
        "warnings": [],
        "span_s": None,
    }
    content = Section("Content", [line.strip() for line in lines])
    albums = {"place": pictures}
    return make_page(head, steps, ground, layers, albums, lens=lens, notes=notes if ground else [], sections=[content])


def _classify_quality(place: Place) -> str:
    return next(name for name, limit in _QUALITY_CLASSES.items() if place.quality < limit)


def _make_steps(
    places: Sequence[Place],
    recognisable: Mapping[int, float],
    tags_off_m: Mapping[int, float],
    twins: Mapping[int, FoundLookAlike],
    points: Mapping[int, Point],
) -> Iterable[Step]:
    images = {place.place_id: place.source_image for place in places}
    for place in places:
        place_id, pose = place.place_id, place.pose
        confidence, twin = recognisable.get(place_id), twins.get(place_id)
        is_hard, position = confidence is not None and confidence < _MAX_HARD_CONFIDENCE, points.get(place_id)
        groups = {
            f"{_classify_quality(place)} quality": True,
            "looks like another place": twin,
            "inconsistent GPS tag": place_id in tags_off_m,
            "hard to recognise": is_hard,
            "not aligned with its neighbours": position and not pose,
            "kept to bound a gap": place.salience and place.salience.is_low,
            "without a position": not position,
        }
        sd_m = float(np.sqrt(sum(pose.covariance_m2[::2]) / 2)) if pose else None
        texts = [f"quality {place.quality:.2f}: usable share of its image"]
        texts += (
            [f"position accurate to {format_number(sd_m, 'm')}; its image shows {pose.footprint_m:.3g} m of ground"]
            if pose
            else []
        )
        texts += [f"its GPS tag lies {tags_off_m[place_id]:.0f} m from its image"] if place_id in tags_off_m else []
        if confidence is not None:
            texts.append(f"mean confidence of altered copies of its image: {format_probability(confidence)}")
        pictures = [("place", place.source_image, f"place {place_id}: {place.source_image}")]
        marks = {"alike": points.get(twin.other_id) if twin else None, "weak": position if is_hard else None}
        if twin:
            image = images.get(twin.other_id, "")
            texts.append(f"looks like place {twin.other_id}: confidence {format_probability(twin.confidence)}")
            pictures.append(("place", image, f"looks alike: place {twin.other_id}: {image}"))
        yield Step(
            title=f"Place {place_id}: {place.source_image}",
            texts=texts,
            groups={name: "places" for name, is_so in groups.items() if is_so},
            points={name: point for name, point in {**marks, _classify_quality(place): position}.items() if point},
            circle_m=sd_m,
            place=place,
            pictures=[picture for picture in pictures if picture[1]],
        )


def read_recorded_position(place: Place) -> Point:
    """Return where a place was recorded before refinement moved it."""
    recorded = place.pose and place.pose.recorded
    return (recorded.lat_deg, recorded.lon_deg) if recorded else to_point(place)


def find_inconsistent_tags(ground: Sequence[Place]) -> dict[int, float]:
    """Return the places whose recorded position lies far from where their pictures lie, and how far: metres by the
    place's number. Far is more than four standard deviations of an axis, taken from the median of all."""
    moved_m = {
        place.place_id: float(distance_m(*read_recorded_position(place), *to_point(place)))
        for place in ground
        if place.pose and place.pose.recorded
    }
    far_m = max(_MIN_TAG_OFF_M, _MAX_TAG_SIGMA * float(np.median(list(moved_m.values()) or [0.0])) / _MEDIAN_PER_SIGMA)
    return {place_id: off_m for place_id, off_m in moved_m.items() if off_m > far_m}


def find_gaps(ground: Sequence[Place]) -> tuple[list[list[Point]], float, float]:
    """Find ground between pictures that none of them shows. Returns its outlines, the area that is shown and that of
    the gaps, m2; nothing if no place has a pose."""
    posed = [(place, place.pose) for place in ground if place.pose]
    if not posed:
        return [], 0.0, 0.0
    from edgevpr.frames.images import cv2

    origin = to_point(posed[0][0])
    middles = np.array([offset_m(*origin, *to_point(place)) for place, _ in posed])
    footprint_m = float(np.median([pose.footprint_m for _, pose in posed]))
    low, high = middles.min(axis=0) - 2 * footprint_m, middles.max(axis=0) + 2 * footprint_m
    cell_m = max(footprint_m / _CELLS_PER_FOOTPRINT, float(np.sqrt(np.prod(high - low) / _MAX_CELLS)))
    shown = np.zeros(np.ceil((high - low) / cell_m).astype(int)[::-1], np.uint8)
    square = np.array([[-1, 1, 1, -1], [-1, -1, 1, 1]]) * _COVERED_SHARE / 2
    for middle, (_, pose) in zip(middles, posed, strict=True):
        corners = (middle - low)[:, None] + picture_axes(pose.up_deg) @ square * pose.footprint_m
        cv2.fillConvexPoly(shown, np.rint(corners.T / cell_m).astype(np.int32), (1,))
    thin, wide = (
        cv2.getStructuringElement(cv2.MORPH_ELLIPSE, [max(1, round(share * footprint_m / cell_m))] * 2)
        for share in (_MIN_GAP_FOOTPRINTS, _MAX_GAP_FOOTPRINTS)
    )
    closed = cv2.morphologyEx(shown, cv2.MORPH_CLOSE, wide)
    around, _ = cv2.findContours(closed, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(closed, around, -1, (1,), cv2.FILLED)  # what is surrounded, however wide
    between = cv2.morphologyEx(closed & (1 - shown), cv2.MORPH_OPEN, thin)
    outlines, _ = cv2.findContours(between, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    gaps = [[offset_position(*origin, *(low + cell_m * point)) for point in outline[:, 0]] for outline in outlines]
    return gaps, float(shown.sum()) * cell_m**2, float(between.sum()) * cell_m**2
