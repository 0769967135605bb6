"""Estimates for people: tables of at most 120 columns with a line per technique, and notes."""

from collections.abc import Sequence

from edgevpr.core.text import aligned, wrapped
from edgevpr.runtime.preflight.estimate import FlightEstimate, TechniqueEstimate

# The columns of the three tables: what each technique needs, finds and draws.
_NEEDS = ("technique", "fits", "B/place", "map MB", "disk MB", "peak MB", "t_e s", "t_m s", "U_e", "U_m", "Hz")
_FINDS = ("technique", "recall@1", "accepted", "wrong", "sets", "queries", "chosen by itself")
_DRAWS = ("technique", "mAh/query", "marginal", "mAh/flight", "marginal", "of pack")
_BOARD = ("board", "technique", "peak MB", "Hz", "query s", "mAh/flight", "marginal", "of pack")
_LOSES = ("min lost", "marginal")


def format_table(estimate: FlightEstimate) -> str:
    """Format an estimate as text: the recommended technique, tables of what each needs, finds and draws, why techniques
    do not fit, and notes."""
    plan, rows = estimate.plan, estimate.techniques
    hovers = f", hovering at {plan.hover_w:g} W" if plan.hover_w else ""
    heading = (
        f"{estimate.title}: {plan}, {plan.rate_hz:g} Hz, {plan.flight_min:g} min, {plan.pack.cells}S"
        f"{plan.pack.capacity_mah} at {plan.regulator_efficiency:.0%} regulator efficiency{hovers}; times measured"
        + {"measured": "", "scaled": ", scaled", "unscaled": " here, unscaled"}[estimate.times]
    )
    needs = aligned([_NEEDS, *map(_needs, rows), *([name, "n/a"] for name in estimate.unusable)], left=2)
    finds = aligned([_FINDS, *(_finds(row, estimate.recommended) for row in rows)])
    draws = aligned([_DRAWS + (_LOSES if plan.hover_w else ()), *map(_draws, rows)])
    notes = [f"{row.option.label} {row.option.fit.misfit}." for row in rows if row.option.fit.misfit]
    for why in dict.fromkeys(estimate.unusable.values()):
        names = [name for name, problem in estimate.unusable.items() if problem == why]
        notes.append(f"{', '.join(names)} cannot be used: {why}")
    notes += estimate.notes
    answer = wrapped(f"Recommended: {estimate.reason}")
    text = [line for note in notes for line in wrapped(note)]
    return "\n".join([*answer, "", heading, "", *needs, "", *finds, "", *draws, "", *text])


def format_boards(estimates: Sequence[FlightEstimate]) -> str:
    """Format estimates of the same flight on several boards as text: what is recommended on each, and what it takes
    there."""
    rows = [_BOARD, *map(_on_board, estimates)]
    none = [f"{each.title}: {each.reason}" for each in estimates if not each.recommended]
    plan = estimates[0].plan
    heading = f"{plan}, {plan.flight_min:g} min, {plan.pack.cells}S{plan.pack.capacity_mah}"
    return "\n".join([heading, "", *aligned(rows, left=2), *(line for note in none for line in wrapped(note))])


def _on_board(estimate: FlightEstimate) -> list[str]:
    row = next((row for row in estimate.techniques if row.option.label == estimate.recommended), None)
    if row is None:
        return [estimate.board, "none", *("" for _ in _BOARD[2:])]
    fit = row.option.fit
    asked = f"{fit.reachable_hz:.3g} of {estimate.plan.rate_hz:g}"
    charge = f"{row.flight_mah:.1f}", f"{row.flight_marginal_mah:.2f}", f"{row.flight_pack_frac:.1%}"
    return [estimate.board, row.option.label, f"{fit.process_ram_mb:.0f}", asked, f"{fit.t_query_s:.2f}", *charge]


def _needs(row: TechniqueEstimate) -> list[str]:
    option, fit, query = row.option, row.option.fit, row.query
    return [
        option.label,
        "no" if fit.misfit else "yes",
        f"{option.costs.ram_bytes_per_place}",
        f"{fit.map_ram_mb:.1f}",
        f"{fit.map_disk_mb:.1f}",
        f"{fit.process_ram_mb:.0f}",
        f"{query.t_encode_s:.3f}",
        f"{query.t_match_s:.3f}",
        f"{query.u_encode:.2f}",
        f"{query.u_match:.2f}",
        f"{fit.reachable_hz:.3g}",
    ]


def _finds(row: TechniqueEstimate, recommended: str | None) -> list[str]:
    option, accuracy = row.option, row.option.accuracy
    if accuracy is None:
        return [option.label, "?", "?", "?", "", "", "never measured"]
    chosen = "needs a sequence" if option.objection else "another is better"
    if option.fit.misfit:
        chosen = ""
    elif option.label == recommended:
        chosen = "yes"
    elif accuracy.accepted_elsewhere:
        chosen = "wrong places"
    accepted, wrong = f"{accuracy.accepted} of {accuracy.asked}", f"{accuracy.accepted_elsewhere}{accuracy.neighbours}"
    counts = str(accuracy.sets), str(accuracy.queries)
    return [option.label, f"{accuracy.recall_at_1:.2f}", accepted, wrong, *counts, chosen]


def _draws(row: TechniqueEstimate) -> list[str]:
    query = row.query
    charge = [f"{query.used_mah:.4f}", f"{query.marginal_mah:.4f}", f"{row.flight_mah:.1f}"]
    charge += [f"{row.flight_marginal_mah:.2f}", f"{row.flight_pack_frac:.1%}"]
    lost = [] if row.lost_min is None else [f"{row.lost_min:.2f}", f"{row.lost_marginal_min:.3f}"]
    return [row.option.label, *charge, *lost]
