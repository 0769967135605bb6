"""The results of many rows on many sets as files: JSON for programs, CSV for tables, Markdown and a page for people."""

import csv
import io
import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from edgevpr.core.files import write_whole
from edgevpr.core.tables import markdown
from edgevpr.lab.evaluate import tables
from edgevpr.lab.evaluate.many import Outcome
from edgevpr.lab.evaluate.measured import Measured
from edgevpr.lab.evaluate.page import page_of
from edgevpr.lab.evaluate.provenance import commit_of, machine, today, versions
from edgevpr.lab.evaluate.quality import RESAMPLES, SEED

_IN_JSON_ONLY = ("precision_recall", "ah_assumes", "parameters")


def write_results(folder: Path, outcome: Outcome) -> None:
    """Write results.json, results.csv, results.md and index.html into a folder."""
    contents = {
        "results.json": json.dumps(as_json(outcome), indent=1) + "\n",
        "results.csv": _csv(outcome.found),
        "results.md": _markdown(outcome),
        "index.html": page_of(outcome),
    }
    for name, content in contents.items():
        _write(folder / name, content)


def as_json(outcome: Outcome) -> dict[str, Any]:
    """Return all results, with who made them, as JSON holds them."""
    return {
        "date": today(),
        "machine": machine(),
        "versions": versions(),
        "commit": commit_of(),
        "seeds": {"intervals": SEED, "resamples": RESAMPLES},
        "sets": {
            of.name: {
                **{key: value for key, value in asdict(of.plan).items() if value is not None},
                "queries": len(of.dataset.queries),
                "references": len(of.dataset.references),
            }
            for of in outcome.sets
        },
        "results": [
            {
                "set": each.set_name,
                "row": each.label,
                **asdict(each.result),
                "recall_at_k": each.recalls,
                "made": asdict(each.made),
            }
            for each in outcome.found
        ],
        "failed": [{"set": of, "row": row, "why": why} for (of, row), why in outcome.failed.items()],
    }


def _csv(found: Sequence[Measured]) -> str:
    lines = []
    for each in found:
        result = {key: value for key, value in asdict(each.result).items() if key not in _IN_JSON_ONLY}
        flat: dict[str, Any] = {"set": each.set_name, "row": each.label}
        for key, value in result.items():
            if key.endswith("_interval"):
                flat[f"{key}_low"], flat[f"{key}_high"] = value or (None, None)
            elif key != "technique":
                flat[key] = value
        made = each.made
        flat |= {
            "first": made.first,
            "last": made.last,
            "was_kept": made.was_kept,
            "workers": made.workers,
            "cpu": made.machine["cpu"],
            "cores": made.machine["cores"],
            "commit": made.commit,
            **made.versions,
        }
        lines.append(flat)
    text = io.StringIO()
    if lines:
        table = csv.DictWriter(text, lines[0], lineterminator="\n")
        table.writeheader()
        table.writerows(lines)
    return text.getvalue()


def _markdown(outcome: Outcome) -> str:
    parts = ["# Results", "", f"Written on {today()} by edgevpr {_version(versions(), commit_of())}.", ""]
    for of in outcome.sets:
        rows = [each for each in outcome.found if each.set_name == of.name]
        parts += [
            f"## {_cell(of.name)}",
            "",
            f"{len(of.dataset.queries)} queries scored against {len(of.dataset.references)} references.",
            "",
        ]
        if not rows:
            continue
        parts += [
            markdown(("row", *tables.QUALITY), [[_cell(each.label), *tables.quality(each.result)] for each in rows]),
            "",
            markdown(
                ("row", *tables.COSTS, "measured"),
                [[_cell(each.label), *tables.costs(each.result), _cell(story(each))] for each in rows],
            ),
            "",
        ]
    parts += [f"* {_cell(of)}, {_cell(row)}: not measured: {_cell(why)}" for (of, row), why in outcome.failed.items()]
    return "\n".join(parts).rstrip() + "\n"


def story(each: Measured) -> str:
    """Return when and on which machine a row was measured, in a few words."""
    made = each.made
    when = made.first if made.first == made.last else f"{made.first} to {made.last}"
    kept = "earlier, " if made.was_kept else ""
    return f"{kept}{when}, {made.machine['cpu']}, {made.workers} of {made.machine['cores']} cores"


def _version(found: dict[str, str | None], commit: str | None) -> str:
    return f"{found['edgevpr']}" + (f" ({commit})" if commit else "")


def _cell(text: str) -> str:
    return " ".join(text.replace("|", "\\|").split())


def _write(path: Path, content: str) -> None:
    write_whole(path, lambda unfinished: unfinished.write_text(content, "utf-8", "backslashreplace"))
