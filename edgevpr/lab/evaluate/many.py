"""Measures many rows (a technique with its settings) on many data sets in worker processes: `edgevpr eval --out`. Each
result is a file, and is not measured again, so a run that was interrupted can be continued."""

import json
import multiprocessing
import os
import signal
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

import edgevpr
from edgevpr.core.child import end_with_parent
from edgevpr.core.errors import EdgevprError, ModelError
from edgevpr.core.files import write_whole
from edgevpr.core.types import StageCost
from edgevpr.frames.images import list_images
from edgevpr.frames.positions import find_positions
from edgevpr.lab.evaluate import metrics
from edgevpr.lab.evaluate.asking import Progress, QueryAnswer
from edgevpr.lab.evaluate.dataset import Dataset
from edgevpr.lab.evaluate.evaluate import TechniqueResult, answered, compare, from_json, summary
from edgevpr.lab.evaluate.plan import EvaluationPlan, RowPlan
from edgevpr.lab.evaluate.provenance import key_of, machine, stamp, today, versions
from edgevpr.runtime.recognise.evidence import WITH_CONFIDENCE
from edgevpr.techniques import create

_LOOK_S = 1.0  # progress of the workers is looked at so often
_CALIBRATED_BY = 60  # pictures, or twice as many ahead
CURVE_TO = 25  # the largest K of the curve of recall@K
# Matrix products are small here: more threads make them slower. And a result must not depend on the number of workers.
_ENVIRONMENT = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}

# In a worker: for each row, how many pictures it has got done. Only the worker of a row writes its count, so that they
# need no lock, which a worker that is killed might hold.
_counts: list[Any] = []

Failures = dict[tuple[str, str], str]  # by the names of set and row: a sentence on why it was not measured


@dataclass(frozen=True, slots=True, kw_only=True)
class RowOnSet:
    """One row (named `label`) to measure on one set, with the settings of the technique for this set. `path` is the
    file of its result."""

    set_name: str
    label: str
    row: RowPlan
    settings: dict[str, str]
    dataset: Dataset
    path: Path

    @property
    def pictures(self) -> int:
        """About how many pictures it takes: the references, those to refine and calibrate by, and the queries."""
        references = len(self.dataset.references)
        again = min(references, _CALIBRATED_BY) if self.row.technique == WITH_CONFIDENCE else 0
        refined = references if again and self.settings.get("camera") == "nadir" else 0
        return references + refined + again + len(self.dataset.queries)


@dataclass(frozen=True, slots=True)
class MeasuredRow:
    """The result of the row `label` on a set, and the answers to all scored queries. `made` tells its origin: the date
    (UTC), the machine, the versions, and the number of workers that ran at once."""

    label: str
    result: TechniqueResult
    answers: tuple[QueryAnswer, ...]
    made: dict[str, Any]

    @property
    def recalls(self) -> list[float]:
        """Recall@1, recall@2 and so on to recall@`CURVE_TO`, or to as many as there are references."""
        ranks = np.array([answer.first_right for answer in self.answers])
        return [metrics.recall_at(k, ranks) for k in range(1, min(CURVE_TO, self.result.references) + 1)]


@dataclass(frozen=True, slots=True)
class Measurements:
    """Outcome of a run: its plan, the sets by name, the rows that were measured on each set (`found`), and why others
    `failed`."""

    plan: EvaluationPlan
    sets: dict[str, Dataset]
    found: dict[str, list[MeasuredRow]]
    failed: Failures

    @property
    def rows(self) -> list[MeasuredRow]:
        """The rows that were measured, of all sets."""
        return [row for rows in self.found.values() for row in rows]


def measure(plan: EvaluationPlan, folder: Path, workers: int, progress: Progress[Any]) -> Measurements:
    """Measure every row of `plan` on every set by `workers` processes. Results, and pictures of videos, are kept in
    `folder`. Raises EdgevprError for a set that cannot be read, UsageError for an unknown technique or parameter, and
    EdgevprError where a worker dies. A network or picture that cannot be used only makes its row fail."""
    sets = {name: each.open(folder / "videos", progress) for name, each in plan.sets.items()}
    failed: Failures = {}
    rows = list(_rows_on_sets(plan, sets, folder / "measured", failed))
    if left := [row for row in rows if not row.path.exists()]:
        (folder / "measured").mkdir(parents=True, exist_ok=True)
        counts = multiprocessing.RawArray("L", len(left))
        with _pool(min(workers, len(left)), counts) as pool:
            jobs = [pool.submit(_measured, row, workers, at) for at, row in enumerate(left)]
            pictures = [row.pictures for row in left]
            for _ in progress(_done(jobs, pictures, counts), sum(pictures), f"{len(left)} rows: pictures"):
                pass
            for job, row in zip(jobs, left, strict=True):
                if why := job.result():
                    failed[row.set_name, row.label] = why
    found = {
        name: _kept([row for row in rows if row.set_name == name and (name, row.label) not in failed]) for name in sets
    }
    return Measurements(plan, sets, found, failed)


