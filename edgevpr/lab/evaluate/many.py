"""Measures many rows (a technique with its settings) on many data sets in worker processes: `edgevpr eval --out`. Each
result is a file, and is not measured again, so a run that was interrupted can be continued."""

import json
import multiprocessing
import os
import signal
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
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
from edgevpr.lab.evaluate.dataset import Dataset
from edgevpr.lab.evaluate.evaluate import Progress, QueryAnswer, answer_queries, iterate_silently, summarise
from edgevpr.lab.evaluate.plan import EvaluationPlan, RowPlan
from edgevpr.lab.evaluate.provenance import hash_parts, machine, stamp_file, today, versions
from edgevpr.techniques import create

CURVE_TO = 25  # the largest K of the curve of recall@K
# Matrix products are small here: more threads make them slower. And a result must not depend on the number of workers.
_ENVIRONMENT = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}

Failures = dict[tuple[str, str], str]  # by the names of set and row: a sentence on why it was not measured


@dataclass(frozen=True, slots=True, kw_only=True)
class _Job:
    """A row to measure on one set, with the settings of the technique for this set. `path`: file of the result."""

    label: str
    row: RowPlan
    settings: dict[str, str]
    dataset: Dataset
    path: Path


@dataclass(frozen=True, slots=True)
class MeasuredRow:
    """The result of the row `label` on a set, and the answers to all scored queries. `made` tells its origin: the date
    (UTC), the machine, the versions, and the number of workers that ran at once."""

    label: str
    result: metrics.TechniqueResult
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


def measure(plan: EvaluationPlan, folder: Path, workers: int, progress: Progress) -> Measurements:
    """Measure every row of `plan` on every set by `workers` processes. Results, and pictures of videos, are kept in
    `folder`. Raises EdgevprError for a set that cannot be read, UsageError for an unknown technique or parameter, and
    EdgevprError where a worker dies. A network or picture that cannot be used only makes its row fail."""
    sets = {name: set_plan.open(folder / "videos", progress) for name, set_plan in plan.sets.items()}
    results = folder / "measured"
    failed: Failures = {}
    jobs = {name: list(_plan_jobs(plan, name, dataset, results, failed)) for name, dataset in sets.items()}
    if left := [(name, job) for name in jobs for job in jobs[name] if not job.path.exists()]:
        results.mkdir(parents=True, exist_ok=True)
        with _open_pool(min(workers, len(left))) as pool:
            futures = {pool.submit(_measure_job, job, workers): (name, job.label) for name, job in left}
            for future in progress(as_completed(futures), len(futures), "measuring rows"):
                if why := future.result():
                    failed[futures[future]] = why
    found = {name: _read_results([job for job in jobs[name] if (name, job.label) not in failed]) for name in sets}
    return Measurements(plan, sets, found, failed)


def _plan_jobs(plan: EvaluationPlan, name: str, dataset: Dataset, folder: Path, failed: Failures) -> Iterator[_Job]:
    """Yield the jobs on the set `name`; write to `failed` those whose network cannot be used. The name of a result's
    file is the hash of all that decides it: code, technique, settings, pictures and ground truth."""
    code = [stamp_file(path) for path in sorted(Path(edgevpr.__file__).parent.rglob("*.py"))]
    folders = dataset.ref_dir, dataset.queries[0].path.parent
    files = [path for side in folders for path in (find_positions(side), *list_images(side)) if path]
    truth = [(query.path.name, sorted(query.right), sorted(query.ignored)) for query in dataset.queries]
    for label, row in plan.rows.items():
        settings = row.settings(plan.sets[name].camera)
        try:
            spec = create(row.technique, settings).spec
        except ModelError as error:  # it stops no other row
            failed[name, label] = str(error)
            continue
        technique = [spec.name, spec.parameters, spec.form, spec.model_sha256, asdict(row)]
        parts = hash_parts(code, versions(), list(map(stamp_file, files)), truth, technique)
        path = folder / f"{parts}.json"
        yield _Job(label=label, row=row, settings=settings, dataset=dataset, path=path)


@contextmanager
def _open_pool(workers: int) -> Iterator[ProcessPoolExecutor]:
    """Context manager: a pool of workers that die with this process and are killed at once if it is interrupted."""
    os.environ.update(_ENVIRONMENT)
    pool = ProcessPoolExecutor(workers, multiprocessing.get_context("spawn"), _begin_worker, (os.getpid(),))
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


def _begin_worker(parent_pid: int) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # only the parent process is to act on Ctrl-C
    end_with_parent(parent_pid)


def _measure_job(job: _Job, workers: int) -> str | None:
    """In a worker: measure a row on a set and write its file. Return what went wrong, None if nothing. Even an
    unexpected exception, such as one of a library, ends one row only."""
    try:
        technique = create(job.row.technique, job.settings)
        answers = answer_queries(technique, job.dataset, job.row, iterate_silently)
        content = {
            "result": asdict(summarise(technique, job.dataset, answers, job.row)),
            "answers": [asdict(answer) for answer in answers],
            "made": {"date": today(), "machine": machine(), "versions": versions(), "workers": workers},
        }
        write_whole(job.path, partial(Path.write_text, data=json.dumps(content), encoding="utf-8"))
    except EdgevprError as problem:
        return str(problem)
    except OSError as problem:
        return f"{job.path.parent} takes no more ({problem.strerror}): make room, and run again."
    except Exception as problem:
        return f"an unforeseen {type(problem).__name__} ({problem}): report it."
    return None


def _read_results(jobs: Sequence[_Job]) -> list[MeasuredRow]:
    """Read the results of all rows on one set from their files. Their PCU depends on the slowest encoder there."""
    contents = [json.loads(job.path.read_text("utf-8")) for job in jobs]
    results = [
        replace(metrics.from_json(content["result"]), technique=job.label)
        for job, content in zip(jobs, contents, strict=True)
    ]
    return [
        MeasuredRow(result.technique, result, tuple(map(_read_answer, content["answers"])), content["made"])
        for result, content in zip(metrics.compare(results), contents, strict=True)
    ]


def _read_answer(content: dict[str, Any]) -> QueryAnswer:
    return QueryAnswer(**{**content, **{stage: StageCost(**content[stage]) for stage in ("encoding", "matching")}})
