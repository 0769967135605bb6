"""The page of a map (`edgevpr map info --page`): its places by quality over the ground they show, the gaps between
them, inconsistent GPS tags, and places that look alike."""

from collections.abc import Iterable, Mapping, Sequence
from itertools import compress

import numpy as np

from edgevpr.core.geodesy import distance_m, offset_m, offset_position, picture_axes
from edgevpr.core.text import format_probability
from edgevpr.core.types import Place
from edgevpr.frames.images import cv2
from edgevpr.frames.level import Lens
from edgevpr.mapmaking.look_alikes import FoundLookAlike
from edgevpr.places.mapinfo import find_inconsistent_tags
from edgevpr.review.album import Album
from edgevpr.review.logged import Point
from edgevpr.review.webpage import UNKNOWN, Layer, Section, Step, format_number, make_layer, make_page, to_point

MAX_QUERIES = 100  # images of a map that are matched against the other places; each takes half a second
_QUALITY_CLASSES = {"low": 0.4, "fair": 0.6, "good": 0.8, "best": 1.01}  # upper limits of the classes
_MAX_HARD_CONFIDENCE = 0.5  # maximum mean confidence of a place that is hard to recognise
_CELLS_PER_FOOTPRINT = 24  # resolution of the coverage grid
_MAX_CELLS = 4_000_000  # of the coverage grid
_COVERED_FOOTPRINTS = 0.75  # the short side of a 4:3 picture
_MIN_GAP_FOOTPRINTS = 0.15  # narrower gaps are ignored
_MAX_GAP_FOOTPRINTS = 1.0  # wider gaps that are open to one side are outside the map
_NOTES = (
    "Coverage gaps are between pictures that do not touch: each picture is assumed to show at least a square of three "
    "quarters of its long side.",
    "A GPS tag is inconsistent if it is more than four standard deviations (of this map) from its picture, and at "
    "least 5 m.",
)
_NO_PICTURES = (
    "Look-alikes are only searched for with --map-images, in a `cohog` map whose places were built from these images "
    "with the lens given by --config."
)


def make_map_page(
    name: str,
    lines: Sequence[str],
    places: Sequence[Place],
    mean_confidences: Mapping[int, float],
    look_alikes: Sequence[FoundLookAlike | None],
    pictures: Album,
    lens: Lens | None,
) -> str:
    """Return the complete page for the map `name`. `lines`: the output of `map info`. `mean_confidences`: of the
    correct matches of each place that calibration queried, by place number. `look_alikes`: for each place searched, the
    one that looks alike (None: none). `pictures`: the map's album. `lens`: lens of its camera (None: unknown)."""
    ground = [place for place in places if place.position]
    points = {place.place_id: to_point(place.position) for place in ground}
    tags_off_m, twins = measure_inconsistent_tags(ground), {twin.place_id: twin for twin in look_alikes if twin}
    hard = {place_id for place_id, confidence in mean_confidences.items() if confidence < _MAX_HARD_CONFIDENCE}
    gaps, covered_m2, gaps_m2 = find_gaps(ground)
    steps = list(_make_steps(places, mean_confidences, tags_off_m, twins, points))
    pairs = [(points.get(twin.place_id), points.get(twin.other_id)) for twin in twins.values()]
    tagged = [place for place in ground if place.place_id in tags_off_m]
    tags = [(to_point(place.recorded_position), points[place.place_id]) for place in tagged]
    layers = [
        Layer("coverage gaps", "gap", gaps, "area"),
        Layer("look alike", "alike", [(point, other) for point, other in pairs if point and other], "line"),
        Layer("inconsistent GPS tags", "tag", tags, "line"),
        make_layer(steps, "hard to recognise", "hard"),
        *(make_layer(steps, f"{quality} quality", quality) for quality in _QUALITY_CLASSES),
    ]
    figures = {
        "places": str(len(places)),
        "ground covered": format_number(covered_m2 / 1e4 if covered_m2 else None, "ha"),
        "coverage gaps": format_number(gaps_m2 / 1e4 if covered_m2 else None, "ha"),
        "inconsistent GPS tags": str(len(tags_off_m)),
        "hard to recognise": str(len(hard)) if mean_confidences else UNKNOWN,
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
    mean_confidences: Mapping[int, float],
    tags_off_m: Mapping[int, float],
    twins: Mapping[int, FoundLookAlike],
    points: Mapping[int, Point],
) -> Iterable[Step]:
    images = {place.place_id: place.source_image for place in places}
    for place in places:
        place_id, pose = place.place_id, place.pose
        confidence, twin = mean_confidences.get(place_id), twins.get(place_id)
        is_hard, position = confidence is not None and confidence < _MAX_HARD_CONFIDENCE, points.get(place_id)
        groups = {
            f"{_classify_quality(place)} quality": True,
            "looks like another place": twin,
            "inconsistent GPS tag": place_id in tags_off_m,
            "hard to recognise": is_hard,
            "not aligned with its neighbours": position and not pose,
            "kept to limit a gap": place.salience and place.salience.is_low,
            "without a position": not position,
        }
        sd_m = float(np.sqrt(sum(pose.covariance_m2[::2]) / 2)) if pose else None
        texts = [f"quality {place.quality:.2f}: usable fraction of its image"]
        if pose:
            accuracy = f"position accurate to {format_number(sd_m, 'm')}"
            texts.append(f"{accuracy}; its image shows {pose.footprint_m:.3g} m of ground")
        if place_id in tags_off_m:
            texts.append(f"its GPS tag is {tags_off_m[place_id]:.0f} m from its image")
        if confidence is not None:
            texts.append(f"mean confidence of altered copies of its image: {format_probability(confidence)}")
        pictures = [("place", place.source_image, f"place {place_id}: {place.source_image}")]
        marks = {"alike": points.get(twin.other_id) if twin else None, "hard": position if is_hard else None}
        if twin:
            image = images.get(twin.other_id, "")
            texts.append(f"looks like place {twin.other_id}: confidence {format_probability(twin.confidence)}")
            pictures.append(("place", image, f"looks alike: place {twin.other_id}: {image}"))
        yield Step(
            title=f"Place {place_id}: {place.source_image}",
            texts=texts,
            groups={name: "places" for name, is_member in groups.items() if is_member},
            points={name: point for name, point in {**marks, _classify_quality(place): position}.items() if point},
            circle_m=sd_m,
            place=place,
            pictures=[picture for picture in pictures if picture[1]],
        )


