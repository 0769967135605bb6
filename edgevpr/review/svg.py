"""Charts as SVG and HTML that follow the width and the colours of the page, without a script.

The drawing stretches to the width that there is, and its lines and dots keep theirs; whatever is written stands beside
it, so that it stays readable on a phone.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from html import escape

Points = Sequence[tuple[float, float]]

UNKNOWN = "–"

WIDE, HIGH = 1000.0, 100.0
_MOST_POINTS = 1200  # of a line: more than there are pixels
_LAST = 0.97  # a text in the middle of a point further right would stand out of the page
_TAG_WIDE, _TAG_HIGH = 0.035, 0.14  # of a chart: room for the number of a point


@dataclass(frozen=True, slots=True)
class Series:
    """One line or, with `are_dots`, the dots of a chart: its name, the class that colours it, points (x, value) in the
    order of x."""

    name: str
    colour: str
    points: Points
    are_dots: bool = False


@dataclass(frozen=True, slots=True)
class Axis:
    """The axis to the right, from `first` to `last`, with the texts that stand below it, each at its value."""

    first: float
    last: float
    ticks: Sequence[tuple[float, str]]

    def across(self, x: float) -> float:
        """Return where a value lies, from 0 (left) to 1."""
        return min(max((x - self.first) / ((self.last - self.first) or 1.0), 0.0), 1.0)


def whole(points: Points) -> Iterable[Points]:
    """Leave a line in one part."""
    return [points]


def chart(
    title: str,
    unit: str,
    series: Sequence[Series],
    axis: Axis,
    top: float = 0.0,
    parts: Callable[[Points], Iterable[Points]] = whole,
) -> str:
    """Draw series over an axis. The axis of the values reaches from 0 to the highest, and to `top` at least; a series
    without points is left out, and a chart without any is empty (""). `parts` breaks lines."""
    series = [each for each in series if each.points]
    if not series:
        return ""
    highest = nice(max(top, *(value for each in series for _, value in each.points)))
    drawn = "".join(_drawn(each, axis, highest, parts) for each in series)
    legend = "".join(f'<span class="key {each.colour}">{escape(each.name)}</span>' for each in series if each.name)
    return _framed(title, unit, legend, highest, axis, svg(_said(title, unit), HIGH, grid(axis, HIGH) + drawn))


def scatter(title: str, unit: str, points: Sequence[tuple[float, float, str, str]], axis: Axis, top: float) -> str:
    """Draw points (x, value, its short text, the class that colours it), values from 0 to `top`. Texts that would lie
    over each other are moved to the right."""
    taken: list[tuple[float, float]] = []
    marks = tags = ""
    for x, value, said, colour in points:
        left, above = axis.across(x), 1 - min(max(value / top, 0.0), 1.0)
        marks += f'<path class="dots {colour}" d="{dots([(WIDE * left, HIGH * above)])}"/>'
        tag = left
        while any(abs(tag - other) < _TAG_WIDE and abs(above - at) < _TAG_HIGH for other, at in taken):
            tag += _TAG_WIDE
        taken.append((tag, above))
        tags += f'<span class="tag {colour}" style="left:{100 * tag:.1f}%;top:{100 * above:.1f}%">{escape(said)}</span>'
    drawn = svg(_said(title, unit), HIGH, grid(axis, HIGH) + marks)
    return _framed(title, unit, "", top, axis, f'<div class="tagged">{drawn}{tags}</div>') if points else ""


def dots(points: Points) -> str:
    """Return the path of dots: lines without length, which a round end makes into dots of any size."""
    return "".join(f"M{x:.1f} {y:.1f}h0" for x, y in points)


def way(points: Points) -> str:
    """Return the path of a line through points; a single one is a dot."""
    return "M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in points) + ("h0" if len(points) == 1 else "")


def nice(value: float) -> float:
    """Round up to two digits that are easily read: 1, 1.2, 1.5, 2, 2.5, 3, 4, 5, 6 or 8 times a power of ten."""
    if value <= 0:
        return 1.0
    power = 10.0 ** (len(f"{value:.0f}") - 1 if value >= 1 else -_zeros(value))
    return next(step * power for step in (1, 1.2, 1.5, 2, 2.5, 3, 4, 5, 6, 8, 10, 12) if step * power >= value * 0.999)


def figure(value: float | None, unit: str = "") -> str:
    """Return a number with three digits that say something, and its unit; a dash where it is unknown."""
    if value is None:
        return UNKNOWN
    shown = f"{value:.0f}" if abs(value) >= 100 else f"{value:.3g}"
    return f"{shown} {unit}".strip()


def _drawn(series: Series, axis: Axis, highest: float, parts: Callable[[Points], Iterable[Points]]) -> str:
    drawn = [series.points] if series.are_dots else parts(_thinned(series.points))
    path = dots if series.are_dots else way
    said = "".join(
        path([(WIDE * axis.across(x), HIGH * (1 - max(value, 0.0) / highest)) for x, value in part]) for part in drawn
    )
    return f'<path class="{"dots" if series.are_dots else "line"} {series.colour}" d="{said}"/>'


def _zeros(value: float) -> int:
    zeros = 1
    while value * 10**zeros < 1 and zeros < 12:
        zeros += 1
    return zeros


def svg(said: str, high: float, content: str) -> str:
    """Return a drawing, `WIDE` by `high` of its own units, that stretches to the room there is."""
    return (
        f'<svg role="img" aria-label="{escape(said)}" viewBox="0 0 {WIDE:g} {high:g}" preserveAspectRatio="none">'
        f"{content}</svg>"
    )


def grid(axis: Axis, high: float) -> str:
    """Return the path of the lines above the texts of an axis."""
    lines = "".join(f"M{WIDE * axis.across(x):.1f} 0v{high:g}" for x, _ in axis.ticks)
    return f'<path class="grid" d="{lines}M0 {high:g}h{WIDE:g}"/>'


def below(axis: Axis) -> str:
    """Return the texts of an axis."""
    said = ""
    for x, each in axis.ticks:
        left = axis.across(x)
        last = " class=last" if left > _LAST else ""
        said += f'<span{last} style="left:{100 * left:.1f}%">{escape(each)}</span>' if each else ""
    return f'<div class="times">{said}</div>'


def _framed(title: str, unit: str, legend: str, highest: float, axis: Axis, drawn: str) -> str:
    return (
        f'<figure class="chart"><figcaption><b>{escape(title)}</b> {escape(unit)} {legend}</figcaption>'
        f'<div class="plot"><div class="scale"><span>{figure(highest)}</span><span>0</span></div>'
        f"<div>{drawn}{below(axis)}</div></div></figure>"
    )


def _said(title: str, unit: str) -> str:
    return f"{title}, {unit}" if unit else title


def _thinned(points: Points) -> Points:
    """Return all points or, of more than can be seen, the lowest and the highest of each short part."""
    if len(points) <= _MOST_POINTS:
        return points
    step = -(-2 * len(points) // _MOST_POINTS)
    kept = []
    for first in range(0, len(points), step):
        several = points[first : first + step]
        kept += sorted({min(several, key=lambda each: each[1]), max(several, key=lambda each: each[1])})
    return kept
