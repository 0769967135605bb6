"""Draws the ground as seen from above, for the report: the places of the map with the ground that their pictures show,
and the flight over them."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from html import escape
from itertools import groupby
from pathlib import Path

import numpy as np

from edgevpr.core.geodesy import axes_of, offset_m
from edgevpr.core.types import Pose
from edgevpr.places.mapfile import PlaceMap
from edgevpr.review.html import Points, dots, way
from edgevpr.review.logged import FixOutcome, LoggedFlight, Point

Ground = Sequence[tuple[Point, Pose | None]]  # the places of a map: position; pose of the picture (None: unknown)

_WIDE = 1000.0  # of the drawing, in its own units
_MARGIN = 0.04
_SHAPES = 0.55, 1.8  # the least and the greatest ratio of a drawing's height to its width
_MOST_VH = 80  # of the height of the window
_MOST_PLACES = 6000  # more are a whole page of dots; then every second, third, ... is drawn
_FIXES = (
    (FixOutcome.TAKEN, "fixes taken", "taken"),
    (FixOutcome.UNANSWERED, "fixes not answered", "unanswered"),
    (FixOutcome.REFUSED, "fixes refused", "refused"),
)


@dataclass(frozen=True, slots=True)
class Layer:
    """Layer of the drawing, which the reader can hide: its name, the CSS class that colours it, and its `ways`, each a
    sequence of positions. With `are_dots` the positions are drawn as dots, else each way is drawn as a line."""

    name: str
    colour: str
    ways: Sequence[Sequence[Point]]
    are_dots: bool = True


def read_ground(path: str | Path) -> Ground:
    """Read the places of the map file `path` that have a position, some thousands at most. Raises EdgevprError for a
    map that cannot be read, or is damaged."""
    with PlaceMap.open(path) as place_map:
        found = [(place.position, place.pose) for place in place_map.places() if place.position]
    step = -(-len(found) // _MOST_PLACES) or 1
    return [((at.lat_deg, at.lon_deg), pose) for at, pose in found[::step]]


def layers_of(ground: Ground, flight: LoggedFlight) -> list[Layer]:
    """Return the layers of the drawing, from the bottom to the top. Those without points are left out."""
    queries = flight.queries
    layers = [
        Layer("places of the map", "places", [[at for at, _ in ground]]),
        Layer("places found", "found", [list(dict.fromkeys(query.place_at for query in queries if query.place_at))]),
        Layer("places learnt", "learnt", [flight.learnt]),
        Layer("GPS", "gps", _known_ways(query.gps_at for query in queries), are_dots=False),
        Layer("autopilot", "autopilot", _known_ways(query.autopilot_at for query in queries), are_dots=False),
        Layer("matches", "accepted", [[query.at for query in queries if query.at]]),
    ]
    for outcome, name, colour in _FIXES:
        fixes = (query.fix for query in queries if query.fix and query.fix.outcome is outcome)
        layers.append(Layer(name, colour, [[fix.at for fix in fixes if fix.at]]))
    return [layer for layer in layers if any(layer.ways)]


def _known_ways(points: Iterable[Point | None]) -> list[list[Point]]:
    """Return the runs of successive known points: None, an unknown point, ends a run."""
    return [[point for point in several if point] for are_known, several in groupby(points, bool) if are_known]


def draw(ground: Ground, layers: Sequence[Layer], named: Iterable[tuple[str, Point]]) -> str:
    """Return HTML with the ground that is seen, the layers over it, and a label at each of the `named` points (its
    name, position); "" if nothing has a position."""
    everything = [at for layer in layers for way in layer.ways for at in way]
    if not everything:
        return ""
    view = _View(everything, max((pose.footprint_m for _, pose in ground if pose), default=20.0))
    squares = "".join(view.square(at, pose) for at, pose in ground if pose)
    paths = f'<path class="footprints" d="{squares}"/>'
    for layer in layers:
        kind, path = ("dots", dots) if layer.are_dots else ("line", way)
        drawn = "".join(path(view.on(points)) for points in layer.ways)
        paths += f'<path class="{kind} {layer.colour} layer-{layer.colour}" d="{drawn}"/>'
    labels = "".join(
        f'<a class="label" href="#moment-{escape(name)}" style="left:{x / _WIDE:.2%};top:{y / view.high:.2%}">'
        f"{escape(name)}</a>"
        for name, at in named
        for x, y in view.on([at])
    )
    boxes = "".join(
        f'<label class="key {each.colour}"><input type="checkbox" checked id="show-{each.colour}">{each.name}</label>'
        for each in layers
    )
    shape = _WIDE / view.high  # labels are placed in per cent of width and height: they fit this shape only
    length_m, share = view.ruler()
    ruler = f"{length_m:g} m" if length_m < 1000 else f"{length_m / 1000:.0f} km"
    return (
        f'<div class="ground"><div class="legend">{boxes}</div>'
        f'<div class="view" style="aspect-ratio:{shape:.4f};max-width:{_MOST_VH * shape:.1f}vh">'
        f'<svg role="img" aria-label="the flight over the ground of the map" viewBox="0 0 {_WIDE:g} {view.high:.0f}">'
        f'{paths}</svg>{labels}<div class="ruler" style="width:{share:.1%}">{ruler}</div>'
        '<div class="north">N ↑</div></div></div>'
    )


class _View:
    """Converts positions into points of the drawing, which has north up and is `_WIDE` x `high` units large.
    `everything` are all positions to draw; `footprint_m`, the ground length of a picture, sets the room around them."""

    def __init__(self, everything: Sequence[Point], footprint_m: float) -> None:
        self._origin = everything[0]
        metres = self._metres(everything)
        wide_m, high_m = np.ptp(metres, axis=1) + 1.5 * footprint_m
        least, most = _SHAPES
        high_m, wide_m = max(high_m, least * wide_m), max(wide_m, high_m / most)
        self._scale = _WIDE * (1 - 2 * _MARGIN) / wide_m
        self.high = _WIDE * high_m / wide_m
        self._middle_m = (metres.min(axis=1, keepdims=True) + metres.max(axis=1, keepdims=True)) / 2

    def on(self, points: Sequence[Point]) -> Points:
        """Convert positions into points (x, y) of the drawing."""
        return self._drawn(self._metres(points))

    def square(self, at: Point, pose: Pose) -> str:
        """Return SVG path data of the ground that a picture shows, drawn as a square whose side is as long as the
        longest side of the picture on the ground."""
        corners = axes_of(pose.up_deg) @ np.array([[-1, 1, 1, -1], [-1, -1, 1, 1]]) * pose.footprint_m / 2
        return "M" + "L".join(f"{x:.0f} {y:.0f}" for x, y in self._drawn(self._metres([at]) + corners)) + "z"

    def ruler(self) -> tuple[float, float]:
        """Choose the length of the drawing's scale bar. Returns two values: a round length in metres, at most a quarter
        of the drawing's width; and its share of that width, 0..1."""
        wide_m = _WIDE / self._scale
        power = 10.0 ** math.floor(math.log10(wide_m / 4))
        length_m = max(each * power for each in (1, 2, 5) if each * power <= wide_m / 4)
        return length_m, length_m / wide_m

    def _metres(self, points: Sequence[Point]) -> np.ndarray:
        """Return float (2, N): how far east and north of the origin the points lie."""
        lat_deg, lon_deg = np.array(points, dtype=float).reshape(-1, 2).T
        return np.array(offset_m(*self._origin, lat_deg, lon_deg))

    def _drawn(self, metres: np.ndarray) -> Points:
        east, north = (metres - self._middle_m) * self._scale
        return list(zip(_WIDE / 2 + east, self.high / 2 - north, strict=True))
