"""The estimate of a flight as a picture: recall against charge, and the projected memory of the map (figure 5.7 of the
thesis) beside the RAM of the boards that edgevpr knows (needs matplotlib, extra `plots`)."""

import math
from collections import defaultdict
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from edgevpr.core.text import figure
from edgevpr.power.boards import board_names, load_board
from edgevpr.runtime.preflight.estimate import Estimate

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_FITS, _FITS_NOT = "C0", "C3"
_SIZE_PT2_PER_MB = 0.3  # of the area of a point
_LINE = {"color": "0.45", "linewidth": 1, "linestyle": "--"}
_FAR_PT = (8, 14, 22, 32, 44, 58, 74, 92, 112, 134)  # how far from its point a label may be
_WAYS = 24


def plot(estimate: Estimate, path: Path) -> None:
    """Draw both panels to `path`; techniques that do not fit are red, those that another one beats are pale."""
    rows = 0.24 * max(14, len(estimate.techniques)) + 1.6
    drawn = figure(14.5, rows)
    found, projected = drawn.subplots(1, 2)
    _found(found, estimate)
    _projected(projected, estimate)
    # Labels are placed around what is really drawn, so the layout must be final first.
    drawn.draw_without_rendering()
    measured = [row for row in estimate.techniques if row.accuracy]
    _label(found, [(row.technique, row.flight_marginal_mah, row.accuracy.recall_at_1) for row in measured])
    drawn.savefig(path, dpi=100)


def _found(axes: "Axes", estimate: Estimate) -> None:
    """Draw recall against charge: what is found beside what it costs, the size of a point by its RAM."""
    from matplotlib.lines import Line2D

    plan, rows = estimate.plan, [row for row in estimate.techniques if row.accuracy]
    for row in rows:
        trusted = row.accuracy.is_trusted
        axes.scatter(
            row.flight_marginal_mah,
            row.accuracy.recall_at_1,
            s=_SIZE_PT2_PER_MB * row.process_ram_mb,
            marker="o" if trusted else "X",
            color=_FITS if row.fits else _FITS_NOT,
            alpha=1.0 if row.on_front else 0.3,
            linewidths=0,
        )
    front = sorted((row.flight_marginal_mah, row.accuracy.recall_at_1) for row in rows if row.on_front)
    if front:
        axes.step(*zip(*front, strict=True), where="post", color=_FITS, linewidth=1, alpha=0.6)
    for row in rows:
        if row.technique == estimate.recommended:
            at = row.flight_marginal_mah, row.accuracy.recall_at_1
            axes.plot(*at, "o", markersize=17, markerfacecolor="none", markeredgecolor="k")
    idle_mah = estimate.techniques[0].flight_mah - estimate.techniques[0].flight_marginal_mah if rows else 0.0
    camera = "looking down" if plan.camera == "nadir" else "looking ahead"
    axes.set(
        xscale="log",
        ylim=(0, 1.08),
        xlabel=f"mAh that recognising takes in {plan.flight_min:g} min"
        + (f" (the idle board takes {idle_mah:.0f} more)" if idle_mah else ""),
        ylabel=f"recall@1 on image sets, {camera}",
        title=f"{estimate.title}: {plan.places} places at {plan.rate_hz:g} Hz",
    )
    handles = [
        Line2D([], [], linestyle="", marker=marker, color=colour, alpha=alpha, markersize=6, label=label)
        for marker, colour, alpha, label in (
            ("o", _FITS, 1.0, "fits: nothing else finds as much for less"),
            ("o", _FITS, 0.3, "fits, and another finds more for less"),
            ("o", _FITS_NOT, 0.3, "does not fit"),
            ("X", "0.4", 1.0, "has accepted wrong places: never chosen by itself"),
        )
    ]
    if estimate.recommended:
        ring = {"markerfacecolor": "none", "markeredgecolor": "k", "markersize": 9}
        handles.append(Line2D([], [], linestyle="", marker="o", label="recommended", **ring))
    sizes = "area of a point: RAM"
    axes.legend(handles=handles, fontsize=7, loc="lower right", framealpha=0.9, title=sizes, title_fontsize=7)
    pack_mah = plan.pack.capacity_mah - idle_mah
    if pack_mah > 0:
        axes.axvline(pack_mah, **_LINE)
        axes.annotate(
            f"pack, less idle: {pack_mah:.0f} mAh", (pack_mah, 0.98), (-10, 0), xycoords=axes.get_xaxis_transform(),
            textcoords="offset points", fontsize=8, color="0.3", rotation=90, va="top",
        )  # fmt: skip
    low, high = axes.get_xlim()
    axes.set_xlim(low / 2, high * 2)
    axes.grid(alpha=0.3)


