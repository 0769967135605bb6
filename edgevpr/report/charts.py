"""Charts as SVG and HTML that follow the width and the colours of the page, without a script.

The drawing stretches to the width that there is, and its lines and dots keep theirs; whatever is written stands beside
it, so that it stays readable on a phone.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from html import escape
from itertools import pairwise

Points = Sequence[tuple[float, float]]

UNKNOWN = "–"

_WIDE, _HIGH = 1000.0, 100.0
_MOST_POINTS = 1200  # of a line: more than there are pixels
_STEPS_S = (1, 2, 5, 10, 15, 30, 60, 120, 300, 600, 900, 1800, 3600, 7200, 14400, 28800, 86400)
_MOST_TICKS = 6
_GAP, _LEAST_GAP_S = 5.0, 3.0  # a line is broken where a point is missing for so many usual steps, and so long


@dataclass(frozen=True, slots=True)
class Series:
    """One line or, with `are_dots`, the dots of a chart: its name, the class that colours it, points (seconds, value)
    in the order of time."""

    name: str
    colour: str
    points: Points
    are_dots: bool = False


def chart(title: str, unit: str, series: Sequence[Series], span_s: float, top: float = 0.0) -> str:
    """Draw series over time, from 0 to `span_s`. The axis reaches from 0 to the highest value, and to `top` at least; a
    series without points is left out, and a chart without any is empty ("")."""
    series = [each for each in series if each.points]
    if not series:
        return ""
    highest = nice(max(top, *(value for each in series for _, value in each.points)))
    drawn = "".join(_drawn(each, span_s, highest) for each in series)
    legend = "".join(f'<span class="key {each.colour}">{escape(each.name)}</span>' for each in series if each.name)
    said = f"{title}, {unit}" if unit else title
    return (
        f'<figure class="chart"><figcaption><b>{escape(title)}</b> {escape(unit)} {legend}</figcaption>'
        f'<div class="plot"><div class="scale"><span>{figure(highest)}</span><span>0</span></div>'
        f"<div>{_svg(said, _HIGH, _grid(span_s, _HIGH) + drawn)}{_times(span_s)}</div></div></figure>"
    )


def lanes(rows: Sequence[tuple[str, str, Sequence[float]]], span_s: float) -> str:
    """Draw one lane for each (name, colour, times): a mark at every time, and how many there are."""
    drawn = []
    for name, colour, times in rows:
        marks = "".join(f"M{x:g} 0v20" for x in sorted({round(_across(t_s, span_s), 1) for t_s in times}))
        grid = _grid(span_s, 20)
        picture = _svg(f"{name}: {len(times)}", 20, f'{grid}<path class="mark {colour}" d="{marks}"/>')
        drawn.append(f"<span>{escape(name)} <b>{len(times)}</b></span>{picture}")
    return f'<div class="lanes">{"".join(drawn)}<span></span>{_times(span_s)}</div>'


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


def clock(t_s: float) -> str:
    """Return a time of the flight as minutes and seconds, from an hour on with the hours: 1:02:03."""
    minutes, seconds = divmod(round(t_s), 60)
    if minutes < 60:
        return f"{minutes}:{seconds:02d}"
    return f"{minutes // 60}:{minutes % 60:02d}:{seconds:02d}"


def _drawn(series: Series, span_s: float, highest: float) -> str:
    parts = [series.points] if series.are_dots else _ways(_thinned(series.points))
    path = dots if series.are_dots else way
    said = "".join(
        path([(_across(t_s, span_s), _HIGH * (1 - max(value, 0.0) / highest)) for t_s, value in part]) for part in parts
    )
    return f'<path class="{"dots" if series.are_dots else "line"} {series.colour}" d="{said}"/>'


def _zeros(value: float) -> int:
    zeros = 1
    while value * 10**zeros < 1 and zeros < 12:
        zeros += 1
    return zeros


def _across(t_s: float, span_s: float) -> float:
    return _WIDE * min(max(t_s / (span_s or 1.0), 0.0), 1.0)


def _svg(said: str, high: float, content: str) -> str:
    return (
        f'<svg role="img" aria-label="{escape(said)}" viewBox="0 0 {_WIDE:g} {high:g}" preserveAspectRatio="none">'
        f"{content}</svg>"
    )


def _ticks(span_s: float) -> list[float]:
    step = next((each for each in _STEPS_S if span_s / each <= _MOST_TICKS), span_s / _MOST_TICKS)
    return [count * step for count in range(int(span_s / step) + 1)]


def _grid(span_s: float, high: float) -> str:
    lines = "".join(f"M{_across(t_s, span_s):.1f} 0v{high:g}" for t_s in _ticks(span_s))
    return f'<path class="grid" d="{lines}M0 {high:g}h{_WIDE:g}"/>'


def _times(span_s: float) -> str:
    ticks = [
        f'<span style="left:{_across(t_s, span_s) / 10:.1f}%">{clock(t_s)}</span>'
        for t_s in _ticks(span_s)
        if t_s <= 0.97 * span_s or not t_s
    ]
    return f'<div class="times">{"".join(ticks)}</div>'


def _ways(points: Points) -> Iterator[Points]:
    """Yield the parts of a line, which is broken where nothing is known for longer than usual."""
    steps_s = sorted(after[0] - before[0] for before, after in pairwise(points))
    most_s = max(_LEAST_GAP_S, _GAP * steps_s[len(steps_s) // 2]) if steps_s else 0.0
    first = 0
    for at, (before, after) in enumerate(pairwise(points), start=1):
        if after[0] - before[0] > most_s:
            yield points[first:at]
            first = at
    yield points[first:]


def _thinned(points: Points) -> Points:
    """Return all points or, of more than can be seen, the lowest and the highest of each short time."""
    if len(points) <= _MOST_POINTS:
        return points
    step = -(-2 * len(points) // _MOST_POINTS)
    kept = []
    for first in range(0, len(points), step):
        several = points[first : first + step]
        kept += sorted({min(several, key=lambda each: each[1]), max(several, key=lambda each: each[1])})
    return kept
