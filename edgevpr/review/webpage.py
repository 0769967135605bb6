"""Makes the page of a flight or a map: one HTML file that needs no network. Python supplies the content as data;
`page.js` draws it and makes it interactive. All texts reach the page as text, never as HTML."""

import base64
import hashlib
import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import groupby
from pathlib import Path
from typing import Any, Literal

import numpy as np

from edgevpr.core.geodesy import offset_m
from edgevpr.core.text import sanitize
from edgevpr.core.types import Place, Position
from edgevpr.frames.level import Lens
from edgevpr.places.mapfile import PlaceMap
from edgevpr.review.album import Album, AlbumPicture, embed_pictures
from edgevpr.review.logged import Point

Form = Literal["dots", "line", "area"]
# The name in the legend, the colour, the form ("dots" are not joined) and the points (t_s, value) of values in a chart.
Series = tuple[str, str, Form, Sequence[tuple[float, float]]]

UNKNOWN = "–"
MAX_PAGE_BYTES = 15_000_000
_MAX_TEXT_BYTES = 3_000_000  # limit for the texts of all steps together
_SPARE_BYTES = 400_000  # reserved for style, script and the HTML around them
_MAX_PLACES = 6000  # if there are more places, only every second, third, ... is drawn
_MARGIN_M = 30.0  # margin around the drawing if no footprint is known

_NO_PICTURE = (
    "No image from --map-images is drawn on the ground: none belongs to this map, or their headings contradict it. "
    "Pass the images that the map was built from, with their positions.csv, and the lens used in the build."
)
_NO_IMAGES = "With --map-images the page shows the map's own pictures under the drawing."

# Content security policy: the browser loads nothing from anywhere and runs only the page's own script, even if a file
# name in the page contains HTML.
_POLICY = "default-src 'none'; style-src 'unsafe-inline'; img-src data:; script-src 'sha256-{}'"
_PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta http-equiv="Content-Security-Policy" content="{policy}">
<meta name="viewport" content="width=device-width, initial-scale=1"><meta name="color-scheme" content="light dark">
<link rel="icon" href="data:,"><title>edgevpr</title><style>{style}</style></head>
<body><noscript>A script draws this page: allow scripts to see it.</noscript>
<script type="application/json" id="page">{data}</script><script>{script}</script></body></html>
"""


@dataclass(frozen=True, slots=True)
class Layer:
    """A layer of the drawing, which the reader can hide. `colour`: CSS class that sets its colour. `polylines`:
    sequences of positions, each drawn in a `form`: dots, a line or an area."""

    name: str
    colour: str
    polylines: Sequence[Sequence[Point]]
    form: Form = "dots"


@dataclass(frozen=True, slots=True, kw_only=True)
class Step:
    """One step: a query of a flight or a place of a map. `texts`: sentences about it. `groups`: the reasons and
    outcomes by which the reader can filter steps, with the colour of each. `points`: positions by the colour of their
    layer. `circle_m`: radius of a circle around the last point. `place`: the place whose ground is outlined.
    `pictures`: album, name and caption of each picture. `t_s`: its time (None: it has none)."""

    title: str
    texts: Sequence[str]
    groups: Mapping[str, str]
    points: Mapping[str, Point]
    circle_m: float | None = None
    place: Place | None = None
    t_s: float | None = None
    pictures: Sequence[tuple[str, str, str]] = ()


@dataclass(frozen=True, slots=True)
class Chart:
    """A chart over time of values in `unit` ("": fractions, 0..1)."""

    title: str
    unit: str
    series: Sequence[Series]


@dataclass(frozen=True, slots=True)
class Section:
    """A section of text: `lines`, a table of `rows`, and a long text, `folded` by default ("": none)."""

    title: str
    lines: Sequence[str] = ()
    rows: Sequence[Sequence[str]] = ()
    folded: str = ""


def read_located_places(path: str | Path) -> list[Place]:
    """Read the places with a position from the map file `path`. Raises EdgevprError if it is unreadable or damaged."""
    with PlaceMap.open(path) as place_map:
        return [place for place in place_map.read_places() if place.position]


def to_point(position: Position | None) -> Point:
    """Return a position, which must be known, as (lat_deg, lon_deg)."""
    assert position is not None
    return position.lat_deg, position.lon_deg


def make_layer(steps: Sequence[Step], name: str, colour: str, form: Form = "dots") -> Layer:
    """Return the layer of the steps' points of this `colour`; a line is interrupted at a step that has none."""
    runs = groupby((step.points.get(colour) for step in steps), bool)
    return Layer(name, colour, [[point for point in run if point] for is_known, run in runs if is_known], form)


