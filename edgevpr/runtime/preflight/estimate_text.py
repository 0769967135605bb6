"""Estimates and stored figures as plain text of at most 120 columns: tables with a line a technique, and notes."""

from collections.abc import Mapping

from edgevpr.core.text import aligned, wrapped
from edgevpr.runtime.preflight.estimate import FlightEstimate, TechniqueEstimate
from edgevpr.runtime.preflight.probe import TechniqueCosts
from edgevpr.runtime.preflight.stored import StoredFigures

_FINDS = ("technique", "fits", "recall@1", "accepted", "wrong", "sets", "queries", "chosen by itself")
_NEEDS = ("technique", "fits", "B/place", "map MB", "disk MB", "peak MB", "t_e s", "t_m s", "U_e", "U_m", "Hz")
_DRAWS = ("technique", "mAh/query", "marginal", "mAh/flight", "marginal", "of pack")
_LOSES = ("min lost", "marginal")
_MEASURED = (
    "technique", "t_e ms", "CPU ms", "t_m us", "CPU us", "scan us", "peak MB", "encode MB", "RAM B", "disk B",
)  # fmt: skip


def format_table(estimate: FlightEstimate) -> str:
    """Format the estimate as text: what each technique needs, finds and draws, why any does not fit, notes, and what is
    recommended."""
    plan = estimate.plan
    since = f" on {estimate.measured_on}" if estimate.measured_on else ""
    hovers = f", hovering at {plan.hover_w:g} W" if plan.hover_w else ""
    heading = (
        f"{estimate.title}: {plan.places} places, {plan.rate_hz:g} Hz, {plan.flight_min:g} min, {plan.pack.cells}S"
        f"{plan.pack.capacity_mah} at {plan.regulator_efficiency:.0%} regulator efficiency{hovers}; times measured"
        f"{since}" + {"measured": "", "scaled": ", scaled", "unscaled": " here, unscaled"}[estimate.times]
    )
    missing = [[name, "n/a"] for name in estimate.unusable]
    needs = aligned([_NEEDS, *map(_needs, estimate.techniques), *missing], left=2)
    finds = aligned([_FINDS, *map(_finds, estimate.techniques)], left=2)
    draws = aligned([_DRAWS + (_LOSES if plan.hover_w else ()), *map(_draws, estimate.techniques)])
    notes = []
    for row in estimate.techniques:
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
    """Format figures measured on this machine, a line for each technique and form. The time of matching is that of one
    place: of its full comparison where all places are scanned before, else of the scan itself."""
    machine, score = figures.identity, figures.score
    unusable = {trial.label: trial.problem for trial in figures.trials if trial.problem}
    rows = [_measured(trial.label, trial.costs) for trial in figures.trials if trial.costs]
    return "\n".join(
        [
            f"{machine['machine']}, {machine['cores']} cores, {machine['RAM in MB']} MB: measured on {figures.date}, "
            f"{figures.pictures}",
            *aligned([_MEASURED, *rows, *([name, "n/a"] for name in unusable)]),
            "t_m, scan, RAM B and disk B are of one place; peak MB is the process, encode MB what encoding adds.",
            *(line for sentence in _unusable(unusable) for line in wrapped(sentence)),
            f"Beside one core of the reference: products {score.products:g}, passes {score.passes:g}, all cores "
            f"{score.multi:g} (single {score.single:g}).",
        ]
    )


def _unusable(unusable: Mapping[str, str]) -> list[str]:
    """Say why techniques cannot be used, once for all with the same reason."""
    reasons = {why: [name for name in unusable if unusable[name] == why] for why in unusable.values()}
    return [f"{', '.join(names)} cannot be used: {why}" for why, names in reasons.items()]


def _finds(row: TechniqueEstimate) -> tuple[str, ...]:
    accuracy, fits = row.accuracy, "yes" if row.fits else "no"
    if accuracy is None:
        return (row.technique, fits, "?", "?", "?", "", "", "never measured")
    beside = accuracy.accepted_wrong - accuracy.accepted_elsewhere
    if not row.fits:
        chosen = ""
    elif row.on_front:
        chosen = "yes"
    elif not accuracy.is_trusted:
        chosen = "wrong places"
    else:
        chosen = "needs a sequence" if row.objection else "another is better"
    return (
        row.technique,
        fits,
        f"{accuracy.recall_at_1:.2f}",
        f"{accuracy.accepted} of {accuracy.asked}",
        f"{accuracy.accepted_elsewhere}" + (f" (+{beside} beside)" if beside else ""),
        f"{accuracy.sets}",
        f"{accuracy.queries}",
        chosen,
    )


def _needs(row: TechniqueEstimate) -> tuple[str, ...]:
    return (
        row.technique,
        "yes" if row.fits else "no",
        f"{row.ram_bytes_per_place}",
        f"{row.map_ram_mb:.1f}",
        f"{row.map_disk_mb:.1f}",
        f"{row.process_ram_mb:.0f}",
        f"{row.t_encode_s:.3f}",
        f"{row.t_match_s:.3f}",
        f"{row.u_encode:.2f}",
        f"{row.u_match:.2f}",
        f"{row.reachable_hz:.3g}",
    )


def _draws(row: TechniqueEstimate) -> tuple[str, ...]:
    lost = () if row.lost_min is None else (f"{row.lost_min:.2f}", f"{row.lost_marginal_min:.3f}")
    return (
        row.technique,
        f"{row.query_mah:.4f}",
        f"{row.query_marginal_mah:.4f}",
        f"{row.flight_mah:.1f}",
        f"{row.flight_marginal_mah:.2f}",
        f"{row.flight_pack_frac:.1%}",
        *lost,
    )


def _measured(label: str, costs: TechniqueCosts) -> tuple[str, ...]:
    return (
        label,
        f"{1e3 * costs.encode.wall_s:.2f}",
        f"{1e3 * costs.encode.cpu_s:.2f}",
        f"{1e6 * costs.match_per_place.wall_s:.3f}",
        f"{1e6 * costs.match_per_place.cpu_s:.3f}",
        f"{1e6 * costs.scan_per_place.wall_s:.3f}" if costs.candidates else "-",
        f"{costs.process_mb:.1f}",
        "-" if costs.encode_mb is None else f"{costs.encode_mb:.1f}",
        f"{costs.ram_bytes_per_place}",
        f"{costs.disk_bytes_per_place}",
    )
