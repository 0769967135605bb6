"""Draws the ground as seen from above: the places of the map with the ground that their pictures show, and what lies
over them."""

import base64
import math
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Literal

import numpy as np

from edgevpr.core.arrays import Doubles
from edgevpr.core.geodesy import axes_of, offset_m
from edgevpr.core.types import Place
from edgevpr.places.mapfile import PlaceMap
from edgevpr.places.tilemap import TileMap
from edgevpr.review.html import Points, dots, way
from edgevpr.review.logged import Point
from edgevpr.review.mosaic import Mosaic

_WIDE = 1000.0  # of the drawing, in its own units
_MARGIN = 0.04
_SHAPES = 0.55, 1.8  # the least and the greatest ratio of a drawing's height to its width
_MOST_VH = 80  # of the height of the window
_MOST_PLACES = 6000  # more are a whole page of dots; then every second, third, ... is drawn


@dataclass(frozen=True, slots=True)
class Layer:
    """Layer of the drawing, which the reader can hide: its name, the CSS class that colours it, and its `ways`, each a
    sequence of positions, drawn in a `form`: dots, a line, or an area."""

    name: str
    colour: str
    ways: Sequence[Sequence[Point]]
    form: Literal["dots", "line", "area"] = "dots"


def read_ground(path: str | Path, tiles: Collection[str] = ()) -> list[Place]:
    """Read the places of the map file `path` that have a position; of a folder of maps, those of `tiles`, by their quad
    keys. Raises EdgevprError for a map that cannot be read, or is damaged."""
    if Path(path).is_dir():
        return [place for place in TileMap.open(path).places_in(tiles) if place.position]
    with PlaceMap.open(path) as place_map:
        return [place for place in place_map.places() if place.position]


def at_of(place: Place) -> Point:
    """Return the position (lat_deg, lon_deg) of a place that has one."""
    assert place.position is not None
    return place.position.lat_deg, place.position.lon_deg