def measure_inconsistent_tags(places: Sequence[Place]) -> dict[int, float]:
    """Return the distance in metres, by place number, from the recorded position of a place to its refined one, for the
    places with an inconsistent tag (see `find_inconsistent_tags`)."""
    moved_m = {
        place.place_id: float(distance_m(*to_point(place.recorded_position), *to_point(place.position)))
        for place in places
        if place.pose and place.pose.recorded
    }
    inconsistent = find_inconsistent_tags(np.array(list(moved_m.values())))
    return {place_id: moved_m[place_id] for place_id in compress(moved_m, inconsistent)}


def find_gaps(places: Sequence[Place]) -> tuple[list[list[Point]], float, float]:
    """Find the gaps between pictures: ground that none of them shows. Return their outlines, the area shown and the
    area of the gaps, in m2; no outlines and zeros if no place has a pose."""
    posed = [(place, place.pose) for place in places if place.pose]
    if not posed:
        return [], 0.0, 0.0
    origin = to_point(posed[0][0].position)
    centres_m = np.array([offset_m(*origin, *to_point(place.position)) for place, _ in posed])
    footprint_m = float(np.median([pose.footprint_m for _, pose in posed]))
    low, high = centres_m.min(axis=0) - 2 * footprint_m, centres_m.max(axis=0) + 2 * footprint_m
    cell_m = max(footprint_m / _CELLS_PER_FOOTPRINT, float(np.sqrt(np.prod(high - low) / _MAX_CELLS)))
    covered = np.zeros(np.ceil((high - low) / cell_m).astype(int)[::-1], np.uint8)
    square = np.array([[-1, 1, 1, -1], [-1, -1, 1, 1]]) * _COVERED_FOOTPRINTS / 2
    for centre_m, (_, pose) in zip(centres_m, posed, strict=True):
        corners = (centre_m - low)[:, None] + picture_axes(pose.up_deg) @ square * pose.footprint_m
        cv2.fillConvexPoly(covered, np.rint(corners.T / cell_m).astype(np.int32), (1,))
    opening_kernel, closing_kernel = (
        cv2.getStructuringElement(cv2.MORPH_ELLIPSE, [max(1, round(footprints * footprint_m / cell_m))] * 2)
        for footprints in (_MIN_GAP_FOOTPRINTS, _MAX_GAP_FOOTPRINTS)
    )
    closed = cv2.morphologyEx(covered, cv2.MORPH_CLOSE, closing_kernel)
    contours, _ = cv2.findContours(closed, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(closed, contours, -1, (1,), cv2.FILLED)  # enclosed gaps of any width count
    uncovered = cv2.morphologyEx(closed & (1 - covered), cv2.MORPH_OPEN, opening_kernel)
    outlines, _ = cv2.findContours(uncovered, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    gaps = [[offset_position(*origin, *(low + cell_m * point)) for point in outline[:, 0]] for outline in outlines]
    return gaps, float(covered.sum()) * cell_m**2, float(uncovered.sum()) * cell_m**2
