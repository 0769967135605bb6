"""The estimate of a flight as a picture: recall against charge, and the projected memory of the map (figure 5.7 of the
thesis) beside the RAM of the boards that edgevpr knows (needs matplotlib, extra `plots`)."""

from pathlib import Path
from typing import TYPE_CHECKING

from edgevpr.core.text import figure
from edgevpr.power.boards import board_names, load_board
from edgevpr.runtime.preflight.estimate import FlightEstimate

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_FITS, _FITS_NOT = "C0", "C3"


def plot(estimate: FlightEstimate, path: Path) -> None:
    """Draw both panels to `path`; techniques that do not fit are red, those that another one beats are pale."""
    drawn = figure(14.5, 0.24 * max(14, len(estimate.techniques)) + 1.6)
    recall, memory = drawn.subplots(1, 2)
    _draw_recall(recall, estimate)
    _draw_memory(memory, estimate)
    drawn.savefig(path, dpi=100)


def _draw_recall(axes: "Axes", estimate: FlightEstimate) -> None:
    """Draw what is found beside what it costs: a cross where wrong places were accepted, a ring around what is
    recommended, a line through the front."""
    plan, front = estimate.plan, []
    for row in estimate.techniques:
        if row.accuracy is None:
            continue
        at = row.flight_marginal_mah, row.accuracy.recall_at_1
        colour, alpha = _FITS if row.fits else _FITS_NOT, 1.0 if row.on_front else 0.3
        axes.scatter(*at, marker="o" if row.accuracy.is_trusted else "X", linewidths=0, color=colour, alpha=alpha)
        axes.annotate(row.technique, at, (4, 3), textcoords="offset points", fontsize=7, color=colour)
        if row.technique == estimate.recommended:
            axes.scatter(*at, s=180, facecolors="none", edgecolors="k", label=f"recommended: {row.technique}")
        if row.on_front:
            front.append(at)
    axes.step([mah for mah, _ in sorted(front)], [found for _, found in sorted(front)], where="post", color=_FITS)
    idle_mah = next((row.flight_mah - row.flight_marginal_mah for row in estimate.techniques), 0.0)
    if plan.pack.capacity_mah > idle_mah:
        left_mah = plan.pack.capacity_mah - idle_mah
        axes.axvline(left_mah, color="0.45", linestyle="--", label=f"pack, less idle: {left_mah:.0f} mAh")
        axes.legend(fontsize=7, loc="lower right", title="blue fits, red does not; X accepted wrong places")
    axes.set(
        xscale="log",
        ylim=(0, 1.08),
        xlabel=f"mAh that recognising takes in {plan.flight_min:g} min (the idle board takes {idle_mah:.0f} more)",
        ylabel=f"recall@1 on image sets, {'looking down' if plan.camera == 'nadir' else 'looking ahead'}",
        title=f"{estimate.title}: {plan.places} places at {plan.rate_hz:g} Hz",
    )


def _draw_memory(axes: "Axes", estimate: FlightEstimate) -> None:
    """Draw the RAM that the map takes with each technique, and lines for the RAM of the boards."""
    rows = estimate.techniques[::-1]
    bars = axes.barh(
        [row.technique for row in rows],
        [row.map_ram_mb for row in rows],
        color=[_FITS if row.fits else _FITS_NOT for row in rows],
    )
    axes.bar_label(bars, fmt="%.3g", fontsize=7, padding=3)
    boards: dict[float, list[str]] = {}
    for name in board_names():
        boards.setdefault(load_board(name).ram_mb, []).append(name)
    for ram_mb, names in boards.items():
        axes.axvline(ram_mb, color="0.45", linestyle="--", linewidth=1)
        axes.annotate(", ".join(names), (ram_mb, 1), xycoords=("data", "axes fraction"), fontsize=7, rotation=35)
    axes.set_xscale("log")
    axes.set_xlabel(f"MB of RAM that a map of {estimate.plan.places} places takes; lines: RAM of the boards")
    axes.set_title("Projected memory (thesis, figure 5.7)", loc="left")
