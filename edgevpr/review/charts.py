"""Charts over the time of a flight, and lanes of what became of each query."""

from collections.abc import Iterator, Sequence
from html import escape
from itertools import pairwise

from edgevpr.review import svg as charts
from edgevpr.review.svg import Axis, Points, Series, below, grid, svg

_STEPS_S = (1, 2, 5, 10, 15, 30, 60, 120, 300, 600, 900, 1800, 3600, 7200, 14400, 28800, 86400)
_MOST_TICKS = 6
_GAP, _LEAST_GAP_S = 5.0, 3.0  # a line is broken where a point is missing for so many usual steps, and so long
_LAST_SAID = 0.97  # a text beyond that would stand out of the page


def chart(title: str, unit: str, series: Sequence[Series], span_s: float, top: float = 0.0) -> str:
    """Draw series over time, from 0 to `span_s` (see `pages.charts.chart`)."""
    return charts.chart(title, unit, series, _times(span_s), top, _ways)


def lanes(rows: Sequence[tuple[str, str, Sequence[float]]], span_s: float) -> str:
    """Draw one lane for each (name, colour, times): a mark at every time, and how many there are."""
    axis, drawn = _times(span_s), []
    for name, colour, times in rows:
        marks = "".join(f"M{x:g} 0v20" for x in sorted({round(charts.WIDE * axis.across(t_s), 1) for t_s in times}))
        lines = grid(axis, 20)
        picture = svg(f"{name}: {len(times)}", 20, f'{lines}<path class="mark {colour}" d="{marks}"/>')
        drawn.append(f"<span>{escape(name)} <b>{len(times)}</b></span>{picture}")
    return f'<div class="lanes">{"".join(drawn)}<span></span>{below(axis)}</div>'


def clock(t_s: float) -> str:
    """Return a time of the flight as minutes and seconds, from an hour on with the hours: 1:02:03."""
    minutes, seconds = divmod(round(t_s), 60)
    if minutes < 60:
        return f"{minutes}:{seconds:02d}"
    return f"{minutes // 60}:{minutes % 60:02d}:{seconds:02d}"


def _times(span_s: float) -> Axis:
    step = next((each for each in _STEPS_S if span_s / each <= _MOST_TICKS), span_s / _MOST_TICKS)
    ticks = [count * step for count in range(int(span_s / step) + 1)] if step else [0.0]
    last = _LAST_SAID * span_s
    return Axis(0.0, span_s, [(t_s, clock(t_s) if t_s <= last or not t_s else "") for t_s in ticks])


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
