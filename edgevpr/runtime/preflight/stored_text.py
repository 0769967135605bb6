"""The figures measured on this machine, as plain text."""

from edgevpr.core.text import aligned
from edgevpr.runtime.preflight.estimate_text import unusable_lines
from edgevpr.runtime.preflight.stored import StoredFigures
from edgevpr.runtime.preflight.trial import Trial

_HEADS = (
    "technique", "t_e ms", "CPU ms", "t_m us", "CPU us", "scan us", "peak MB", "encode MB", "RAM B", "disk B",
)  # fmt: skip


def format_stored(found: StoredFigures) -> str:
    """Format a line for each technique and form. The time of matching is that of one place: of its full comparison
    where all places are scanned before, else of the scan itself."""
    there = found.identity
    unusable = {trial.label: trial.problem for trial in found.trials if trial.problem}
    rows = [_HEADS, *(_cells(trial) for trial in found.trials if trial.costs), *([name, "n/a"] for name in unusable)]
    score = found.score
    return "\n".join(
        [
            f"{there['machine']}, {there['cores']} cores, {there['RAM in MB']} MB: measured on {found.date}, "
            f"{found.pictures}",
            *aligned(rows),
            "t_m, scan, RAM B and disk B are of one place; peak MB is the process, encode MB what encoding adds.",
            *unusable_lines(unusable),
            f"Beside one core of the reference: products {score.products:g}, passes {score.passes:g}, all cores "
            f"{score.multi:g} (single {score.single:g}).",
        ]
    )


def _cells(trial: Trial) -> tuple[str, ...]:
    costs = trial.costs
    return (
        trial.label,
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
