"""The ground as seen from above: the places of the map with what their pictures show, and the flight over them."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from html import escape
from itertools import chain, groupby
from pathlib import Path

import numpy as np

from edgevpr.core.errors import EdgevprError
from edgevpr.core.geodesy import axes_of, offset_m
from edgevpr.core.types import Pose
from edgevpr.places.mapfile import PlaceMap
from edgevpr.review.flight import Flight, Outcome
from edgevpr.review.svg import Points, dots, way
from edgevpr.review.values import Point

_WIDE = 1000.0  # of the drawing, in its own units
_MARGIN = 0.04
_SHAPES = 0.55, 1.8  # the least and the most height that a drawing has for its width
_MOST_VH = 80  # of the height of the window
_MOST_PLACES = 6000  # more are a whole page of dots; then every second, third, ... is drawn
_ROUND = (1, 2, 5)
_FIXES = (
    (Outcome.TAKEN, "fixes taken", "taken"),
    (Outcome.UNANSWERED, "fixes not answered", "unanswered"),
    (Outcome.REFUSED, "fixes refused", "refused"),
)


@dataclass(frozen=True, slots=True)
class Ground:
    """Ground of a map: its positions and how their pictures lie there (None: unknown), and `places` in all, also those
    without position. `trouble` says in a sentence why there is no more of it."""

    at: Sequence[tuple[Point, Pose | None]] = ()
    places: int = 0
    trouble: str | None = None


@dataclass(frozen=True, slots=True)
class Layer:
    """Part of the drawing that a person may hide: its name, the class that colours it, and the points or, as lines, the
    ways."""

    name: str
    colour: str
    points: Sequence[Point] = ()
    ways: Sequence[Sequence[Point]] = ()

    @property
    def everything(self) -> Sequence[Point]:
        """All its points."""
        return [*self.points, *chain.from_iterable(self.ways)]


def read_ground(path: str | Path) -> Ground:
    """Read the places of a map; what cannot be read of it is left out. Raises MapError where that is all."""
    with PlaceMap.open(path) as place_map:
        places = 0
        at = []
        trouble = None
        try:
            for place in place_map.places():
                places += 1
                if place.position:
                    at.append(((place.position.lat_deg, place.position.lon_deg), place.pose))
        except EdgevprError as error:
            trouble = f"Only {places} places of the map are drawn. {error}"
    return Ground(at, places, trouble)


def layers_of(flight: Flight) -> list[Layer]:
    """Return what there is to draw of a flight, from the bottom to the top."""
    queries = flight.queries
    fixed = [each.fix for each in queries if each.fix and each.fix.at]
    found = [
        Layer("places found", "found", list(dict.fromkeys(each.place_at for each in queries if each.place_at))),
        Layer("places learnt", "learnt", flight.learnt),
        Layer("GPS", "gps", ways=_ways(each.gps_at for each in queries)),
        Layer("autopilot", "autopilot", ways=_ways(each.autopilot_at for each in queries)),
        Layer("matches", "accepted", [each.at for each in queries if each.at]),
    ]
    for outcome, name, colour in _FIXES:
        found.append(Layer(name, colour, [each.at for each in fixed if each.outcome is outcome]))
    return [each for each in found if each.everything]


def _ways(points: Iterable[Point | None]) -> list[list[Point]]:
    """Return the lines through points, each up to one that is not known."""
    return [list(several) for are_known, several in groupby(points, bool) if are_known]


def draw(ground: Ground, layers: Sequence[Layer], named: Iterable[tuple[str, Point]] = ()) -> str:
    """Draw the ground with the layers over it, and labels at the `named` points; "" where nothing has a position."""
    everything = [at for at, _ in ground.at] + [at for layer in layers for at in layer.everything]
    if not everything:
        return ""
    view = _View(everything, max((pose.footprint_m for _, pose in ground.at if pose), default=20.0))
    thin = -(-len(ground.at) // _MOST_PLACES)
    shown = ground.at[::thin] if thin else ()
    squares = "".join(view.square(at, pose) for at, pose in shown if pose)
    parts = [
        f'<path class="footprints" d="{squares}"/>' if squares else "",
        f'<path class="dots place layer-places" d="{dots(view.on([at for at, _ in shown]))}"/>' if shown else "",
    ]
    for layer in layers:
        path = dots(view.on(layer.points)) + "".join(way(view.on(each)) for each in layer.ways)
        kind = "line" if layer.ways else "dots"
        parts.append(f'<path class="{kind} {layer.colour} layer-{layer.colour}" d="{path}"/>')
    labels = "".join(
        f'<a class="label" href="#moment-{escape(name)}" style="left:{x / _WIDE:.2%};top:{y / view.high:.2%}">'
        f"{escape(name)}</a>"
        for name, at in named
        for x, y in view.on([at])
    )
    keys = [Layer("places of the map", "places"), *layers] if shown else layers
    boxes = "".join(
        f'<label class="key {each.colour}"><input type="checkbox" checked id="show-{each.colour}">'
        f"{escape(each.name)}</label>"
        for each in keys
    )
    shape = _WIDE / view.high  # labels lie right only while the view has exactly this
    length_m, share = view.ruler()
    ruler = f"{length_m:g} m" if length_m < 1000 else f"{length_m / 1000:.0f} km"
    return (
        f'<div class="ground"><div class="legend">{boxes}</div>'
        f'<div class="view" style="aspect-ratio:{shape:.4f};max-width:{_MOST_VH * shape:.1f}vh">'
        f'<svg role="img" aria-label="the flight over the ground of the map" viewBox="0 0 {_WIDE:g} {view.high:.0f}">'
        f'{"".join(parts)}</svg>{labels}<div class="ruler" style="width:{share:.1%}">{ruler}</div>'
        '<div class="north">N ↑</div></div></div>'
    )


class _View:
    """The window on the ground, north up: turns positions into points of the drawing, `high` units high."""

    def __init__(self, everything: Sequence[Point], footprint_m: float) -> None:
        self._origin = everything[0]
        east_m, north_m = self._metres(everything)
        around_m = footprint_m * 0.75
        wide_m, high_m = np.ptp(east_m) + 2 * around_m, np.ptp(north_m) + 2 * around_m
        least, most = _SHAPES
        high_m, wide_m = max(high_m, least * wide_m), max(wide_m, high_m / most)
        self._scale = _WIDE * (1 - 2 * _MARGIN) / wide_m
        self.high = _WIDE * high_m / wide_m
        self._middle_m = (np.min(east_m) + np.max(east_m)) / 2, (np.min(north_m) + np.max(north_m)) / 2

    def on(self, points: Sequence[Point]) -> Points:
        """Return points of the drawing."""
        east_m, north_m = self._metres(points)
        return list(zip(*self._drawn(east_m, north_m), strict=True))

    def square(self, at: Point, pose: Pose) -> str:
        """Return the path of the ground that a picture shows, as a square of its longest side."""
        east_m, north_m = self._metres([at])
        corners = axes_of(pose.up_deg) @ np.array([[-1, 1, 1, -1], [-1, -1, 1, 1]]) * pose.footprint_m / 2
        x, y = self._drawn(east_m + corners[0], north_m + corners[1])
        return "M" + "L".join(f"{a:.0f} {b:.0f}" for a, b in zip(x, y, strict=True)) + "z"

    def ruler(self) -> tuple[float, float]:
        """Return a round length, metres, of about a fifth of the width, and its share of it."""
        wide_m = _WIDE / self._scale
        power = 10.0 ** math.floor(math.log10(wide_m / 4))
        length_m = max(each * power for each in _ROUND if each * power <= wide_m / 4)
        return length_m, length_m / wide_m

    def _metres(self, points: Sequence[Point]) -> tuple[np.ndarray, np.ndarray]:
        lat_deg, lon_deg = np.array(points, dtype=float).reshape(-1, 2).T
        return offset_m(*self._origin, lat_deg, lon_deg)

    def _drawn(self, east_m: np.ndarray, north_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        middle_e, middle_n = self._middle_m
        return _WIDE / 2 + (east_m - middle_e) * self._scale, self.high / 2 - (north_m - middle_n) * self._scale
