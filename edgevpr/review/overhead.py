"""Draws the ground as seen from above: the places of the map with the ground that their pictures show, and what lies
over them."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from edgevpr.core.arrays import Doubles
from edgevpr.core.geodesy import axes_of, offset_m
from edgevpr.core.types import Place
from edgevpr.places.mapfile import PlaceMap
from edgevpr.places.tilemap import TileMap
from edgevpr.review.html import WIDTH, Points, data_url, path
from edgevpr.review.logged import Point
from edgevpr.review.mosaic import Mosaic

Form = Literal["dots", "line", "area"]
_MARGIN = 0.04
_LEAST_SHAPE = 0.55  # height of a drawing to its width
_MOST_SHAPE = 1.8
_MOST_VH = 80  # of the height of the window
_MOST_PLACES = 6000  # more are a whole page of dots; then every second, third, ... is drawn
_SQUARE = np.array([[-0.5, 0.5, 0.5, -0.5], [-0.5, -0.5, 0.5, 0.5]])
_BUTTONS = (
    '<div class="zoom" hidden><button type="button" data-zoom="2" aria-label="zoom in">+</button>'
    '<button type="button" data-zoom="0.5" aria-label="zoom out">−</button>'
    '<button type="button" data-zoom="0" aria-label="show all">⤢</button></div>'
)


@dataclass(frozen=True, slots=True)
class Layer:
    """Layer of the drawing, which the reader can hide: its name, the CSS class that colours it, and its `ways`, each a
    sequence of positions, drawn in a `form`: dots, a line, or an area."""

    name: str
    colour: str
    ways: Sequence[Sequence[Point]]
    form: Form = "dots"


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


class Overhead:
    """Converts positions into points of the drawing, which has north up and is 1000 x `height` units large. `points`
    are all positions to draw; `ground` sets the room around them. `per_m`: units of the drawing in a metre."""

    def __init__(self, points: Sequence[Point], ground: Sequence[Place]) -> None:
        footprint_m = max((place.pose.footprint_m for place in ground if place.pose), default=20.0)
        self.origin = points[0]
        metres = self._metres(points)
        width_m, height_m = np.ptp(metres, axis=1) + 1.5 * footprint_m
        height_m, width_m = max(height_m, _LEAST_SHAPE * width_m), max(width_m, height_m / _MOST_SHAPE)
        self.per_m = float(WIDTH * (1 - 2 * _MARGIN) / width_m)
        self.height = float(WIDTH * height_m / width_m)
        self._middle_m = (metres.min(axis=1, keepdims=True) + metres.max(axis=1, keepdims=True)) / 2

    def on(self, points: Sequence[Point]) -> Points:
        """Convert positions into points (x, y) of the drawing."""
        return self._drawn(self._metres(points))

    def square(self, place: Place) -> str:
        """Return SVG path data of the ground that a picture shows, drawn as a square whose side is as long as the
        longest side of the picture on the ground; "" if that is unknown."""
        if not place.pose:
            return ""
        corners = axes_of(place.pose.up_deg) @ _SQUARE * place.pose.footprint_m
        return path(self._drawn(self._metres([at_of(place)]) + corners), "area")

    def draw(self, ground: Sequence[Place], layers: Sequence[Layer], mosaic: Mosaic | None) -> str:
        """Return HTML with the ground, which has the picture `mosaic` (None: it has none), and the layers over it."""
        if mosaic:
            paths = self._picture(mosaic)
        else:
            squares = map(self.square, ground[:: -(-len(ground) // _MOST_PLACES) or 1])
            paths = f'<path class="footprints layer-ground" d="{"".join(squares)}"/>'
        names = {"ground": "the ground seen"} if any(place.pose for place in ground) else {}
        for layer in layers:
            drawn = "".join(path(self.on(points), layer.form) for points in layer.ways if points)
            paths += f'<path class="{layer.form} {layer.colour} layer-{layer.colour}" d="{drawn}"/>'
            names[layer.colour] = layer.name
        legend = "".join(
            f'<label class="key {colour}"><input type="checkbox" checked id="show-{colour}">{name}</label>'
            for colour, name in names.items()
        )
        hides = "".join(f".ground:has(#show-{key}:not(:checked)) .layer-{key}{{display:none}}" for key in names)
        shape = WIDTH / self.height
        return (
            f'<style>{hides}</style><div class="legend">{legend}</div>'
            f'<div class="view" style="aspect-ratio:{shape:.4f};max-width:{_MOST_VH * shape:.1f}vh">'
            f'<svg role="img" aria-label="the ground of the map" viewBox="0 0 {WIDTH:g} {self.height:.0f}">{paths}'
            f'<g id="now-at"></g></svg><div class="ruler" hidden></div><div class="north">N ↑</div>{_BUTTONS}</div>'
        )

    def _picture(self, mosaic: Mosaic) -> str:
        west, south, east, north = mosaic.edges_m
        (left, top), (right, bottom) = self._drawn(np.array([[west, east], [north, south]]))
        return (
            f'<image class="layer-ground" x="{left:.2f}" y="{top:.2f}" width="{right - left:.2f}" '
            f'height="{bottom - top:.2f}" preserveAspectRatio="none" href="{data_url("webp", mosaic.webp)}"/>'
        )

    def _metres(self, points: Sequence[Point]) -> Doubles:
        """Return float (2, N): how far east and north of the origin the points lie."""
        lat_deg, lon_deg = np.array(points, dtype=float).reshape(-1, 2).T
        return np.array(offset_m(*self.origin, lat_deg, lon_deg))

    def _drawn(self, metres: Doubles) -> Points:
        east, north = (metres - self._middle_m) * self.per_m
        return list(zip((WIDTH / 2 + east).tolist(), (self.height / 2 - north).tolist(), strict=True))
