"""The estimate of a flight as a picture: recall against charge (needs matplotlib, extra `plots`)."""

from pathlib import Path

from edgevpr.core.text import figure
from edgevpr.runtime.preflight.estimate import FlightEstimate


def plot(estimate: FlightEstimate, path: Path) -> None:
    """Draw what each technique finds beside what it costs: blue where it fits, else red, and pale where another one
    beats it; a cross where wrong places were accepted, a ring around what is recommended, a line through the front."""
    drawn = figure(9, 6)
    axes = drawn.add_subplot()
    plan, front = estimate.plan, []
    for row in estimate.techniques:
        if row.accuracy is None:
            continue
        at = row.flight_marginal_mah, row.accuracy.recall_at_1
        colour, alpha = "C0" if row.fits else "C3", 1.0 if row.on_front else 0.3
        axes.scatter(*at, marker="o" if row.accuracy.is_trusted else "X", linewidths=0, color=colour, alpha=alpha)
        axes.annotate(row.technique, at, (4, 3), textcoords="offset points", fontsize=7, color=colour)
        if row.technique == estimate.recommended:
            axes.scatter(*at, s=180, facecolors="none", edgecolors="k")
        if row.on_front:
            front.append(at)
    axes.step([mah for mah, _ in sorted(front)], [recall for _, recall in sorted(front)], where="post", color="C0")
    idle_mah = next((row.flight_mah - row.flight_marginal_mah for row in estimate.techniques), 0.0)
    camera = "looking down" if plan.camera == "nadir" else "looking ahead"
    pack = f"idle, the board takes {idle_mah:.0f} of {plan.pack.capacity_mah}"
    axes.set(
        xscale="log",
        xlabel=f"mAh that recognising takes in {plan.flight_min:g} min ({pack})",
        ylabel=f"recall@1 on image sets, {camera} (X: accepted wrong places)",
        title=f"{estimate.title}: {plan.places} places at {plan.rate_hz:g} Hz",
    )
    drawn.savefig(path, dpi=100)
