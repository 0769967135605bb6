"""The results of many rows on many sets as files: JSON for programs, a page for people."""

import json
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

from edgevpr.core.files import write_whole
from edgevpr.lab.evaluate.many import Measurements
from edgevpr.lab.evaluate.metrics import RESAMPLES, SEED
from edgevpr.lab.evaluate.page import page_of
from edgevpr.lab.evaluate.provenance import machine, today, versions


def write_results(folder: Path, outcome: Measurements) -> None:
    """Write results.json and index.html into a folder."""
    contents = {"results.json": json.dumps(as_json(outcome), indent=1) + "\n", "index.html": page_of(outcome)}
    for name, content in contents.items():
        write_whole(folder / name, partial(Path.write_text, data=content, encoding="utf-8", errors="backslashreplace"))


def as_json(outcome: Measurements) -> dict[str, Any]:
    """Return all results, with who made them, as JSON holds them."""
    return {
        "date": today(),
        "machine": machine(),
        "versions": versions(),
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
