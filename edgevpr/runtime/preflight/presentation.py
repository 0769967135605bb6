"""Estimates and stored figures for people: tables of at most 120 columns with a line per technique, notes, and a
picture (which needs matplotlib, extra `plots`)."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from edgevpr.core.text import aligned, figure, wrapped
from edgevpr.runtime.preflight.estimate import FlightEstimate, TechniqueEstimate
from edgevpr.runtime.preflight.probe import TechniqueCosts
from edgevpr.runtime.preflight.stored import StoredFigures

# The columns of each table: (heading, format of a cell), where {0} is the row.
_NEEDS = (
    ("technique", "{0.technique}"), ("fits", "{fits}"), ("B/place", "{0.ram_bytes_per_place}"),
    ("map MB", "{0.map_ram_mb:.1f}"), ("disk MB", "{0.map_disk_mb:.1f}"), ("peak MB", "{0.process_ram_mb:.0f}"),
    ("t_e s", "{0.t_encode_s:.3f}"), ("t_m s", "{0.t_match_s:.3f}"), ("U_e", "{0.u_encode:.2f}"),
    ("U_m", "{0.u_match:.2f}"), ("Hz", "{0.reachable_hz:.3g}"),
)  # fmt: skip
_FINDS = (
    ("technique", "{0.technique}"), ("fits", "{fits}"), ("recall@1", "{0.accuracy.recall_at_1:.2f}"),
    ("accepted", "{0.accuracy.accepted} of {0.accuracy.asked}"), ("wrong", "{0.accuracy.accepted_elsewhere}{beside}"),
    ("sets", "{0.accuracy.sets}"), ("queries", "{0.accuracy.queries}"), ("chosen by itself", "{chosen}"),
)  # fmt: skip
_DRAWS = (
    ("technique", "{0.technique}"), ("mAh/query", "{0.query_mah:.4f}"), ("marginal", "{0.query_marginal_mah:.4f}"),
    ("mAh/flight", "{0.flight_mah:.1f}"), ("marginal", "{0.flight_marginal_mah:.2f}"),
    ("of pack", "{0.flight_pack_frac:.1%}"),
)  # fmt: skip
_LOSES = (("min lost", "{0.lost_min:.2f}"), ("marginal", "{0.lost_marginal_min:.3f}"))
_MEASURED = (
    ("technique", "{label}"), ("t_e ms", "{encode_ms:.2f}"), ("CPU ms", "{encode_cpu_ms:.2f}"),
    ("t_m us", "{match_us:.3f}"), ("CPU us", "{match_cpu_us:.3f}"), ("scan us", "{scan_us}"),
    ("peak MB", "{0.process_mb:.1f}"), ("encode MB", "{encode_mb}"), ("RAM B", "{0.ram_bytes_per_place}"),
    ("disk B", "{0.disk_bytes_per_place}"),
)  # fmt: skip
_Columns = Sequence[tuple[str, str]]


def format_table(estimate: FlightEstimate) -> str:
    """Format an estimate as text: tables of what each technique needs, finds and draws, why techniques do not fit,
    notes, and the recommended technique."""
    plan = estimate.plan
    since = f" on {estimate.measured_on}" if estimate.measured_on else ""
    hovers = f", hovering at {plan.hover_w:g} W" if plan.hover_w else ""
    heading = (
        f"{estimate.title}: {plan.places} places, {plan.rate_hz:g} Hz, {plan.flight_min:g} min, {plan.pack.cells}S"
        f"{plan.pack.capacity_mah} at {plan.regulator_efficiency:.0%} regulator efficiency{hovers}; times measured"
        f"{since}" + {"measured": "", "scaled": ", scaled", "unscaled": " here, unscaled"}[estimate.times]
    )
    missing = [[name, "n/a"] for name in estimate.unusable]
    rows = estimate.techniques
    needs = aligned([_headings(_NEEDS), *(_cells(_NEEDS, row) for row in rows), *missing], left=2)
    finds = aligned([_headings(_FINDS), *map(_finds, rows)], left=2)
    columns = _DRAWS + (_LOSES if plan.hover_w else ())
    draws = aligned([_headings(columns), *(_cells(columns, row) for row in rows)])
    notes = []
    for row in rows:
        if not row.fits:
            remedy = f"; it would fit {', or '.join(row.remedies)}" if row.remedies else ""
            notes.append(f"{row.technique} does not fit: {' and '.join(row.shortfalls)}{remedy}.")
    notes += [*_unusable(estimate.unusable), *(f"Weights of {weights}." for weights in estimate.weights)]
    notes += estimate.notes
    tried_now = [row.technique for row in estimate.techniques if not row.measured]
    if estimate.measured_on and tried_now:
        notes.append(f"Not among the stored figures, and tried now: {', '.join(tried_now)}.")
    notes.append(f"Recommended: {estimate.reason}")
    lines = (line for note in notes for line in wrapped(note))
    return "\n".join([heading, "", *needs, "", *finds, "", *draws, "", *lines])


def format_stored(figures: StoredFigures) -> str:
    """Format the figures stored on this machine, with a line for each technique and form. The time of matching is that
    of one place: of its full comparison if the technique scans all places before, else of the scan."""
    machine, score = figures.identity, figures.score
    unusable = {trial.label: trial.problem for trial in figures.trials if trial.problem}
    rows = [_measured(trial.label, trial.costs) for trial in figures.trials if trial.costs]
    return "\n".join(
        [
            f"{machine['machine']}, {machine['cores']} cores, {machine['RAM in MB']} MB: measured on {figures.date}, "
            f"{figures.pictures}",
            *aligned([_headings(_MEASURED), *rows, *([name, "n/a"] for name in unusable)]),
            "t_m, scan, RAM B and disk B are of one place; peak MB is the process, encode MB what encoding adds.",
            *(line for sentence in _unusable(unusable) for line in wrapped(sentence)),
            f"Beside one core of the reference: products {score.products:g}, passes {score.passes:g}, all cores "
            f"{score.multi:g} (single {score.single:g}).",
        ]
    )


def plot(estimate: FlightEstimate, path: Path) -> None:
    """Draw the recall@1 of each technique against its charge, and save the picture. Blue: fits. Red: does not fit.
    Pale: not on the front. Cross: has accepted wrong places. Ring: recommended. The line joins the front."""
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


def _unusable(unusable: Mapping[str, str]) -> list[str]:
    """Return a sentence for each reason, with the names of all techniques that cannot be used for that reason."""
    reasons = {why: [name for name in unusable if unusable[name] == why] for why in unusable.values()}
    return [f"{', '.join(names)} cannot be used: {why}" for why, names in reasons.items()]


def _headings(columns: _Columns) -> list[str]:
    return [heading for heading, _ in columns]


def _cells(columns: _Columns, row: TechniqueEstimate, **more: str) -> list[str]:
    return [cell.format(row, fits="yes" if row.fits else "no", **more) for _, cell in columns]


def _finds(row: TechniqueEstimate) -> list[str]:
    if row.accuracy is None:
        return [*_cells(_FINDS[:2], row), "?", "?", "?", "", "", "never measured"]
    beside = row.accuracy.accepted_wrong - row.accuracy.accepted_elsewhere
    if not row.fits:
        chosen = ""
    elif row.on_front:
        chosen = "yes"
    elif not row.accuracy.is_trusted:
        chosen = "wrong places"
    else:
        chosen = "needs a sequence" if row.objection else "another is better"
    return _cells(_FINDS, row, beside=f" (+{beside} beside)" if beside else "", chosen=chosen)


def _measured(label: str, costs: TechniqueCosts) -> list[str]:
    figures = {
        "label": label,
        "encode_ms": 1e3 * costs.encode.wall_s,
        "encode_cpu_ms": 1e3 * costs.encode.cpu_s,
        "match_us": 1e6 * costs.match_per_place.wall_s,
        "match_cpu_us": 1e6 * costs.match_per_place.cpu_s,
        "scan_us": f"{1e6 * costs.scan_per_place.wall_s:.3f}" if costs.candidates else "-",
        "encode_mb": "-" if costs.encode_mb is None else f"{costs.encode_mb:.1f}",
    }
    return [cell.format(costs, **figures) for _, cell in _MEASURED]