def make_page(
    head: Mapping[str, Any],
    steps: Sequence[Step],
    places: Sequence[Place],
    layers: Sequence[Layer],
    albums: Mapping[str, Album],
    *,
    lens: Lens | None = None,
    notes: Sequence[str] = (),
    charts: Sequence[Chart] = (),
    sections: Sequence[Section] = (),
) -> str:
    """Return a page of at most `MAX_PAGE_BYTES`. `head`: its title, texts below it (`known`), `figures` by name,
    `warnings`, and the length of the time axis `span_s` (None: steps have no times). `places`: drawn below the
    `layers`. `albums`: albums by the names that steps use; "place" is the map's. `lens`: lens of the map's camera
    (None: unknown). `notes`: sentences below the drawing."""
    notes, figures = list(notes), [(name, text) for name, text in head["figures"].items() if text != UNKNOWN]
    content = {**head, "charts": list(map(asdict, charts)), "sections": list(map(asdict, sections)), "figures": figures}
    drawing = _Drawing(places, layers, steps)
    counts = Counter(group for step in steps for group in step.groups)
    colours = {group: colour for step in steps for group, colour in step.groups.items()}
    content["groups"] = [(group, colours[group], count) for group, count in counts.most_common()]
    numbers = {group: number for number, (group, *_) in enumerate(content["groups"])}
    rows = [_serialise_step(step, drawing, numbers) for step in steps]
    if (interval := -(-len(_dump(rows)) // _MAX_TEXT_BYTES)) > 1:
        steps, rows = steps[::interval], rows[::interval]
        notes.append(f"The page would be too large with all steps: one in {interval} is shown.")
    subset = places[:: -(-len(places) // _MAX_PLACES) or 1]
    keys = [[picture[:2] for picture in step.pictures] for step in steps]
    keys += [[("ground", place.source_image)] for place in subset if place.pose]
    ground_album = _make_ground_album(albums["place"], subset, lens)
    budget_bytes = MAX_PAGE_BYTES - _SPARE_BYTES - len(_dump([content, rows, drawing.layers]))
    pictures, left_out = embed_pictures(keys, {**albums, "ground": ground_album}, budget_bytes)
    notes += [left_out] if left_out else []
    if any(place.pose for place in subset) and not any(album == "ground" for album, _ in pictures):
        notes.append(_NO_PICTURE if albums["place"] else _NO_IMAGES)
    indices = {key: index for index, key in enumerate(pictures)}
    for step, row in zip(steps, rows, strict=True):
        row["pictures"] = [
            (caption, indices[album, name]) for album, name, caption in step.pictures if (album, name) in indices
        ]
    squares = [
        (*square, indices.get(("ground", place.source_image))) for place in subset if (square := drawing.square(place))
    ]
    return _render({
        **content,
        "notes": notes,
        "steps": rows,
        "pictures": list(pictures.values()),
        "ground": {"box": drawing.box, "squares": squares, "layers": drawing.layers} if drawing.box else None,
    })  # fmt: skip


class _Drawing:
    """Converts positions to points of the drawing: metres right of and below the first position, with north up. `box`:
    bounding box (left, top, width, height) of the drawing; None: nothing has a position."""

    def __init__(self, places: Sequence[Place], layers: Sequence[Layer], steps: Sequence[Step]) -> None:
        layers = [layer for layer in layers if any(layer.polylines)]
        points = [point for layer in layers for line in layer.polylines for point in line]
        points += [point for step in steps for point in step.points.values()]
        self._origin = points[0] if points else (0.0, 0.0)
        self.box: list[float] | None = None
        if points:
            drawn = np.array([self.convert(point) for point in points])
            margin_m = max((place.pose.footprint_m for place in places if place.pose), default=_MARGIN_M)
            low, high = drawn.min(axis=0) - margin_m, drawn.max(axis=0) + margin_m
            self.box = [round(edge_m, 2) for edge_m in (*low.tolist(), *(high - low).tolist())]
        self.layers = [
            asdict(layer) | {"polylines": [[self.convert(point) for point in line] for line in layer.polylines if line]}
            for layer in layers
        ]

    def convert(self, point: Point) -> tuple[float, float]:
        """Return the point (x, y) of a position."""
        east_m, north_m = offset_m(*self._origin, *point)
        return round(float(east_m), 2), round(-float(north_m), 2)

    def square(self, place: Place) -> tuple[float, ...] | None:
        """Return the centre (x, y), side and direction of the smallest square of ground that contains a place's
        picture; None if they are unknown."""
        if not (place.pose and place.position):
            return None
        return *self.convert(to_point(place.position)), round(place.pose.footprint_m, 2), round(place.pose.up_deg, 1)


def _serialise_step(step: Step, drawing: _Drawing, numbers: Mapping[str, int]) -> dict[str, Any]:
    """Return a step as the script reads it, without its pictures. `numbers`: numbers of the groups by name."""
    return {
        "title": step.title,
        "texts": [sentence for sentence in step.texts if sentence],
        "groups": [numbers[group] for group in step.groups],
        "points": {name: drawing.convert(point) for name, point in step.points.items()},
        "circle": step.circle_m,
        "square": step.place and drawing.square(step.place),
        "t_s": step.t_s,
    }


def _make_ground_album(album: Album, places: Sequence[Place], lens: Lens | None) -> Album:
    """Return the album of the map's pictures aligned with its poses, transparent where they show no ground."""
    by_name = {place.source_image: place for place in places if place.pose}

    def find(name: str) -> AlbumPicture | None:
        picture = album.align_picture(by_name[name], lens)
        if picture is None or picture.mask is None:
            return picture
        colours = np.broadcast_to(np.atleast_3d(picture.image)[..., :3], (*picture.image.shape[:2], 3))
        return AlbumPicture(np.dstack((colours, 255 * picture.mask)).astype(np.uint8))

    return Album(find) if album else Album()


def _dump(value: Any) -> str:
    """Return `value` as JSON without passwords and control characters; no text in it can close the script element."""
    return json.dumps(_clean(value), separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")


def _clean(value: Any) -> Any:
    if isinstance(value, str):
        return value if value.startswith("data:image/") else sanitize(value, keep="\n")
    if isinstance(value, dict):
        return {key: _clean(item) for key, item in value.items()}
    return [_clean(item) for item in value] if isinstance(value, (list, tuple)) else value


def _render(data: Mapping[str, Any]) -> str:
    module = Path(__file__)
    script = module.with_name("page.js").read_text("utf-8")
    sha256 = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    style = module.with_name("page.css").read_text("utf-8")
    return _PAGE.format(policy=_POLICY.format(sha256), style=style, data=_dump(data), script=script)


def format_number(value: float | None, unit: str = "") -> str:
    """Format a number with three significant digits and its unit; a dash for None."""
    if value is None:
        return UNKNOWN
    digits = f"{value:.0f}" if abs(value) >= 100 else f"{value:.3g}"
    return f"{digits} {unit}".strip()


def format_duration(t_s: float) -> str:
    """Format a time in seconds as minutes and seconds (2:03), from one hour with hours (1:02:03)."""
    minutes, seconds = divmod(round(t_s), 60)
    hours = f"{minutes // 60}:{minutes % 60:02d}" if minutes >= 60 else str(minutes)
    return f"{hours}:{seconds:02d}"
