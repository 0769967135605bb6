"""The pages of what was measured: benchmarks/results/service_faults.md, and the table in docs/explanation/faults.md."""

from collections.abc import Collection
from typing import Any

from image import REPOSITORY

from edgevpr.core.text import markdown

_BEGIN, _END = "<!-- service faults -->\n", "<!-- end -->"


def write_page(measured: dict[str, Any], faults: Collection[str]) -> None:
    """Write both. `faults` are the names of all that there are: those without a row are said to be not run."""
    found = _table(measured) + _not_run([name for name in faults if name not in measured["faults"]])
    page = REPOSITORY / "benchmarks/results/service_faults.md"
    made = [row["made_by"] for row in measured["faults"].values()]
    dates, commits = ({each[key] for each in made} for key in ("date", "commit"))
    page.write_text(
        "# The service and its faults, under a real systemd\n\nMade by `make service-faults`, "
        f"{', '.join(sorted(dates))}, commit {', '.join(sorted(commits))}, {made[-1]['machine']['cpu']}.\n\n"
        f"{_machine(measured['machine'])}\n\n{found}\n"
    )
    document = REPOSITORY / "docs/explanation/faults.md"
    text = document.read_text()
    head, rest = text.split(_BEGIN)
    document.write_text(f"{head}{_BEGIN}\n{found}\n\n{_END}{rest.split(_END)[1]}")


def _machine(about: dict[str, Any]) -> str:
    return (
        f"Machine: {about['inside']}; processor {about['processor']}, so that seconds are those of a very slow board. "
        f"The installation took {about['installed_s']} s, a boot {about['boot_s']:.0f} s."
    )


def _not_run(names: list[str]) -> str:
    return f"\n\nNot run yet: {', '.join(name.replace('_', ' ') for name in names)}." if names else ""


def _table(measured: dict[str, Any]) -> str:
    rows = []
    for row in measured["faults"].values():
        told = "; ".join(f"`{text}`" for text in row["told"]) or "-"
        again = "-" if row["again_s"] is None else f"{row['again_s']:.0f} s"
        does = row["does"] + "".join(f" **Not so: {what}.**" for what in row["failed"])
        rows.append([row["fault"], does, row["kept"], row["lost"], told, again])
    columns = ["fault", "edgevpr", "kept", "lost", "the ground station is told", "works again after"]
    return markdown(columns, rows, left=5)