def _projected(axes: "Axes", estimate: Estimate) -> None:
    rows = list(reversed(estimate.techniques))
    values = [row.map_ram_mb for row in rows]
    axes.barh(range(len(rows)), values, color=[_FITS if row.fits else _FITS_NOT for row in rows], height=0.6)
    axes.set_yticks(range(len(rows)), [row.technique for row in rows], fontsize=8)
    lines = defaultdict(list)
    for name in board_names():
        lines[load_board(name).ram_mb].append(name)
    axes.set_xscale("log")
    axes.set_xlim(min([*values, 1.0]) / 3, max([*values, *lines]) * 4)
    axes.set_ylim(-0.7, len(rows) - 0.3)
    for place, value in enumerate(values):
        axes.annotate(
            f"{value:.3g}" if value < 100 else f"{value:.0f}",
            (value, place),
            (3, 0),
            textcoords="offset points",
            fontsize=7,
            va="center",
        )
    for ram_mb, names in lines.items():
        axes.axvline(ram_mb, **_LINE)
        axes.annotate(
            ", ".join(names), (ram_mb, 1), (-2, 2), xycoords=axes.get_xaxis_transform(),
            textcoords="offset points", fontsize=7, color="0.3", rotation=35,
        )  # fmt: skip
    axes.set_xlabel(f"MB of RAM that a map of {estimate.plan.places} places takes; lines: RAM of the boards")
    axes.set_title("Projected memory (thesis, figure 5.7)", loc="left")
    axes.grid(alpha=0.3, axis="x")


def _label(axes: "Axes", points: Sequence[tuple[str, float, float]]) -> None:
    """Write each name as near to its point as it covers no other name, point or edge; a name far away gets a line to
    its point."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.transforms import Bbox

    renderer = FigureCanvasAgg(axes.figure).get_renderer()
    frame = axes.get_window_extent(renderer)
    px = axes.figure.dpi / 72
    centres = axes.transData.transform([(x, y) for _, x, y in points])
    axes.set(xlim=axes.get_xlim(), ylim=axes.get_ylim())  # the lines to points must not change the limits
    taken = [Bbox.from_bounds(x - 3 * px, y - 3 * px, 6 * px, 6 * px) for x, y in centres]
    taken += [text.get_window_extent(renderer) for text in axes.texts]
    for (name, x, y), (at_x, at_y) in zip(points, centres, strict=True):
        text = axes.annotate(name, (x, y), (0, 0), textcoords="offset points", fontsize=8)
        size = text.get_window_extent(renderer)
        best = None
        for dx, dy, near in _places(size.width / px, size.height / px):
            box = Bbox.from_bounds(at_x + dx * px, at_y + dy * px, size.width, size.height)
            inside = frame.x0 < box.x0 and box.x1 < frame.x1 and frame.y0 < box.y0 and box.y1 < frame.y1
            covered = sum(box.overlaps(other) for other in taken) + (0 if inside else len(points))
            if best is None or covered < best[0]:
                best = (covered, dx, dy, box, near)
            if not covered:
                break
        _, dx, dy, box, near = best
        text.set_position((dx, dy))
        taken.append(box)
        if not near:
            edge = (min(max(at_x, box.x0), box.x1), min(max(at_y, box.y0), box.y1))
            line = axes.transData.inverted().transform([(at_x, at_y), edge])
            axes.plot(*line.T, color="0.6", linewidth=0.6, zorder=1)


def _places(width_pt: float, height_pt: float) -> Iterator[tuple[float, float, bool]]:
    """Yield lower left corners of a label, in points (1/72 inch) from the point that it names, and whether that is
    near: first to the right, then around and farther away."""
    for far in _FAR_PT:
        for way in range(_WAYS):
            turn = 2 * math.pi * way / _WAYS
            across, up = math.cos(turn), math.sin(turn)
            # The near edge is `far` away, whichever side the label is on.
            yield across * far + (across - 1) / 2 * width_pt, up * far + (up - 1) / 2 * height_pt, far == _FAR_PT[0]
