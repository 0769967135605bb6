"""The part of a page that its reader goes through step by step: the queries of a flight or the places of a map, over
the ground and beside their pictures. `page.js` moves it; without script the ground stays as it is drawn.
"""

import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from edgevpr.core.text import shown
from edgevpr.core.types import Place
from edgevpr.review.album import Album, Key, small_pictures
from edgevpr.review.html import data, foreign, page, section, table
from edgevpr.review.logged import Point
from edgevpr.review.mosaic import mosaic_of
from edgevpr.review.overhead import Layer, Overhead, draw

if TYPE_CHECKING:
    from edgevpr.frames.level import Lens

NUMBER = re.compile(r"\d+(\.\d+)?%?")
MOST_PAGE_BYTES = 15_000_000
_MOST_TOLD_BYTES = 3_000_000  # of the texts of all steps
_SPARE_BYTES = 400_000  # for what is not measured: style, script, the frame of the page
_ACROSS = 1000.0  # units of the width of charts and lanes


@dataclass(frozen=True, slots=True, kw_only=True)
class ByConfidence:
    """Judgement of a query by its confidence: its `confidence` and its `kind` of evidence; the probability by the
    flight so far, `followed` (None: alone); whether it was `accepted`; and `off_m`, how far it is from GPS (None:
    unknown)."""

    confidence: float
    kind: str
    followed: float | None
    accepted: bool
    off_m: float | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Step:
    """One step. `title` and `said`: what is told of it. `groups`: the reasons and outcomes by which the reader chooses
    steps. `at`: positions by the colour of their layer. `circle_m`: radius around the last of them. `place`: the place
    whose ground is outlined. `lanes`: numbers of the lanes that have a mark at `t_s`. `pictures`: (which album, name,
    caption) of each. `judged`: set if only its confidence decided whether it was accepted."""

    title: str
    said: Sequence[str]
    groups: Sequence[str]
    at: Mapping[str, Point]
    circle_m: float | None = None
    place: Place | None = None
    t_s: float | None = None
    lanes: Sequence[int] = ()
    pictures: Sequence[tuple[str, str, str]] = ()
    judged: ByConfidence | None = None

    @property
    def keys(self) -> list[Key]:
        """The keys of its pictures."""
        return [(of, name) for of, name, _ in self.pictures]


@dataclass(frozen=True, slots=True)
class Thresholds:
    """Confidences that a match needs, by kind of evidence, for each of the `precisions`; `at` is the place in them of
    the precision that was asked for."""

    precisions: Sequence[float]
    at: int
    needed: Mapping[str, Sequence[float]]


@dataclass(frozen=True, slots=True, kw_only=True)
class Explored:
    """Content of the ground section of a page. `unit` is what a step is called. `albums` are those of the pictures, by
    the names that steps give them; "place" is that of the map, `lens` that of its camera (None: unknown). `named` are
    labels on the ground, `span_s` the length of the lanes, `thresholds` those of the precision slider (None: there is
    none). `notes` are sentences below the ground."""

    unit: str
    ground: Sequence[Place]
    layers: Sequence[Layer]
    steps: Sequence[Step]
    albums: Mapping[str, Album]
    lens: "Lens | None" = None
    named: Sequence[tuple[str, Point]] = ()
    span_s: float = 0.0
    thresholds: Thresholds | None = None
    notes: Sequence[str] = ()


def stepped(title: str, above: Sequence[str], explored: Explored, below: Sequence[str]) -> str:
    """Return a whole page of at most `MOST_PAGE_BYTES`: the sections `above`, the ground and its steps, and the
    sections `below`, all HTML."""
    others = [*above, *below]
    ground = _explorer(explored, sum(len(each.encode("utf-8", "backslashreplace")) for each in others))
    here = Path(__file__)
    return page(title, here.with_name("page.css"), [*above, ground, *below], here.with_name("page.js"))


def counts(reasons: Iterable[str]) -> str:
    """Return a table of how often each reason was given. Numbers in reasons become "…", so that equal ones count
    together."""
    counted = Counter(NUMBER.sub("…", reason) for reason in reasons)
    return table(("times", "why"), [(str(count), why) for why, count in counted.most_common(20)]) if counted else ""


