"""An estimate as plain text of at most 120 columns: three tables, a line for each technique, and notes."""

from edgevpr.core.text import aligned, wrapped
from edgevpr.runtime.preflight.estimate import Estimate, TechniqueEstimate

_FINDS = ("technique", "fits", "recall@1", "accepted", "wrong", "sets", "queries", "chosen by itself")
_NEEDS = ("technique", "fits", "B/place", "map MB", "disk MB", "peak MB", "t_e s", "t_m s", "U_e", "U_m", "Hz")
_DRAWS = ("technique", "mAh/query", "marginal", "mAh/flight", "marginal", "of pack")
_LOSES = ("min lost", "marginal")


def format_table(estimate: Estimate) -> str:
    """Format the estimate as text: what each technique needs, finds and draws, why any does not fit, notes, and what is
    recommended."""
    plan = estimate.plan
    since = f" on {estimate.measured_on}" if estimate.measured_on else ""
    hovers = f", hovering at {plan.hover_w:g} W" if plan.hover_w else ""
    lines = [
        f"{estimate.title}: {plan.places} places, {plan.rate_hz:g} Hz, {plan.flight_min:g} min, {plan.pack.cells}S"
        f"{plan.pack.capacity_mah} at {plan.regulator_efficiency:.0%} regulator efficiency{hovers}; times measured"
        f"{since}" + {"measured": "", "scaled": ", scaled", "unscaled": " here, unscaled"}[estimate.times],
    ]
    missing = [[name, "n/a"] for name in estimate.unusable]
    lines += ["", *aligned([_NEEDS, *(_needs(row) for row in estimate.techniques), *missing], left=2)]
    lines += ["", *aligned([_FINDS, *(_finds(row) for row in estimate.techniques)], left=2)]
    draws = _DRAWS + (_LOSES if plan.hover_w else ())
    lines += ["", *aligned([draws, *(_draws(row) for row in estimate.techniques)]), ""]
    for each in estimate.techniques:
        if not each.fits:
            remedy = f"; it would fit {', or '.join(each.remedies)}" if each.remedies else ""
            lines += wrapped(f"{each.technique} does not fit: {' and '.join(each.shortfalls)}{remedy}.")
    lines += unusable_lines(estimate.unusable)
    for weights in estimate.weights:
        lines += wrapped(f"Weights of {weights}.")
    for note in estimate.notes:
        lines += wrapped(note)
    tried_now = [row.technique for row in estimate.techniques if not row.measured]
    if estimate.measured_on and tried_now:
        lines += wrapped(f"Not among the stored figures, and tried now: {', '.join(tried_now)}.")
    return "\n".join([*lines, *wrapped(f"Recommended: {estimate.reason}")])


def unusable_lines(unusable: dict[str, str]) -> list[str]:
    """Say why techniques cannot be used, once for all with the same reason."""
    lines = []
    for why in dict.fromkeys(unusable.values()):
        names = ", ".join(name for name, each in unusable.items() if each == why)
        lines += wrapped(f"{names} cannot be used: {why}")
    return lines


def _finds(row: TechniqueEstimate) -> tuple[str, ...]:
    found, fits = row.accuracy, "yes" if row.fits else "no"
    if found is None:
        return (row.technique, fits, "?", "?", "?", "", "", "never measured")
    wrong = f"{found.accepted_elsewhere}"
    if beside := found.accepted_wrong - found.accepted_elsewhere:
        wrong += f" (+{beside} beside)"
    if not row.fits:
        chosen = ""
    elif row.on_front:
        chosen = "yes"
    elif not found.is_trusted:
        chosen = "wrong places"
    else:
        chosen = "needs a sequence" if row.objection else "another is better"
    accepted = f"{found.accepted} of {found.asked}"
    return (
        row.technique,
        fits,
        f"{found.recall_at_1:.2f}",
        accepted,
        wrong,
        f"{found.sets}",
        f"{found.queries}",
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
