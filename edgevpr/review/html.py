"""Parts of HTML pages that need no network, in the light or dark colours that the reader has chosen: for the pages of
flights, matches and maps (`review.page`).

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
WIDTH = 1000.0  # of every drawing, in its own units

_CHART_HEIGHT = 100.0
_LANE_HEIGHT = 20.0
_LAST_TICK = 0.97  # share of an axis: a text centred on a point further right would leave the page
_TICKS_S = (1, 2, 5, 10, 15, 30, 60, 120, 300, 600, 900, 1800, 3600, 7200, 14400, 28800, 86400)
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


def data_url(kind: str, content: bytes) -> str:
    """Return a file of an image of a `kind` ("webp") as an address that needs no file."""
    return f"data:image/{kind};base64,{base64.b64encode(content).decode()}"


def foreign(text: str) -> str:
    """Return `text`, which may come from anywhere, as HTML: escaped, without passwords and control characters."""
    return escape(shown(text))


def heading(title: str, known: Iterable[str]) -> str:
    """Return the title of a page, and below it the texts `known`, separated by commas."""
    return f'<h1>{foreign(title)}</h1><p class="soft">{foreign(", ".join(known))}</p>'


def figures(known: Mapping[str, str]) -> str:
    """Return a section of figures by their names, as HTML each; those that are unknown are left out."""
    rows = "".join(f"<div><dt>{name}</dt><dd>{text}</dd></div>" for name, text in known.items() if text != UNKNOWN)
    return section("", f'<dl class="figures">{rows}</dl>')


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

    def x(self, value: float) -> float:
        """Return where `value` lies along the axis, from 0 (left end, or left of it) to `WIDTH` (right end)."""
        return WIDTH * min(max((value - self.first) / ((self.last - self.first) or 1.0), 0.0), 1.0)

    def grid(self, height: float) -> str:
        """Return an SVG path of vertical lines at the ticks, and the line below them."""
        lines = "".join(f"M{self.x(value):.1f} 0v{height:g}" for value, _ in self.ticks)
        return f'<path class="grid" d="{lines}M0 {height:g}h{WIDTH:g}"/>'

    def texts(self) -> str:
        """Return the texts below the axis."""
        texts = ""
        for share, text in ((self.x(value) / WIDTH, text) for value, text in self.ticks):
            last = " class=last" if share > _LAST_TICK else ""
            texts += f'<span{last} style="left:{share:.1%}">{escape(text)}</span>' if text else ""
        return f'<div class="times">{texts}</div>'


def time_axis(span_s: float) -> Axis:
    """Return an axis of time, from 0 to `span_s` seconds."""
    step_s = next((step_s for step_s in _TICKS_S if span_s / step_s <= _MOST_TICKS), span_s / _MOST_TICKS)
    ticks_s = [count * step_s for count in range(int(span_s / step_s) + 1)]
    return Axis(0.0, span_s, [(t_s, clock(t_s) if t_s <= _LAST_TICK * span_s or not t_s else "") for t_s in ticks_s])


def chart(title: str, unit: str, series: Sequence[Series], axis: Axis, top: float = 0.0) -> str:
    """Return a chart of `series`. Its values reach from 0 to the highest one, and to `top` at least. A series without
    points is left out; if none has points, the result is ""."""
    series = [each for each in series if each.points]
    if not series:
        return ""
    highest = _round_up(max(top, *(value for each in series for _, value in each.points)))
    paths = axis.grid(_CHART_HEIGHT)
    for each in series:
        points = [(axis.x(x), _CHART_HEIGHT * (1 - max(value, 0.0) / highest)) for x, value in each.points]
        form = "dots" if each.are_dots else "line"
        paths += f'<path class="{form} {each.colour}" d="{path(points, form)}"/>'
    legend = "".join(f'<span class="key {each.colour}">{escape(each.name)}</span>' for each in series if each.name)
    return (
        f'<figure class="chart"><figcaption><b>{escape(title)}</b> {unit} {legend}</figcaption>'
        f'<div class="plot"><div class="scale"><span>{figure(highest)}</span><span>0</span></div>'
        f"<div>{_svg(f'{title}, {unit}', _CHART_HEIGHT, paths)}{axis.texts()}</div></div></figure>"
    )


def lane(name: str, colour: str, times_s: Sequence[float], axis: Axis, attributes: str = "") -> str:
    """Return a lane with a mark at each of `times_s`. `attributes` are those of the path of the marks."""
    marks = "".join(f"M{x:g} 0v{_LANE_HEIGHT:g}" for x in sorted({round(axis.x(t_s), 1) for t_s in times_s}))
    path = f'<path class="mark {colour}" d="{marks}" {attributes}/>'
    return _svg(name, _LANE_HEIGHT, axis.grid(_LANE_HEIGHT) + path)


def path(points: Points, form: str = "line") -> str:
    """Return SVG path data of a "line" through `points`, of an "area" inside them, or of "dots": lines of length 0,
    whose round ends make dots as wide as the line."""
    if form == "dots" or len(points) == 1:
        return "".join(f"M{x:.2f} {y:.2f}h0" for x, y in points)
    return "M" + "L".join(f"{x:.2f} {y:.2f}" for x, y in points) + "z" * (form == "area")


def _round_up(value: float) -> float:
    """Round up to two digits that are easily read: 1, 1.2, 1.5, 2, 2.5, 3, 4, 5, 6 or 8 times a power of ten."""
    power = 10.0 ** math.floor(math.log10(value)) if value > 0 else 1.0
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


def _svg(label: str, height: float, content: str) -> str:
    return (
        f'<svg role="img" aria-label="{escape(label)}" viewBox="0 0 {WIDTH:g} {height:g}" preserveAspectRatio="none">'
        f"{content}</svg>"
    )