def _explorer(explored: Explored, other_bytes: int) -> str:
    """Return the section of the ground and of the steps over it; "" if there are none. The rest of the page has
    `other_bytes`: pictures are as large as they may be."""
    everything = [at for layer in explored.layers for points in layer.ways for at in points]
    everything += [at for step in explored.steps for at in step.at.values()]
    if not explored.steps and not everything:
        return ""
    said, drawn, view = list(explored.notes), "", None
    if everything:
        view = Overhead(everything, explored.ground)
        if explored.ground:
            mosaic = mosaic_of(explored.ground, explored.albums["place"], explored.lens, view.origin)
            if isinstance(mosaic, str):
                said.append(mosaic)
            else:
                view.mosaic = mosaic
        drawn = draw(view, explored.ground, explored.layers, explored.named)
    groups = Counter(group for step in explored.steps for group in dict.fromkeys(step.groups))
    number_of = {group: at for at, (group, _) in enumerate(groups.most_common())}
    limits = explored.thresholds
    steps = explored.steps
    told = [_told(step, view, number_of, explored.span_s) for step in steps]
    if (every := -(-len(data("", told)) // _MOST_TOLD_BYTES)) > 1:
        steps, told = steps[::every], told[::every]
        said.append(f"The page would be too large with all steps: shown is one {explored.unit} in {every}.")
    for each in told:
        if not (limits and each["judged"] and each["judged"]["kind"] in limits.needed):
            each["judged"] = None
    left_bytes = MOST_PAGE_BYTES - _SPARE_BYTES - other_bytes - len(drawn) - len(data("", told))
    found, left_out = small_pictures([step.keys for step in steps], explored.albums, left_bytes)
    said += [left_out] if left_out else []
    numbers = {key: at for at, key in enumerate(found)}
    for step, each in zip(steps, told, strict=True):
        there = [picture for picture in step.pictures if picture[:2] in numbers]
        each["pictures"] = [(shown(caption), numbers[of, name]) for of, name, caption in there]
    known = {
        "steps": told,
        "pictures": list(found.values()),
        "perM": view.per_m if view else 1,
        "precisions": limits and limits.precisions,
        "at": limits and limits.at,
        "needed": limits and limits.needed,
    }
    notes = f'<p class="soft">{foreign(" ".join(said))}</p>' if said else ""
    parts = f"{drawn}{_controls(explored.unit, len(steps), groups)}{notes}{_precision(limits)}"
    title = "Over the ground" if drawn else "Step by step"
    return section(title, f'<div class="ground">{parts}</div>{data("steps", known)}')


def _told(step: Step, view: Overhead | None, number_of: Mapping[str, int], span_s: float) -> dict[str, Any]:
    """Return a step as the script reads it, without its pictures."""
    judged = step.judged
    placed = {name: [round(each, 1) for each in view.on([at])[0]] for name, at in step.at.items()} if view else {}
    return {
        "title": shown(step.title),
        "said": [shown(each) for each in step.said if each],
        "groups": [number_of[each] for each in dict.fromkeys(step.groups)],
        "at": placed,
        "circle": round(step.circle_m * view.per_m, 2) if view and step.circle_m else None,
        "square": view.square(step.place) if view and step.place else "",
        "x": None if step.t_s is None else round(_ACROSS * min(step.t_s / (span_s or 1.0), 1.0), 1),
        "lanes": list(step.lanes),
        "judged": judged
        and {
            "sure": judged.confidence,
            "kind": judged.kind,
            "followed": judged.followed,
            "accepted": judged.accepted,
            "off": None if judged.off_m is None else round(judged.off_m, 1),
        },
    }


def _controls(unit: str, count: int, groups: Counter[str]) -> str:
    """Return the controls of the steps, hidden until the script shows them."""
    if not count:
        return ""
    boxes = "".join(
        f'<label><input type="checkbox" data-group="{at}">{foreign(group)} <b>{count}</b></label>'
        for at, (group, count) in enumerate(groups.most_common())
    )
    choose = f'<details class="choose"><summary>Show only some</summary><div>{boxes}</div></details>' if boxes else ""
    return (
        f'<div class="stepper" hidden><div class="slide"><button type="button" id="play" aria-label="play">▶</button>'
        f'<input type="range" id="step" min="0" max="{count - 1}" value="0" step="1" aria-label="{unit}">'
        f'<output id="which" for="step"></output></div>'
        '<div class="now"><h3></h3><div></div><div class="pair"></div></div>'
        f"{choose}</div>"
    )


def _precision(limits: Thresholds | None) -> str:
    if limits is None:
        return ""
    return (
        '<fieldset class="precision" hidden><legend>What another precision would have accepted</legend>'
        '<div class="slide"><label for="precision">accept_precision</label>'
        f'<input type="range" id="precision" min="0" max="{len(limits.precisions) - 1}" value="{limits.at}" step="1">'
        '<output id="asked" for="precision"></output></div><p id="would" aria-live="polite"></p><ul id="others"></ul>'
        '<p class="soft">Counted are matches that only their confidence decided: each against the threshold that its '
        "kind of evidence needs in this map, with what the flight so far said of it as it was. The checks after the "
        "confidence were not made for a refused match, so fewer might be accepted. It has no position of its own: it "
        "is shown, and its distance from GPS taken, at the place that was found.</p></fieldset>"
    )
