"""Parts of HTML pages that need no network, in the light or dark colours that the reader has chosen: for the pages of
flights, matches and maps (`review.page`) and of evaluations (`lab.evaluate.page`).

Charts follow the width of the page, while their lines and dots keep their thickness. Their text is HTML beside the SVG,
so that it is readable on a phone. A `colour` is a CSS class that sets the colour. Functions that return a str return
HTML, unless they say otherwise.
"""

import base64
import hashlib
import json
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

from edgevpr.core.text import shown

Points = Sequence[tuple[float, float]]  # (x, value), or (x, y) of a drawing

UNKNOWN = "–"

_WIDE, _HIGH = 1000.0, 100.0
_LAST = 0.97  # share of an axis: a text centred on a point further right would leave the page
_STEPS_S = (1, 2, 5, 10, 15, 30, 60, 120, 300, 600, 900, 1800, 3600, 7200, 14400, 28800, 86400)
_MOST_TICKS = 6

# Content security policy: the browser loads nothing from anywhere and runs no script but the page's own, even if a file
# name in the page contains HTML.
_POLICY = "default-src 'none'; style-src 'unsafe-inline'; img-src data:"


def page(title: str, style: Path, body: Iterable[str], script: Path | None = None) -> str:
    """Return a whole page. `style` is a CSS file that is added to the style of all pages; `body` is HTML. `script` is a
    file of JavaScript that runs when the page is there (None: none does)."""
    common = Path(__file__).with_name("common.css").read_text("utf-8")
    code = script.read_text("utf-8") if script else ""
    sha256 = base64.b64encode(hashlib.sha256(code.encode()).digest()).decode()
    policy = f"{_POLICY}; script-src 'sha256-{sha256}'" if script else _POLICY
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        '<meta name="color-scheme" content="light dark"><link rel="icon" href="data:,">'
        f"<title>{foreign(title)}</title><style>{common}{style.read_text('utf-8')}</style></head>\n"
        f"<body>{''.join(body)}{f'<script>{code}</script>' if script else ''}</body></html>\n"
    )


