"""Measures rows (a technique with its settings) on data sets, and writes the results into a folder: `edgevpr eval`."""

import csv
import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from edgevpr.core.config import SalienceConfig
from edgevpr.core.errors import EdgevprError, ImageError, ModelError
from edgevpr.core.files import write_whole
from edgevpr.lab.evaluate import metrics
from edgevpr.lab.evaluate.dataset import Dataset
from edgevpr.lab.evaluate.evaluate import MatchOptions, Progress, QueryAnswer, answer_queries, summarise
from edgevpr.lab.evaluate.provenance import describe_origin
from edgevpr.runtime.recognise.opening import open_salience_gate
from edgevpr.techniques import create


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """What is measured: the data `sets`, by name, and on each of them the `rows`: (technique, its settings), by the
    label of the row. `options` and `salience` say how all of them are asked."""

    sets: Mapping[str, Dataset]
    rows: Mapping[str, tuple[str, dict[str, Any]]]
    options: MatchOptions
    salience: SalienceConfig


@dataclass(frozen=True, slots=True, kw_only=True)
class MeasuredRow:
    """The `result` of the row of that name on a set, and its `answers` to the queries."""

    result: metrics.TechniqueResult
    answers: Sequence[QueryAnswer]


@dataclass(frozen=True, slots=True)
class Measurements:
    """Outcome of a run: the rows that were measured (`found`), by set, and why others `failed`, by set and label."""

    found: dict[str, list[MeasuredRow]]
    failed: dict[tuple[str, str], EdgevprError]

    def as_json(self) -> dict[str, Any]:
        """Return all results, with date, machine and versions, for `json.dumps`."""
        return {
            **describe_origin(),
            "results": [
                {"set": name, "row": row.result.technique, **asdict(row.result)}
                for name, rows in self.found.items()
                for row in rows
            ],
            "failed": [{"set": name, "row": row, "why": str(why)} for (name, row), why in self.failed.items()],
        }


def measure(plan: Plan, progress: Progress) -> Measurements:
    """Measure every row on every set. Raises UsageError for an unknown technique or parameter. A network or picture
    that cannot be used only makes its row fail."""
    found: dict[str, list[MeasuredRow]] = {name: [] for name in plan.sets}
    failed: dict[tuple[str, str], EdgevprError] = {}
    for name, dataset in plan.sets.items():
        for label, (technique_name, settings) in plan.rows.items():
            try:
                technique, gate = create(technique_name, settings), open_salience_gate(plan.salience)
                answers, not_done = answer_queries(technique, dataset, plan.options, progress, gate)
            except (ModelError, ImageError) as error:  # it stops no other row
                failed[name, label] = error
            else:
                result = summarise(technique, dataset, answers, plan.options, not_done)
                found[name].append(MeasuredRow(result=replace(result, technique=label), answers=answers))
    return Measurements({name: _compare(rows) for name, rows in found.items()}, failed)


def _compare(rows: Sequence[MeasuredRow]) -> list[MeasuredRow]:
    results = metrics.compare(row.result for row in rows)
    return [replace(row, result=result) for row, result in zip(rows, results, strict=True)]


def write_results(folder: Path, outcome: Measurements) -> None:
    """Write results.json; results.csv with a line for each row: its numbers and names, of which those of the queries
    whose place is in the map begin with `with_match.`; and answers.csv with a line for each answer of a row."""
    content = outcome.as_json()
    _write(folder / "results.json", json.dumps(content, indent=1) + "\n")
    lines = []
    for row in content["results"]:
        nested = {f"with_match.{name}": value for name, value in (row["with_match"] or {}).items()}
        lines.append({name: value for name, value in {**row, **nested}.items() if isinstance(value, int | float | str)})
    _write_table(folder / "results.csv", lines)
    answers = [
        {"set": name, "row": row.result.technique} | _flatten(answer)
        for name, rows in outcome.found.items()
        for row in rows
        for answer in row.answers
    ]
    _write_table(folder / "answers.csv", answers)


def _flatten(answer: QueryAnswer) -> dict[str, Any]:
    """Return the fields of an answer, of its costs the seconds."""
    fields = asdict(answer)
    return fields | {f"t_{stage}_s": fields.pop(stage)["wall_s"] for stage in ("encoding", "matching")}


def _write_table(path: Path, lines: Sequence[Mapping[str, Any]]) -> None:
    table = io.StringIO()
    writer = csv.DictWriter(table, list(dict.fromkeys(name for line in lines for name in line)), restval="")
    writer.writeheader()
    writer.writerows(lines)
    _write(path, table.getvalue())


def _write(path: Path, text: str) -> None:
    """Write a file whole. Raises EdgevprError where the folder takes no more."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_whole(path, partial(Path.write_text, data=text, encoding="utf-8", errors="backslashreplace"))
    except OSError as error:
        raise EdgevprError(f"{path} cannot be written ({error.strerror}): make room, and run again.") from error
