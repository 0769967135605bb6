"""Measures rows (a technique with its settings) on data sets: `edgevpr eval`. With a folder, each result is kept there
as a file, and is not measured again, so that a run which was interrupted can be continued."""

import csv
import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import edgevpr
from edgevpr.core.config import SalienceConfig
from edgevpr.core.contract import Technique
from edgevpr.core.errors import EdgevprError, ImageError, ModelError
from edgevpr.core.files import write_atomically
from edgevpr.core.text import Progress
from edgevpr.frames.images import list_images
from edgevpr.frames.positions import find_positions
from edgevpr.lab.evaluate import metrics
from edgevpr.lab.evaluate.dataset import Dataset
from edgevpr.lab.evaluate.evaluate import MatchOptions, answer_queries, summarise
from edgevpr.lab.evaluate.provenance import describe_origin, hash_parts, read_versions, stamp_file
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
    """The `result` of the row of that name on a set. `made` tells its origin: the date (UTC), machine and versions."""

    result: metrics.TechniqueResult
    made: dict[str, Any]


@dataclass(frozen=True, slots=True)
class Measurements:
    """Outcome of a run: the rows `measured`, by set, and why others `failed`, by set and label."""

    measured: dict[str, list[MeasuredRow]]
    failed: dict[tuple[str, str], EdgevprError]

    def as_json(self) -> dict[str, Any]:
        """Return all results, with date, machine and versions, for `json.dumps`."""
        results = [(name, row) for name, rows in self.measured.items() for row in rows]
        return {
            **describe_origin(),
            "results": [
                {"set": name, "row": row.result.technique, **asdict(row.result), "made": row.made}
                for name, row in results
            ],
            "failed": [{"set": name, "row": row, "why": str(why)} for (name, row), why in self.failed.items()],
        }


def measure(plan: Plan, folder: Path | None, progress: Progress) -> Measurements:
    """Measure every row on every set. Results are kept in `folder` (None: nowhere). Raises UsageError for an unknown
    technique or parameter. A network or picture that cannot be used only makes its row fail."""
    measured: dict[str, list[MeasuredRow]] = {name: [] for name in plan.sets}
    failed: dict[tuple[str, str], EdgevprError] = {}
    for name, dataset in plan.sets.items():
        for label, (technique, settings) in plan.rows.items():
            try:
                content = _measure_or_read(plan, dataset, create(technique, settings), folder, progress)
            except (ModelError, ImageError) as error:  # it stops no other row
                failed[name, label] = error
            else:
                result = replace(metrics.read_result(content["result"]), technique=label)
                measured[name].append(MeasuredRow(result=result, made=content["made"]))
    return Measurements({name: _add_pcu(rows) for name, rows in measured.items()}, failed)


def _add_pcu(rows: Sequence[MeasuredRow]) -> list[MeasuredRow]:
    results = metrics.add_pcu(row.result for row in rows)
    return [replace(row, result=result) for row, result in zip(rows, results, strict=True)]


def _measure_or_read(
    plan: Plan, dataset: Dataset, technique: Technique, folder: Path | None, progress: Progress
) -> dict[str, Any]:
    """Return the result, the answers and the origin of a row on a set, as the file in `folder` has them."""
    path = folder / "measured" / f"{_hash_row(plan, dataset, technique)}.json" if folder else None
    if path and path.exists():
        content: dict[str, Any] = json.loads(path.read_text("utf-8"))
        return content
    gate = open_salience_gate(plan.salience)
    answers, not_done = answer_queries(technique, dataset, plan.options, progress, gate)
    result = summarise(technique, dataset, answers, plan.options, not_done)
    content = {"result": asdict(result), "answers": [asdict(answer) for answer in answers], "made": describe_origin()}
    if path:
        _write(path, json.dumps(content))
    return content


def _hash_row(plan: Plan, dataset: Dataset, technique: Technique) -> str:
    """Return the hash of all that decides a result: code, technique, options, pictures and ground truth."""
    code = [stamp_file(path) for path in sorted(Path(edgevpr.__file__).parent.rglob("*.py"))]
    folders = dataset.ref_dir, dataset.queries[0].path.parent
    files = [path for side in folders for path in (find_positions(side), *list_images(side)) if path]
    truth = [(query.path.name, sorted(query.right), sorted(query.ignored)) for query in dataset.queries]
    spec = technique.spec
    row = [spec.name, spec.parameters, spec.form, spec.model_sha256, asdict(plan.options), asdict(plan.salience)]
    return hash_parts(code, read_versions(), list(map(stamp_file, files)), truth, row)


def write_results(folder: Path, outcome: Measurements) -> None:
    """Write results.json, and results.csv with a line for each row: its numbers and names; those of the queries whose
    place is in the map begin with `with_match.`."""
    content = outcome.as_json()
    _write(folder / "results.json", json.dumps(content, indent=1) + "\n")
    lines = []
    for row in content["results"]:
        nested = {f"with_match.{name}": value for name, value in (row["with_match"] or {}).items()}
        lines.append({name: value for name, value in {**row, **nested}.items() if isinstance(value, int | float | str)})
    table = io.StringIO()
    writer = csv.DictWriter(table, list(dict.fromkeys(name for line in lines for name in line)), restval="")
    writer.writeheader()
    writer.writerows(lines)
    _write(folder / "results.csv", table.getvalue())


def _write(path: Path, text: str) -> None:
    """Write a file whole. Raises EdgevprError where the folder takes no more."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(path, partial(Path.write_text, data=text, encoding="utf-8", errors="backslashreplace"))
    except OSError as error:
        raise EdgevprError(f"{path} cannot be written ({error.strerror}): make room, and run again.") from error
