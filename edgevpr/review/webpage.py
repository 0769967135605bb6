"""Makes a page of a flight, of matches or of a map: one HTML file that needs no network. Python gives the content as
data; `page.js` draws and moves it. All texts reach the page as text, never as HTML."""

import base64
import hashlib
import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from edgevpr.core.geodesy import offset_m
from edgevpr.core.text import sanitize
from edgevpr.core.types import Place
from edgevpr.places.mapfile import PlaceMap
from edgevpr.review.album import Album, AlbumPicture, embed_pictures
from edgevpr.review.logged import Point

if TYPE_CHECKING:
    from edgevpr.frames.level import Lens

Form = Literal["dots", "line", "area"]

UNKNOWN = "–"
MAX_PAGE_BYTES = 15_000_000
_MAX_TEXT_BYTES = 3_000_000  # of the texts of all steps
_SPARE_BYTES = 400_000  # for style, script and the frame of the page
_MAX_PLACES = 6000  # drawn; of more, every second, third, ... is drawn
_MARGIN_M = 30.0  # around what is drawn, where no place knows how much ground its picture shows

_NO_PICTURE = (
    "No image of --map-images is drawn on the ground: none is of this map, or their headings contradict it. Give the "
    "images that the map was built from, with their positions.csv, and the lens of the build."
)
_NO_IMAGES = "With --map-images the page shows the map's own pictures under the drawing."