def _rows_on_sets(plan: EvaluationPlan, sets: dict[str, Dataset], folder: Path, failed: Failures) -> Iterator[RowOnSet]:
    """Yield the rows on every set; write to `failed` those whose network cannot be used. The name of a result's file is
    the key of all that decides it: code, technique, settings, pictures and ground truth."""
    code = [stamp(path) for path in sorted(Path(edgevpr.__file__).parent.rglob("*.py"))]
    for name, dataset in sets.items():
        truth = [(query.path.name, sorted(query.right), sorted(query.ignored)) for query in dataset.queries]
        query_dir = dataset.queries[0].path.parent
        tables = filter(None, map(find_positions, (dataset.ref_dir, query_dir)))
        pictures = [stamp(path) for path in (*tables, *list_images(dataset.ref_dir), *list_images(query_dir))]
        for label, row in plan.rows.items():
            settings = row.settings(plan.sets[name].camera)
            try:
                spec = create(row.technique, settings).spec
            except ModelError as error:  # it stops no other row
                failed[name, label] = str(error)
                continue
            who = [spec.name, spec.parameters, spec.form, spec.model_sha256]
            key = key_of(code, versions(), pictures, truth, who, asdict(row))
            yield RowOnSet(
                set_name=name, label=label, row=row, settings=settings, dataset=dataset, path=folder / f"{key}.json"
            )


@contextmanager
def _pool(workers: int, counts: Any) -> Iterator[ProcessPoolExecutor]:
    """Context manager: a pool of workers that die with this process and are killed at once if it is interrupted."""
    os.environ.update(_ENVIRONMENT)
    pool = ProcessPoolExecutor(workers, multiprocessing.get_context("spawn"), _begin, (os.getpid(), counts))
    try:
        yield pool
        pool.shutdown()
    except BrokenProcessPool as error:
        raise EdgevprError(
            "A worker has ended; perhaps memory is short: run again, with fewer --workers; all that is done stays."
        ) from error
    finally:
        for child in multiprocessing.active_children():
            child.kill()
        pool.shutdown(cancel_futures=True)


def _done(jobs: Sequence[Future[Any]], pictures: Sequence[int], counts: Any) -> Iterator[None]:
    """Yield once for each of the `pictures` of every job that is done, as its worker counts them, until all jobs are
    done. What a job has left out counts as done with the job."""
    told, running = 0, set(jobs)
    while running:
        running = wait(running, timeout=_LOOK_S).not_done
        done = [of if job.done() else min(count, of) for job, of, count in zip(jobs, pictures, counts, strict=True)]
        yield from [None] * (sum(done) - told)
        told = sum(done)


def _begin(parent_pid: int, counts: Any) -> None:
    _counts.append(counts)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # only the parent process is to act on Ctrl-C
    end_with_parent(parent_pid)


def _measured(row: RowOnSet, workers: int, at: int) -> str | None:
    """In a worker: measure the row `at` on a set and write its file. Return what went wrong, None if nothing. Even an
    unexpected exception, such as one of a library, ends one row only."""

    def counted(items: Iterable[Any], total: int, label: str) -> Iterator[Any]:
        before = _counts[0][at]
        pictures = len(row.dataset.references) if label.endswith("refining") else total  # there the items are pairs
        for done, item in enumerate(items, start=1):
            yield item
            _counts[0][at] = before + pictures * done // max(total, done)

    try:
        technique = create(row.row.technique, row.settings)
        answers = answered(technique, row.dataset, row.row, counted)
        content = {
            "result": asdict(summary(technique, len(row.dataset.references), answers, row.row)),
            "answers": [asdict(answer) for answer in answers],
            "made": {"date": today(), "machine": machine(), "versions": versions(), "workers": workers},
        }
        write_whole(row.path, partial(Path.write_text, data=json.dumps(content), encoding="utf-8"))
    except EdgevprError as problem:
        return str(problem)
    except OSError as problem:
        return f"{row.path.parent} takes no more ({problem.strerror}): make room, and run again."
    except Exception as problem:
        return f"an unforeseen {type(problem).__name__} ({problem}): report it."
    return None


def _kept(rows: Sequence[RowOnSet]) -> list[MeasuredRow]:
    """Read the results of all rows on one set from their files. Their PCU depends on the slowest encoder there."""
    contents = [json.loads(row.path.read_text("utf-8")) for row in rows]
    results = [
        replace(from_json(each["result"]), technique=row.label) for row, each in zip(rows, contents, strict=True)
    ]
    return [
        MeasuredRow(result.technique, result, tuple(map(_answer, each["answers"])), each["made"])
        for result, each in zip(compare(results), contents, strict=True)
    ]


def _answer(content: dict[str, Any]) -> QueryAnswer:
    return QueryAnswer(**{**content, **{stage: StageCost(**content[stage]) for stage in ("encoding", "matching")}})
