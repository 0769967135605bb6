"""Formats estimates as text: tables of at most 120 columns with one row per technique, and notes."""

from edgevpr.core.text import align_table, wrap_sentence
from edgevpr.runtime.preflight.estimate import FlightEstimate, TechniqueEstimate

# Columns of the two tables: cost of each technique (resources, then charge), and its accuracy.
_RESOURCE_COLUMNS = ("technique", "fits", "map MB", "RAM MB", "t_e s", "t_m s", "U_e", "U_m", "Hz")
_CHARGE_COLUMNS = ("mAh/query", "mAh/flight", "marginal", "of pack")
_ACCURACY_COLUMNS = ("technique", "recall@1", "accepted", "wrong", "sets", "queries", "automatic choice")


def format_table(estimate: FlightEstimate) -> str:
    """Format an estimate as text: the recommended technique, tables of cost and accuracy, the reasons why techniques do
    not fit or are unusable, and notes."""
    plan, rows = estimate.plan, estimate.techniques
    heading = (
        f"{estimate.title}: {plan.places} places, {plan.rate_hz:g} Hz, {plan.flight_min:g} min, {plan.pack.cells}S"
        f"{plan.pack.capacity_mah} at {plan.regulator_efficiency:.0%} regulator efficiency; times {estimate.times}"
    )
    others = [*([name, "?"] for name in estimate.unknown), *([name, "n/a"] for name in estimate.unusable)]
    costs = align_table([_RESOURCE_COLUMNS + _CHARGE_COLUMNS, *map(_make_cost_row, rows), *others], left=2)
    accuracies = align_table([_ACCURACY_COLUMNS, *(_make_accuracy_row(row, estimate.recommended) for row in rows)])
    notes = [f"{row.option.label} {row.option.misfit}." for row in rows if row.option.misfit]
    for reason in dict.fromkeys(estimate.unusable.values()):
        names = [name for name, problem in estimate.unusable.items() if problem == reason]
        notes.append(f"{', '.join(names)} cannot be used: {reason}")
    notes += estimate.notes
    recommendation = wrap_sentence(f"Recommended: {estimate.reason}")
    note_lines = [line for note in notes for line in wrap_sentence(note)]
    return "\n".join([*recommendation, "", heading, "", *costs, "", *accuracies, "", *note_lines])


def _make_cost_row(row: TechniqueEstimate) -> list[str]:
    option, query = row.option, row.query
    return [
        option.label,
        "no" if option.misfit else "yes",
        f"{option.map_ram_mb:.1f}",
        f"{option.process_ram_mb:.0f}",
        f"{query.t_encode_s:.3f}",
        f"{query.t_match_s:.3f}",
        f"{query.u_encode:.2f}",
        f"{query.u_match:.2f}",
        f"{option.reachable_hz:.3g}",
        f"{query.used_mah:.4f}",
        f"{row.flight_mah:.1f}",
        f"{row.flight_marginal_mah:.2f}",
        f"{row.flight_pack_frac:.1%}",
    ]


def _make_accuracy_row(row: TechniqueEstimate, recommended: str | None) -> list[str]:
    option, accuracy = row.option, row.option.accuracy
    if accuracy is None:
        return [option.label, "?", "?", "?", "", "", "never measured"]
    choice = "needs a sequence" if option.objection else "another is better"
    if option.misfit:
        choice = ""
    elif option.label == recommended:
        choice = "yes"
    elif accuracy.accepted_elsewhere:
        choice = "wrong places"
    accepted, wrong = f"{accuracy.accepted} of {accuracy.asked}", f"{accuracy.accepted_elsewhere}{accuracy.neighbours}"
    counts = str(accuracy.sets), str(accuracy.queries)
    return [option.label, f"{accuracy.recall_at_1:.2f}", accepted, wrong, *counts, choice]