# Content security policy: the browser loads nothing from anywhere and runs no script but the page's own, even if a file
# name in the page contains HTML.
_POLICY = "default-src 'none'; style-src 'unsafe-inline'; img-src data:; script-src 'sha256-{}'"
_PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta http-equiv="Content-Security-Policy" content="{policy}">
<meta name="viewport" content="width=device-width, initial-scale=1"><meta name="color-scheme" content="light dark">
<link rel="icon" href="data:,"><title>edgevpr</title><style>{style}</style></head>
<body><noscript>This page is drawn by its own script: allow scripts.</noscript>
<script type="application/json" id="page">{data}</script><script>{script}</script></body></html>
"""


@dataclass(frozen=True, slots=True)
class Layer:
    """Layer of the drawing, which the reader can hide: its name, the CSS class that colours it, and its `ways`, each a
    sequence of positions, drawn in a `form`: dots, a line, or an area."""

    name: str
    colour: str
    ways: Sequence[Sequence[Point]]
    form: Form = "dots"


@dataclass(frozen=True, slots=True, kw_only=True)
class Step:
    """One step, a query of a flight or a place of a map: its `title`, sentences about it (`texts`), and the reasons and
    outcomes (`groups`) by which the reader chooses steps, with the colour of each. `points`: positions by the colour
    of their layer. `circle_m`: radius around the last of them. `place`: the place whose ground is outlined. `pictures`:
    (which album, name, caption) of each. `t_s`: its time (None: it has none)."""

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
    """A chart over time of values in `unit` ("": shares, up to 1). Each of `series` is the name in its legend, the
    colour, and the points (t_s, value); those of a form "dots" are not joined."""

    title: str
    unit: str
    series: Sequence[tuple[str, str, Form, Sequence[tuple[float, float]]]]


@dataclass(frozen=True, slots=True)
class Section:
    """A section of texts: `lines`, a table of `rows`, and a long text, `folded` away ("": none)."""

    title: str
    lines: Sequence[str] = ()
    rows: Sequence[Sequence[str]] = ()
    folded: str = ""


def read_ground(path: str | Path) -> list[Place]:
    """Read the places of the map file `path` that have a position. Raises EdgevprError for a map that cannot be read,
    or is damaged."""
    with PlaceMap.open(path) as place_map:
        return [place for place in place_map.read_places() if place.position]


def to_point(place: Place) -> Point:
    """Return the position (lat_deg, lon_deg) of a place that has one."""
    assert place.position is not None
    return place.position.lat_deg, place.position.lon_deg


def make_layer(steps: Sequence[Step], name: str, colour: str, form: Form = "dots") -> Layer:
    """Return the layer of the positions that steps have under `colour`: a line ends where a step has none."""
    runs = groupby((step.points.get(colour) for step in steps), bool)
    return Layer(name, colour, [[point for point in run if point] for is_known, run in runs if is_known], form)


def make_page(
    head: Mapping[str, Any],
    steps: Sequence[Step],
    ground: Sequence[Place],
    layers: Sequence[Layer],
    albums: Mapping[str, Album],
    *,
    lens: "Lens | None" = None,
    notes: Sequence[str] = (),
    charts: Sequence[Chart] = (),
    sections: Sequence[Section] = (),
) -> str:
    """Return a whole page of at most `MAX_PAGE_BYTES`. `head` has its title, texts below it (`known`), `figures` by
    name, `warnings` and `span_s`, the length of the time axis (None: steps have no times). `ground` are the places
    drawn below the `layers`. `albums` are those of the pictures, by the names that steps give them; "place" is that of
    the map, `lens` that of its camera (None: unknown). `notes` are sentences below the ground."""
    notes, rest = list(notes), {**head, "charts": list(map(asdict, charts)), "sections": list(map(asdict, sections))}
    rest["figures"] = [(name, text) for name, text in head["figures"].items() if text != UNKNOWN]
    drawing = _Drawing(ground, layers, steps)
    counts = Counter(group for step in steps for group in step.groups)
    colours = {group: colour for step in steps for group, colour in step.groups.items()}
    rest["groups"] = [(group, colours[group], count) for group, count in counts.most_common()]
    numbers = {group: number for number, (group, *_) in enumerate(rest["groups"])}
    rows = [_serialise_step(step, drawing, numbers) for step in steps]
    if (every := -(-len(_dump(rows)) // _MAX_TEXT_BYTES)) > 1:
        steps, rows = steps[::every], rows[::every]
        notes.append(f"The page would be too large with all steps: one in {every} is shown.")
    shown = ground[:: -(-len(ground) // _MAX_PLACES) or 1]
    keys = [[picture[:2] for picture in step.pictures] for step in steps]
    keys += [[("ground", place.source_image)] for place in shown if place.pose]
    levelled = _make_ground_album(albums["place"], shown, lens)
    room_bytes = MAX_PAGE_BYTES - _SPARE_BYTES - len(_dump([rest, rows, drawing.layers]))
    pictures, left_out = embed_pictures(keys, {**albums, "ground": levelled}, room_bytes)
    notes += [left_out] if left_out else []
    if any(place.pose for place in shown) and not any(album == "ground" for album, _ in pictures):
        notes.append(_NO_PICTURE if albums["place"] else _NO_IMAGES)
    indices = {key: index for index, key in enumerate(pictures)}
    for step, row in zip(steps, rows, strict=True):
        row["pictures"] = [
            (caption, indices[album, name]) for album, name, caption in step.pictures if (album, name) in indices
        ]
    squares = [
        (*square, indices.get(("ground", place.source_image))) for place in shown if (square := drawing.square(place))
    ]
    return _render({
        **rest,
        "notes": notes,
        "steps": rows,
        "pictures": list(pictures.values()),
        "ground": {"box": drawing.box, "squares": squares, "layers": drawing.layers} if drawing.box else None,
    })  # fmt: skip


class _Drawing:
    """Converts positions into points of the drawing: metres to the right of and below the first one, with north up.
    `box` is (left, top, width, height) of all that is drawn; None: nothing has a position."""

    def __init__(self, ground: Sequence[Place], layers: Sequence[Layer], steps: Sequence[Step]) -> None:
        layers = [layer for layer in layers if any(layer.ways)]
        points = [point for layer in layers for way in layer.ways for point in way]
        points += [point for step in steps for point in step.points.values()]
        self._origin = points[0] if points else (0.0, 0.0)
        self.box: list[float] | None = None
        if points:
            drawn = np.array([self.convert(point) for point in points])
            margin_m = max((place.pose.footprint_m for place in ground if place.pose), default=_MARGIN_M)
            low, high = drawn.min(axis=0) - margin_m, drawn.max(axis=0) + margin_m
            self.box = [round(edge_m, 2) for edge_m in (*low.tolist(), *(high - low).tolist())]
        self.layers = [
            {**asdict(layer), "ways": [[self.convert(point) for point in way] for way in layer.ways if way]}
            for layer in layers
        ]

    def convert(self, point: Point) -> tuple[float, float]:
        """Return the point (x, y) of a position."""
        east_m, north_m = offset_m(*self._origin, *point)
        return round(float(east_m), 2), round(-float(north_m), 2)

    def square(self, place: Place) -> tuple[float, ...] | None:
        """Return middle (x, y), side and direction of the square of ground in which a place's picture lies, whose
        longest side is that of the square; None if that is unknown."""
        if not (place.pose and place.position):
            return None
        return *self.convert(to_point(place)), round(place.pose.footprint_m, 2), round(place.pose.up_deg, 1)


def _serialise_step(step: Step, drawing: _Drawing, numbers: Mapping[str, int]) -> dict[str, Any]:
    """Return a step as the script reads it, without its pictures. `numbers` are those of the groups."""
    return {
        "title": step.title,
        "texts": [sentence for sentence in step.texts if sentence],
        "groups": [numbers[group] for group in step.groups],
        "points": {name: drawing.convert(point) for name, point in step.points.items()},
        "circle": step.circle_m,
        "square": step.place and drawing.square(step.place),
        "t_s": step.t_s,
    }


def _make_ground_album(album: Album, places: Sequence[Place], lens: "Lens | None") -> Album:
    """Return the album of the map's pictures as its poses lay them on the ground, transparent where they show none."""
    by_name = {place.source_image: place for place in places if place.pose}

    def find(name: str) -> AlbumPicture | None:
        picture = album.align_picture(by_name[name], lens)
        if picture is None or picture.mask is None:
            return picture
        colours = np.broadcast_to(np.atleast_3d(picture.image)[..., :3], (*picture.image.shape[:2], 3))
        return AlbumPicture(np.dstack((colours, 255 * picture.mask)).astype(np.uint8))

    return Album(find) if album else Album()


