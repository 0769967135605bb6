"""Draws the ground as seen from above: the places of the map with the ground that their pictures show, and what lies
over them."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from edgevpr.core.geodesy import axes_of, offset_m
from edgevpr.core.types import Place
from edgevpr.places.mapfile import PlaceMap
from edgevpr.review.html import Points, data_url, path
from edgevpr.review.logged import Point
from edgevpr.review.mosaic import Mosaic

Form = Literal["dots", "line", "area"]
_MARGIN = 1.08  # size of the drawing to that of what is in it
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


def read_ground(path: str | Path) -> list[Place]:
    """Read the places of the map file `path` that have a position. Raises EdgevprError for a map that cannot be
    read, or is damaged."""
    with PlaceMap.open(path) as place_map:
        return [place for place in place_map.places() if place.position]


def at_of(place: Place) -> Point:
    """Return the position (lat_deg, lon_deg) of a place that has one."""
    assert place.position is not None
    return place.position.lat_deg, place.position.lon_deg


class Overhead:
    """Converts positions into points of the drawing: metres to the right of and below `origin`, with north up. `points`
    are all positions to draw; `ground` sets the room around them. `box` is (left, top, width, height)."""

    def __init__(self, points: Sequence[Point], ground: Sequence[Place]) -> None:
        self.origin = points[0]
        drawn = np.array(self.on(points))
        footprint_m = max((place.pose.footprint_m for place in ground if place.pose), default=20.0)
        width, height = (np.ptp(drawn, axis=0) + 1.5 * footprint_m) * _MARGIN
        size = np.array([max(width, height / _MOST_SHAPE), max(height, _LEAST_SHAPE * width)])
        self.box = (*((drawn.min(axis=0) + drawn.max(axis=0) - size) / 2).tolist(), *size.tolist())

    def on(self, points: Sequence[Point]) -> Points:
        """Convert positions into points (x, y) of the drawing."""
        lat_deg, lon_deg = np.array(points, dtype=float).reshape(-1, 2).T
        east_m, north_m = offset_m(*self.origin, lat_deg, lon_deg)
        return list(zip(east_m.tolist(), (-north_m).tolist(), strict=True))

    def square(self, place: Place) -> str:
        """Return SVG path data of the ground that a picture shows, drawn as a square whose side is as long as the
        longest side of the picture on the ground; "" if that is unknown."""
        if not place.pose:
            return ""
        ((x, y),) = self.on([at_of(place)])
        east_m, north_m = axes_of(place.pose.up_deg) @ _SQUARE * place.pose.footprint_m
        return path(list(zip(x + east_m, y - north_m, strict=True)), "area")

    def draw(self, ground: Sequence[Place], layers: Sequence[Layer], mosaic: Mosaic | None) -> str:
        """Return HTML with the ground, which has the picture `mosaic` (None: it has none), and the layers over it."""
        if mosaic:
            paths = _image(mosaic)
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
        shape, box = self.box[2] / self.box[3], " ".join(f"{each:.2f}" for each in self.box)
        return (
            f'<style>{hides}</style><div class="legend">{legend}</div>'
            f'<div class="view" style="aspect-ratio:{shape:.4f};max-width:{_MOST_VH * shape:.1f}vh">'
            f'<svg role="img" aria-label="the ground of the map" viewBox="{box}">{paths}<g id="now-at"></g></svg>'
            f'<div class="ruler" hidden></div><div class="north">N ↑</div>{_BUTTONS}</div>'
        )


def _image(mosaic: Mosaic) -> str:
    west, south, east, north = mosaic.edges_m
    return (
        f'<image class="layer-ground" x="{west:.2f}" y="{-north:.2f}" width="{east - west:.2f}" '
        f'height="{north - south:.2f}" preserveAspectRatio="none" href="{data_url("webp", mosaic.webp)}"/>'
    )