def draw(
    view: "Overhead", ground: Sequence[Place], layers: Sequence[Layer], named: Iterable[tuple[str, Point]] = ()
) -> str:
    """Return HTML with the ground that is seen, the layers over it, and a label at each of the `named` points (its
    name, position)."""
    drawn_of = ground[:: -(-len(ground) // _MOST_PLACES) or 1]
    paths = view.picture() or f'<path class="footprints layer-ground" d="{"".join(map(view.square, drawn_of))}"/>'
    boxes = [("ground", "the ground seen")] if any(place.pose for place in ground) else []
    for layer in layers:
        path = dots if layer.form == "dots" else way
        end = "z" if layer.form == "area" else ""
        drawn = "".join(path(view.on(points)) + end for points in layer.ways if points)
        paths += f'<path class="{layer.form} {layer.colour} layer-{layer.colour}" d="{drawn}"/>'
        boxes.append((layer.colour, layer.name))
    labels = "".join(
        f'<a class="label" href="#moment-{escape(name)}" data-x="{x:.1f}" data-y="{y:.1f}" '
        f'style="left:{x / _WIDE:.2%};top:{y / view.high:.2%}">{escape(name)}</a>'
        for name, at in named
        for x, y in view.on([at])
    )
    legend = "".join(
        f'<label class="key {each}"><input type="checkbox" checked id="show-{each}">{name}</label>'
        for each, name in boxes
    )
    hides = "".join(f".ground:has(#show-{each}:not(:checked)) .layer-{each}{{display:none}}" for each, _ in boxes)
    shape = _WIDE / view.high  # labels are placed in per cent of width and height: they fit this shape only
    length_m, share = view.ruler()
    ruler = f"{length_m:g} m" if length_m < 1000 else f"{length_m / 1000:.0f} km"
    return (
        f'<style>{hides}</style><div class="legend">{legend}</div>'
        f'<div class="view" style="aspect-ratio:{shape:.4f};max-width:{_MOST_VH * shape:.1f}vh">'
        f'<svg role="img" aria-label="the ground of the map" viewBox="0 0 {_WIDE:g} {view.high:.0f}">{paths}'
        f'<g id="now-at"></g></svg>{labels}<div class="ruler" style="width:{share:.1%}">{ruler}</div>'
        '<div class="north">N ↑</div>'
        '<div class="zoom" hidden><button type="button" data-zoom="2" aria-label="zoom in">+</button>'
        '<button type="button" data-zoom="0.5" aria-label="zoom out">−</button>'
        '<button type="button" data-zoom="0" aria-label="show all">⤢</button></div></div>'
    )


class Overhead:
    """Converts positions into points of the drawing, which has north up and is 1000 x `high` units large. `everything`
    are all positions to draw; `ground` sets the room around them. `mosaic` is the picture of the ground, once there is
    one, in metres from the position `origin`. `per_m`: units of the drawing in a metre."""

    def __init__(self, everything: Sequence[Point], ground: Sequence[Place]) -> None:
        footprint_m = max((place.pose.footprint_m for place in ground if place.pose), default=20.0)
        self.origin = everything[0]
        self.mosaic: Mosaic | None = None
        metres = self._metres(everything)
        wide_m, high_m = np.ptp(metres, axis=1) + 1.5 * footprint_m
        least, most = _SHAPES
        high_m, wide_m = max(high_m, least * wide_m), max(wide_m, high_m / most)
        self.per_m = float(_WIDE * (1 - 2 * _MARGIN) / wide_m)
        self.high = float(_WIDE * high_m / wide_m)
        self._middle_m = (metres.min(axis=1, keepdims=True) + metres.max(axis=1, keepdims=True)) / 2

    def on(self, points: Sequence[Point]) -> Points:
        """Convert positions into points (x, y) of the drawing."""
        return self._drawn(self._metres(points))

    def square(self, place: Place) -> str:
        """Return SVG path data of the ground that a picture shows, drawn as a square whose side is as long as the
        longest side of the picture on the ground; "" if that is unknown."""
        if not place.pose:
            return ""
        half_m = place.pose.footprint_m / 2
        corners = axes_of(place.pose.up_deg) @ np.array([[-1, 1, 1, -1], [-1, -1, 1, 1]]) * half_m
        points = self._drawn(self._metres([at_of(place)]) + corners)
        return "M" + "L".join(f"{x:.0f} {y:.0f}" for x, y in points) + "z"

    def picture(self) -> str:
        """Return the SVG image of the ground; "" without one."""
        if self.mosaic is None:
            return ""
        west, south, east, north = self.mosaic.edges_m
        (left, top), (right, bottom) = self._drawn(np.array([[west, east], [north, south]]))
        data = base64.b64encode(self.mosaic.webp).decode()
        return (
            f'<image class="layer-ground" x="{left:.2f}" y="{top:.2f}" width="{right - left:.2f}" '
            f'height="{bottom - top:.2f}" preserveAspectRatio="none" href="data:image/webp;base64,{data}"/>'
        )

    def ruler(self) -> tuple[float, float]:
        """Choose the length of the drawing's scale bar. Returns two values: a round length in metres, at most a quarter
        of the drawing's width; and its share of that width, 0..1."""
        wide_m = _WIDE / self.per_m
        power = 10.0 ** math.floor(math.log10(wide_m / 4))
        length_m = max(each * power for each in (1, 2, 5) if each * power <= wide_m / 4)
        return length_m, length_m / wide_m

    def _metres(self, points: Sequence[Point]) -> Doubles:
        """Return float (2, N): how far east and north of the origin the points lie."""
        lat_deg, lon_deg = np.array(points, dtype=float).reshape(-1, 2).T
        return np.array(offset_m(*self.origin, lat_deg, lon_deg))

    def _drawn(self, metres: Doubles) -> Points:
        east, north = (metres - self._middle_m) * self.per_m
        return list(zip((_WIDE / 2 + east).tolist(), (self.high / 2 - north).tolist(), strict=True))
