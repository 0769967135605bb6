"""The results of many rows on many sets as files: JSON for programs, CSV for tables, Markdown and a page for people."""

import csv
import io
import json
from collections.abc import Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

from edgevpr.core.files import write_whole
from edgevpr.core.text import markdown
from edgevpr.lab.evaluate import tables
from edgevpr.lab.evaluate.many import MeasuredRow, Measurements
from edgevpr.lab.evaluate.metrics import RESAMPLES, SEED
from edgevpr.lab.evaluate.page import page_of
from edgevpr.lab.evaluate.provenance import commit_of, machine, program, today, versions

_IN_JSON_ONLY = ("technique", "precision_recall", "ah_assumes", "parameters")


def write_results(folder: Path, outcome: Measurements) -> None:
    """Write results.json, results.csv, results.md and index.html into a folder."""
    contents = {
        "results.json": json.dumps(as_json(outcome), indent=1) + "\n",
        "results.csv": _csv(outcome.found),
        "results.md": _markdown(outcome),
        "index.html": page_of(outcome),
    }
    for name, content in contents.items():
        write_whole(folder / name, partial(Path.write_text, data=content, encoding="utf-8", errors="backslashreplace"))


def as_json(outcome: Measurements) -> dict[str, Any]:
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
                "set": row.set_name,
                "row": row.label,
                **asdict(row.result),
                "recall_at_k": row.recalls,
                "made": asdict(row.made),
            }
            for row in outcome.found
        ],
        "failed": [{"set": of, "row": row, "why": why} for (of, row), why in outcome.failed.items()],
    }


def _csv(found: Sequence[MeasuredRow]) -> str:
    lines = []
    for row in found:
        line: dict[str, Any] = {"set": row.set_name, "row": row.label}
        for key, value in asdict(row.result).items():
            if key.endswith("_interval"):
                line[f"{key}_low"], line[f"{key}_high"] = value or (None, None)
            elif key not in _IN_JSON_ONLY:
                line[key] = value
        made = asdict(row.made)
        lines.append(line | made.pop("machine") | made.pop("versions") | made)
    text = io.StringIO()
    if lines:
        table = csv.DictWriter(text, lines[0], lineterminator="\n")
        table.writeheader()
        table.writerows(lines)
    return text.getvalue()


def _markdown(outcome: Measurements) -> str:
    parts = [f"# Results\n\nWritten on {today()} by {program(versions(), commit_of())}.\n"]
    for of in outcome.sets:
        rows = [row for row in outcome.found if row.set_name == of.name]
        queries, references = len(of.dataset.queries), len(of.dataset.references)
        parts.append(f"## {_cell(of.name)}\n\n{queries} queries scored against {references} references.\n")
        if rows:
            quality = [[_cell(row.label), *tables.quality(row.result)] for row in rows]
            costs = [[_cell(row.label), *tables.costs(row.result), _cell(row.made.story)] for row in rows]
            parts.append(markdown(("row", *tables.QUALITY), quality) + "\n")
            parts.append(markdown(("row", *tables.COSTS, "measured"), costs) + "\n")
    parts += [f"* {_cell(of)}, {_cell(row)}: not measured: {_cell(why)}" for (of, row), why in outcome.failed.items()]
    return "\n".join(parts).rstrip() + "\n"


def _cell(text: str) -> str:
    return " ".join(text.replace("|", "\\|").split())
