"""Estimates for people: tables of at most 120 columns with a line per technique, notes, and a
picture (which needs matplotlib, extra `plots`)."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from edgevpr.core.text import aligned, figure, wrapped
from edgevpr.runtime.preflight.estimate import FlightEstimate, TechniqueEstimate

# The columns of each table: (heading, format of a cell), where {0} is a TechniqueEstimate.
_NEEDS = (
    ("technique", "{0.option.label}"), ("fits", "{fits}"), ("B/place", "{0.option.costs.ram_bytes_per_place}"),
    ("map MB", "{0.option.fit.map_ram_mb:.1f}"), ("disk MB", "{0.option.fit.map_disk_mb:.1f}"),
    ("peak MB", "{0.option.fit.process_ram_mb:.0f}"), ("t_e s", "{0.query.t_encode_s:.3f}"),
    ("t_m s", "{0.query.t_match_s:.3f}"), ("U_e", "{0.query.u_encode:.2f}"), ("U_m", "{0.query.u_match:.2f}"),
    ("Hz", "{0.option.fit.reachable_hz:.3g}"),
)  # fmt: skip
_NAME = _NEEDS[:2]
_FINDS = (
    *_NAME, ("recall@1", "{0.option.accuracy.recall_at_1:.2f}"),
    ("accepted", "{0.option.accuracy.accepted} of {0.option.accuracy.asked}"),
    ("wrong", "{0.option.accuracy.accepted_elsewhere}{0.option.accuracy.beside}"),
    ("sets", "{0.option.accuracy.sets}"), ("queries", "{0.option.accuracy.queries}"), ("chosen by itself", "{chosen}"),
)  # fmt: skip
_DRAWS = (
    _NAME[0], ("mAh/query", "{0.query.used_mah:.4f}"), ("marginal", "{0.query.marginal_mah:.4f}"),
    ("mAh/flight", "{0.flight_mah:.1f}"), ("marginal", "{0.flight_marginal_mah:.2f}"),
    ("of pack", "{0.flight_pack_frac:.1%}"),
)  # fmt: skip
_LOSES = (("min lost", "{0.lost_min:.2f}"), ("marginal", "{0.lost_marginal_min:.3f}"))
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
    rows = estimate.techniques
    columns = _DRAWS + (_LOSES if plan.hover_w else ())
    tables = [
        *_table(_NEEDS, [*map(_needs, rows), *([name, "n/a"] for name in estimate.unusable)]),
        *_table(_FINDS, list(map(_finds, rows))),
        *_table(columns, [_cells(columns, row) for row in rows]),
    ]
    notes = [f"{row.option.label} {row.option.fit.misfit}." for row in rows if row.option.fit.misfit]
    notes += [*_unusable(estimate.unusable), *estimate.notes]
    tried_now = [row.option.label for row in rows if not row.measured]
    if estimate.measured_on and tried_now:
        notes.append(f"Not among the stored figures, and tried now: {', '.join(tried_now)}.")
    notes.append(f"Recommended: {estimate.reason}")
    return "\n".join([heading, "", *tables, *(line for note in notes for line in wrapped(note))])


def plot(estimate: FlightEstimate, path: Path) -> None:
    """Draw the recall@1 of each technique against its charge, and save the picture. Blue: fits. Red: does not fit.
    Pale: not on the front. Cross: has accepted wrong places. Ring: recommended. The line joins the front."""
    drawn = figure(9, 6)
    axes = drawn.add_subplot()
    plan, front = estimate.plan, []
    for row in estimate.techniques:
        option = row.option
        if option.accuracy is None:
            continue
        at = row.flight_marginal_mah, option.recall
        colour, alpha = "C3" if option.fit.misfit else "C0", 1.0 if row.on_front else 0.3
        axes.scatter(*at, marker="X" if option.accuracy.accepted_elsewhere else "o", lw=0, color=colour, alpha=alpha)
        axes.annotate(option.label, at, (4, 3), textcoords="offset points", fontsize=7, color=colour)
        if option.label == estimate.recommended:
            axes.scatter(*at, s=180, facecolors="none", edgecolors="k")
        if row.on_front:
            front.append(at)
    axes.step([mah for mah, _ in sorted(front)], [recall for _, recall in sorted(front)], where="post", color="C0")
    axes.set(
        xscale="log",
        xlabel=f"mAh that recognising takes in {plan.flight_min:g} min, of {plan.pack.capacity_mah}",
        ylabel=f"recall@1 on image sets, camera {plan.camera or 'forward'} (X: accepted wrong places)",
        title=f"{estimate.title}: {plan.places} places at {plan.rate_hz:g} Hz",
    )
    drawn.savefig(path, dpi=100)


def _unusable(unusable: Mapping[str, str]) -> list[str]:
    """Return a sentence for each reason, with the names of all techniques that cannot be used for that reason."""
    reasons = {why: [name for name in unusable if unusable[name] == why] for why in unusable.values()}
    return [f"{', '.join(names)} cannot be used: {why}" for why, names in reasons.items()]


def _table(columns: _Columns, rows: Sequence[Sequence[str]]) -> list[str]:
    return [*aligned([[heading for heading, _ in columns], *rows], left=2 if columns[:2] == _NAME else 1), ""]


def _cells(columns: _Columns, row: object, **more: str) -> list[str]:
    return [cell.format(row, **more) for _, cell in columns]


def _needs(row: TechniqueEstimate) -> list[str]:
    return _cells(_NEEDS, row, fits="no" if row.option.fit.misfit else "yes")


def _finds(row: TechniqueEstimate) -> list[str]:
    option, fits = row.option, "no" if row.option.fit.misfit else "yes"
    if option.accuracy is None:
        return [*_cells(_NAME, row, fits=fits), "?", "?", "?", "", "", "never measured"]
    if option.fit.misfit:
        chosen = ""
    elif row.on_front:
        chosen = "yes"
    elif option.accuracy.accepted_elsewhere:
        chosen = "wrong places"
    else:
        chosen = "needs a sequence" if option.objection else "another is better"
    return _cells(_FINDS, row, fits=fits, chosen=chosen)
