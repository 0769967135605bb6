"""Measures rows, each a technique with its settings, on data sets for `edgevpr eval`."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

from edgevpr.core.config import SalienceConfig
from edgevpr.core.errors import EdgevprError, ImageError, ModelError
from edgevpr.core.text import Progress
from edgevpr.lab.evaluate.dataset import Dataset
from edgevpr.lab.evaluate.evaluate import MatchOptions, QueryAnswer, answer_queries, summarise
from edgevpr.lab.evaluate.metrics import TechniqueResult, add_pcu
from edgevpr.lab.evaluate.provenance import describe_origin
from edgevpr.runtime.recognise.opening import open_salience_gate
from edgevpr.techniques import create


@dataclass(frozen=True, slots=True)
class Measurements:
    """Outcome of a run. `measured`: results of the rows, by set. `answers`: judged answers to their queries, by set and
    label. `failed`: errors of rows that could not be measured, by set and label."""

    measured: dict[str, list[TechniqueResult]]
    answers: dict[tuple[str, str], Sequence[QueryAnswer]]
    failed: dict[tuple[str, str], EdgevprError]

    def as_json(self) -> dict[str, Any]:
        """Return all results and answers, with date, machine and versions, for `json.dumps`."""
        results = [(name, result) for name, results in self.measured.items() for result in results]
        return {
            **describe_origin(),
            "results": [
                {
                    "set": name,
                    "row": result.technique,
                    **asdict(result),
                    "answers": list(map(_serialise_answer, self.answers[name, result.technique])),
                }
                for name, result in results
            ],
            "failed": [{"set": name, "row": row, "why": str(error)} for (name, row), error in self.failed.items()],
        }


def _serialise_answer(answer: QueryAnswer) -> dict[str, Any]:
    """Return the fields of an answer for JSON, with null in place of infinite values."""
    fields = asdict(answer)
    return fields | {name: None for name in ("score", "first_right") if not math.isfinite(fields[name])}


def measure(
    sets: Mapping[str, Dataset],
    rows: Mapping[str, tuple[str, dict[str, Any]]],
    options: MatchOptions,
    salience: SalienceConfig,
    progress: Progress,
) -> Measurements:
    """Measure every row on every set. `sets`: data sets by name. `rows`: (technique, settings) by label. Raises
    UsageError for an unknown technique or parameter. If a network or picture cannot be used, only its row fails."""
    outcome = Measurements({}, {}, {})
    for name, dataset in sets.items():
        results = []
        for label, (technique_name, settings) in rows.items():
            technique, gate = create(technique_name, settings), open_salience_gate(salience)
            try:
                answers, not_done = answer_queries(technique, dataset, options, progress, gate)
            except (ModelError, ImageError) as error:  # the other rows continue
                outcome.failed[name, label] = error
            else:
                result = summarise(technique, dataset, answers, options, not_done)
                results.append(replace(result, technique=label))
                outcome.answers[name, label] = answers
        outcome.measured[name] = add_pcu(results)
    return outcome
