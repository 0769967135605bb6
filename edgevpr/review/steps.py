"""The part of a page that its reader goes through step by step: the queries of a flight or the places of a map, over
the ground and beside their pictures. `page.js` moves it; without script the ground stays as it is drawn.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any

from edgevpr.core.text import shown
from edgevpr.core.types import Place
from edgevpr.review.album import Album, small_pictures
from edgevpr.review.html import Axis, data, foreign, lane, page, section
from edgevpr.review.logged import Point
from edgevpr.review.mosaic import lay_mosaic
from edgevpr.review.overhead import Form, Layer, Overhead

if TYPE_CHECKING:
    from edgevpr.frames.level import Lens

MOST_PAGE_BYTES = 15_000_000
_MOST_TEXT_BYTES = 3_000_000  # of the texts of all steps
_SPARE_BYTES = 400_000  # for what is not measured: style, script, the frame of the page
_CONTROLS = (
    '<div class="stepper" hidden><div class="slide"><button type="button" id="play" aria-label="play">▶</button>'
    '<input type="range" id="step" min="0" value="0" aria-label="step"><output id="which" for="step"></output></div>'
    '<div class="now"><h3></h3><div></div><div class="pair"></div></div></div>'
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Step:
    """One step: its `title`, the sentences `said` of it, and the reasons and outcomes (`groups`) by which the reader
    chooses steps, with the colour of each. `at`: positions by the colour of their layer. `circle_m`: radius around the
    last of them. `place`: the place whose ground is outlined. `pictures`: (which album, name, caption) of each."""

    title: str
    said: Sequence[str]
    groups: Mapping[str, str]
    at: Mapping[str, Point]
    circle_m: float | None = None
    place: Place | None = None
    t_s: float = 0.0
    pictures: Sequence[tuple[str, str, str]] = ()


def layer_of(steps: Sequence[Step], name: str, colour: str, form: Form = "dots") -> Layer:
    """Return the layer of the positions that steps have under `colour`: a line ends where a step has none."""
    runs = groupby((step.at.get(colour) for step in steps), bool)
    return Layer(name, colour, [[at for at in run if at] for is_known, run in runs if is_known], form)


@dataclass(frozen=True, slots=True, kw_only=True)
class Explored:
    """Content of the ground section of a page. `albums` are those of the pictures, by the names that steps give them;
    "place" is that of the map, `lens` that of its camera (None: unknown). `axis` is that of the times of the steps
    (None: they have no time). `notes` are sentences below the ground."""

    ground: Sequence[Place]
    layers: Sequence[Layer]
    steps: Sequence[Step]
    albums: Mapping[str, Album]
    lens: "Lens | None" = None
    axis: Axis | None = None
    notes: Sequence[str] = ()


def make_page(title: str, above: Sequence[str], explored: Explored, below: Sequence[str]) -> str:
    """Return a whole page of at most `MOST_PAGE_BYTES`: the sections `above`, the ground and its steps, and the
    sections `below`, all HTML."""
    room_bytes = MOST_PAGE_BYTES - _SPARE_BYTES
    room_bytes -= sum(len(part.encode("utf-8", "backslashreplace")) for part in (*above, *below))
    here = Path(__file__)
    body = [*above, _explorer(explored, room_bytes), *below]
    return page(title, here.with_name("page.css"), body, here.with_name("page.js"))


def _explorer(explored: Explored, room_bytes: int) -> str:
    """Return the section of the ground and of the steps over it, in at most `room_bytes`; "" if there are none."""
    layers = [layer for layer in explored.layers if any(layer.ways)]
    points = [point for layer in layers for way in layer.ways for point in way]
    points += [point for step in explored.steps for point in step.at.values()]
    if not explored.steps and not points:
        return ""
    notes, drawn, view = list(explored.notes), "", None
    if points:
        view, mosaic = Overhead(points, explored.ground), None
        if explored.ground:
            mosaic, lacking = lay_mosaic(explored.ground, explored.albums["place"], explored.lens, view.origin)
            notes += [lacking] if lacking else []
        drawn = view.draw(explored.ground, layers, mosaic)
    counts = Counter(group for step in explored.steps for group in step.groups)
    numbers = {group: number for number, (group, _) in enumerate(counts.most_common())}
    rows = [_row(step, view, numbers, explored.axis) for step in explored.steps]
    steps, every = explored.steps, -(-len(data("", rows)) // _MOST_TEXT_BYTES)
    if every > 1:
        steps, rows = steps[::every], rows[::every]
        notes.append(f"The page would be too large with all steps: one in {every} is shown.")
    room_bytes -= len(drawn) + len(data("", rows))
    wanted = [[picture[:2] for picture in step.pictures] for step in steps]
    pictures, left_out = small_pictures(wanted, explored.albums, room_bytes)
    notes += [left_out] if left_out else []
    at = {key: number for number, key in enumerate(pictures)}
    for step, row in zip(steps, rows, strict=True):
        row["pictures"] = [(shown(caption), at[of, name]) for of, name, caption in step.pictures if (of, name) in at]
    known = {"steps": rows, "pictures": list(pictures.values())}
    parts = f"{drawn}{_CONTROLS if steps else ''}{_choice(explored, numbers)}"
    parts += f'<p class="soft">{foreign(" ".join(notes))}</p>' if notes else ""
    title = "Over the ground" if drawn else "Step by step"
    return section(title, f'<div class="ground">{parts}</div>{data("steps", known)}')


def _row(step: Step, view: Overhead | None, numbers: Mapping[str, int], axis: Axis | None) -> dict[str, Any]:
    """Return a step as the script reads it, without its pictures. `numbers` are those of the groups."""
    placed = {name: [round(each, 2) for each in view.on([at])[0]] for name, at in step.at.items()} if view else {}
    return {
        "title": shown(step.title),
        "said": [shown(sentence) for sentence in step.said if sentence],
        "groups": [numbers[group] for group in step.groups],
        "at": placed,
        "circle": step.circle_m,
        "square": view.square(step.place) if view and step.place else "",
        "x": round(axis.x(step.t_s), 1) if axis else None,
    }


def _choice(explored: Explored, numbers: Mapping[str, int]) -> str:
    """Return a box for each group, by which the reader chooses steps, with their count and their times."""
    rows, axis = "", explored.axis
    for group, number in numbers.items():
        steps = [step for step in explored.steps if group in step.groups]
        box = f'<input type="checkbox" data-group="{number}">'
        rows += f"<label>{box}{foreign(group)} <b>{len(steps)}</b></label>"
        if axis:
            times_s = [step.t_s for step in steps]
            rows += lane(shown(group), steps[0].groups[group], times_s, axis, f'data-lane="{number}"')
    if not rows:
        return ""
    content = (
        f'<div class="lanes">{rows}<span></span>{axis.texts()}</div>' if axis else f'<div class="boxes">{rows}</div>'
    )
    return f'<details class="choose" open><summary>Show only some</summary>{content}</details>'