def data(name: str, value: Any) -> str:
    """Return `value`, which `json.dumps` takes, as data of the page, for its script: nothing in it can end the data."""
    text = json.dumps(value, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
    return f'<script type="application/json" id="{name}">{text}</script>'


def foreign(text: str) -> str:
    """Return `text`, which may come from anywhere, as HTML: escaped, without passwords and control characters."""
    return escape(shown(text))


def heading(title: str, known: Iterable[str]) -> str:
    """Return the title of a page, and below it the texts `known`, separated by commas."""
    return f'<h1>{foreign(title)}</h1><p class="soft">{foreign(", ".join(known))}</p>'


def figures(known: Mapping[str, str]) -> str:
    """Return figures by their names, as HTML each; those that are unknown are left out."""
    rows = "".join(f"<div><dt>{name}</dt><dd>{each}</dd></div>" for name, each in known.items() if each != UNKNOWN)
    return f'<dl class="figures">{rows}</dl>'


def section(title: str, content: str) -> str:
    """Return a section; "" if `content` is empty. `title` (may be empty) and `content` are HTML."""
    if not content:
        return ""
    return f"<section>{f'<h2>{title}</h2>' if title else ''}{content}</section>\n"


def notes(sentences: Iterable[str]) -> str:
    """Return a box with a list of `sentences` that a reader must know; "" if there are none."""
    items = "".join(f"<li>{foreign(sentence)}</li>" for sentence in sentences)
    return f'<section class="notes"><ul>{items}</ul></section>' if items else ""


def table(headings: Sequence[str], rows: Sequence[Sequence[str]], cell: Callable[[str], str] = foreign) -> str:
    """Return a table, which scrolls sideways on a narrow screen. `cell` turns the text of each cell into HTML."""
    head = "".join(f"<th>{text}</th>" for text in headings)
    lines = "".join(f"<tr>{''.join(f'<td>{cell(text)}</td>' for text in row)}</tr>" for row in rows)
    return f'<div class="scroll"><table><tr>{head}</tr>{lines}</table></div>'


def picture(name: str, caption: str, jpeg: bytes) -> str:
    """Return a picture with a caption. The JPEG is stored inside the page, as a data: address."""
    data = base64.b64encode(jpeg).decode()
    return (
        f'<figure><img alt="{foreign(name)}" src="data:image/jpeg;base64,{data}">'
        f"<figcaption>{foreign(caption)}</figcaption></figure>"
    )


@dataclass(frozen=True, slots=True)
class Series:
    """One line of a chart (with `are_dots`: its dots): the name in the legend, the colour, and the points (x, value) in
    the order of x."""

    name: str
    colour: str
    points: Points
    are_dots: bool = False


@dataclass(frozen=True, slots=True)
class Axis:
    """The horizontal axis, from `first` to `last`. Each of `ticks` is (value on the axis; text below it)."""

    first: float
    last: float
    ticks: Sequence[tuple[float, str]]

    def across(self, x: float) -> float:
        """Return where `x` lies along the axis, from 0 (left end, or left of it) to 1 (right end, or right of it)."""
        return min(max((x - self.first) / ((self.last - self.first) or 1.0), 0.0), 1.0)

    def grid(self, high: float) -> str:
        """Return an SVG path of vertical lines at the ticks, `high` units high, and the line below them."""
        lines = "".join(f"M{_WIDE * self.across(x):.1f} 0v{high:g}" for x, _ in self.ticks)
        return f'<path class="grid" d="{lines}M0 {high:g}h{_WIDE:g}"/>'

    def below(self) -> str:
        """Return the texts below the axis, as HTML."""
        texts = ""
        for x, text in self.ticks:
            left = self.across(x)
            last = " class=last" if left > _LAST else ""
            texts += f'<span{last} style="left:{100 * left:.1f}%">{escape(text)}</span>' if text else ""
        return f'<div class="times">{texts}</div>'


def chart(title: str, unit: str, series: Sequence[Series], axis: Axis, top: float = 0.0) -> str:
    """Return a chart of `series` as HTML. Its values reach from 0 to the highest one, and to `top` at least. A series
    without points is left out; if none has points, the result is ""."""
    series = [each for each in series if each.points]
    if not series:
        return ""
    highest = nice(max(top, *(value for each in series for _, value in each.points)))
    paths = ""
    for each in series:
        path, kind = (dots, "dots") if each.are_dots else (way, "line")
        places = [(_WIDE * axis.across(x), _HIGH * (1 - max(v, 0.0) / highest)) for x, v in each.points]
        paths += f'<path class="{kind} {each.colour}" d="{path(places)}"/>'
    legend = "".join(f'<span class="key {each.colour}">{escape(each.name)}</span>' for each in series if each.name)
    drawing = _svg(f"{title}, {unit}", _HIGH, axis.grid(_HIGH) + paths)
    return _framed(title, f"{unit} {legend}", highest, axis, drawing)


def lanes(rows: Sequence[tuple[str, str, Sequence[float]]], span_s: float) -> str:
    """Return one lane for each row (name, colour, times in seconds): a mark at every time, and their number; "" without
    rows."""
    axis, lines = times(span_s), ""
    for at, (name, colour, times_s) in enumerate(rows):
        marks = "".join(f"M{x:g} 0v20" for x in sorted({round(_WIDE * axis.across(t_s), 1) for t_s in times_s}))
        path = f'<path class="mark {colour}" d="{marks}" data-lane="{at}"/>'
        drawing = _svg(f"{name}: {len(times_s)}", 20, axis.grid(20) + path)
        lines += f"<span>{escape(name)} <b>{len(times_s)}</b></span>{drawing}"
    return f'<div class="lanes">{lines}<span></span>{axis.below()}</div>' if rows else ""


def dots(points: Points) -> str:
    """Return SVG path data of dots: lines of length 0, whose round ends make dots as wide as the line."""
    return "".join(f"M{x:.1f} {y:.1f}h0" for x, y in points)


def way(points: Points) -> str:
    """Return SVG path data of a line through `points`; a single point becomes a dot."""
    return "M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in points) + ("h0" if len(points) == 1 else "")


def nice(value: float) -> float:
    """Round up to two digits that are easily read: 1, 1.2, 1.5, 2, 2.5, 3, 4, 5, 6 or 8 times a power of ten."""
    if value <= 0:
        return 1.0
    power = 10.0 ** math.floor(math.log10(value))
    return next(step * power for step in (1, 1.2, 1.5, 2, 2.5, 3, 4, 5, 6, 8, 10) if step * power >= value * 0.999)


def figure(value: float | None, unit: str = "") -> str:
    """Return a number, with three significant digits, and its unit as text; a dash for None."""
    if value is None:
        return UNKNOWN
    digits = f"{value:.0f}" if abs(value) >= 100 else f"{value:.3g}"
    return f"{digits} {unit}".strip()


def clock(t_s: float) -> str:
    """Return a time in seconds as text: minutes and seconds (2:03), from an hour on with the hours (1:02:03)."""
    minutes, seconds = divmod(round(t_s), 60)
    hours = f"{minutes // 60}:{minutes % 60:02d}" if minutes >= 60 else str(minutes)
    return f"{hours}:{seconds:02d}"


def _svg(label: str, high: float, content: str) -> str:
    return (
        f'<svg role="img" aria-label="{escape(label)}" viewBox="0 0 {_WIDE:g} {high:g}" preserveAspectRatio="none">'
        f"{content}</svg>"
    )


def _framed(title: str, beside: str, highest: float, axis: Axis, drawing: str) -> str:
    return (
        f'<figure class="chart"><figcaption><b>{escape(title)}</b> {beside}</figcaption>'
        f'<div class="plot"><div class="scale"><span>{figure(highest)}</span><span>0</span></div>'
        f"<div>{drawing}{axis.below()}</div></div></figure>"
    )


def times(span_s: float) -> Axis:
    """Return an axis of time, from 0 to `span_s` seconds."""
    step = next((each for each in _STEPS_S if span_s / each <= _MOST_TICKS), span_s / _MOST_TICKS)
    ticks = [count * step for count in range(int(span_s / step) + 1)] if step else [0.0]
    last = _LAST * span_s
    return Axis(0.0, span_s, [(t_s, clock(t_s) if t_s <= last or not t_s else "") for t_s in ticks])