def _dump(value: Any) -> str:
    """Return `value` as JSON that no text in it can end, without passwords and control characters."""
    return json.dumps(_clean(value), separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")


def _clean(value: Any) -> Any:
    if isinstance(value, str):
        return value if value.startswith("data:image/") else sanitize(value, keep="\n")
    if isinstance(value, dict):
        return {key: _clean(item) for key, item in value.items()}
    return [_clean(item) for item in value] if isinstance(value, (list, tuple)) else value


def _render(data: Mapping[str, Any]) -> str:
    here = Path(__file__)
    script = here.with_name("page.js").read_text("utf-8")
    sha256 = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    style = here.with_name("page.css").read_text("utf-8")
    return _PAGE.format(policy=_POLICY.format(sha256), style=style, data=_dump(data), script=script)


def format_number(value: float | None, unit: str = "") -> str:
    """Return a number, with three significant digits, and its unit as text; a dash for None."""
    if value is None:
        return UNKNOWN
    digits = f"{value:.0f}" if abs(value) >= 100 else f"{value:.3g}"
    return f"{digits} {unit}".strip()


def format_duration(t_s: float) -> str:
    """Return a time in seconds as text: minutes and seconds (2:03), from an hour on with the hours (1:02:03)."""
    minutes, seconds = divmod(round(t_s), 60)
    hours = f"{minutes // 60}:{minutes % 60:02d}" if minutes >= 60 else str(minutes)
    return f"{hours}:{seconds:02d}"
