"""Measures many rows (a technique with its settings) on many data sets in worker processes: `edgevpr eval --out`. Each
result is a file in a cache and is not measured again, so a run that was interrupted can be continued."""

import json
import multiprocessing
import os
import signal
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from edgevpr.core.child import end_with_parent
from edgevpr.core.contract import Technique
from edgevpr.core.errors import EdgevprError, ModelError
from edgevpr.core.files import sha256_of
from edgevpr.core.types import StageCost
from edgevpr.frames.images import list_images
from edgevpr.frames.positions import find_positions
from edgevpr.frames.source import open_source
from edgevpr.lab.evaluate import metrics
from edgevpr.lab.evaluate.asking import Progress, QueryAnswer
from edgevpr.lab.evaluate.cache import Cache, code_of_everything, key_of
from edgevpr.lab.evaluate.dataset import Dataset, ScoredQuery
from edgevpr.lab.evaluate.evaluate import (
    TechniqueResult,
    all_frames,
    answers_on,
    compare,
    from_json,
    make_map,
    summary,
)
from edgevpr.lab.evaluate.plan import EvaluationPlan, RowPlan, SetPlan
from edgevpr.lab.evaluate.provenance import machine, today, versions
from edgevpr.places.sequence import length_of
from edgevpr.techniques import create

CURVE_TO = 25  # the largest K of the curve of recall@K
# Matrix products are small here: more threads make them slower. And a result must not depend on the number of workers.
_ENVIRONMENT = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}

Failures = dict[tuple[str, str], str]  # by the names of set and row: a sentence on why it was not measured


@dataclass(frozen=True, slots=True, kw_only=True)
class OpenSet:
    """A data set that was read, with two parts of cache keys: `references_key` hashes all of the set that decides its
    map, `queries_key` the queries and their ground truth."""

    name: str
    plan: SetPlan
    dataset: Dataset
    references_key: str
    queries_key: str


@dataclass(frozen=True, slots=True, kw_only=True)
class RowOnSet:
    """One row (named `label`) to measure on one set, `of`. `key` is the cache key of its result, `map_key` that of its
    map, which other rows may share. `is_in_order` is True if an answer may depend on the queries before it."""

    of: OpenSet
    label: str
    row: RowPlan
    key: str
    map_key: str
    is_in_order: bool

    @property
    def name(self) -> tuple[str, str]:
        """The names of the set and of the row."""
        return self.of.name, self.label

    def technique(self) -> Technique:
        """Make the technique, with its settings for this set."""
        return create(self.row.technique, self.row.settings(self.of.plan.camera))


@dataclass(frozen=True, slots=True, kw_only=True)
class Made:
    """Origin of a result: the date (UTC) of its measurement, the machine and the versions at that time, the number of
    `workers` that ran at once, and whether it `was_kept` in the cache by an earlier run."""

    date: str
    machine: dict[str, Any]
    versions: dict[str, str | None]
    workers: int
    was_kept: bool = False

    @property
    def story(self) -> str:
        """The date, the machine and the version of edgevpr, in a few words."""
        earlier = "earlier, " if self.was_kept else ""
        cores = f"{self.machine['cpu']}, {self.workers} of {self.machine['cores']} cores"
        return f"{earlier}{self.date}, {cores}, edgevpr {self.versions['edgevpr']}"


@dataclass(frozen=True, slots=True, kw_only=True)
class MeasuredRow:
    """The result of the row `label` on a set. `recalls` are recall@1, recall@2 and so on to recall@`CURVE_TO`, or to as
    many as there are references. `answers` are those to all scored queries."""

    set_name: str
    label: str
    result: TechniqueResult
    recalls: tuple[float, ...]
    answers: tuple[QueryAnswer, ...]
    made: Made


@dataclass(frozen=True, slots=True, kw_only=True)
class Measurements:
    """Outcome of a run: its sets, the rows on sets that were measured (`found`), and why others `failed`."""

    sets: tuple[OpenSet, ...]
    found: tuple[MeasuredRow, ...]
    failed: Failures


def measure(plan: EvaluationPlan, folder: str | Path, workers: int, progress: Progress[Any]) -> Measurements:
    """Measure every row of `plan` on every set by `workers` processes, with the cache in `folder`. Raises EdgevprError
    for a set that cannot be read, and where a worker dies. A technique or picture that cannot be used only makes its
    row fail."""
    cache = Cache(folder)
    sets = tuple(_open_set(name, each, cache, progress) for name, each in plan.sets.items())
    rows, failed = _rows_on_sets(plan, sets)
    found = {
        row.name: replace(kept, made=replace(kept.made, was_kept=True)) for row in rows if (kept := _kept(cache, row))
    }
    if left := [row for row in rows if row.name not in found]:
        failed |= _measured_by_workers(left, cache, workers, progress)
        for row in left:
            if row.name not in failed and (measured := _kept(cache, row)):
                found[row.name] = measured
    wanted = [(of.name, label) for of in sets for label in plan.rows]
    return Measurements(
        sets=sets,
        found=_compared([found[name] for name in wanted if name in found]),
        failed={name: failed[name] for name in wanted if name in failed},
    )


def _open_set(name: str, plan: SetPlan, cache: Cache, progress: Progress[Any]) -> OpenSet:
    """Read a data set and hash it; pictures of its videos are cached. Raises EdgevprError if it cannot be used."""
    dataset = plan.open(cache, progress)
    positions = find_positions(dataset.ref_dir)
    asked = list_images(dataset.queries[0].path.parent)
    truth = [[query.path.name, sorted(query.right), sorted(query.ignored)] for query in dataset.queries]
    return OpenSet(
        name=name,
        plan=plan,
        dataset=dataset,
        references_key=key_of(
            dataset.references,
            [sha256_of(path) for path in list_images(dataset.ref_dir)],
            positions and sha256_of(positions),
        ),
        queries_key=key_of(truth, {path.name: sha256_of(path) for path in asked}),
    )


def _rows_on_sets(plan: EvaluationPlan, sets: Iterable[OpenSet]) -> tuple[list[RowOnSet], Failures]:
    """Return two parts: the rows, on every set, that can be measured;
    the reasons why others cannot."""
    rows, failed = [], {}
    techniques: dict[str, Technique] = {}
    for of in sets:
        for label, row in plan.rows.items():
            settings = row.settings(of.plan.camera)
            who = key_of(row.technique, settings)
            try:
                technique = techniques.get(who) or techniques.setdefault(who, create(row.technique, settings))
            except ModelError as error:  # a network that cannot be used stops no other row
                failed[of.name, label] = str(error)
                continue
            spec = technique.spec
            # Without the form of the vectors: all forms are made from one map.
            map_parts = [code_of_everything(), spec.name, spec.parameters, spec.model_sha256, of.references_key]
            rows.append(
                RowOnSet(
                    of=of,
                    label=label,
                    row=row,
                    key=key_of(map_parts, spec.form, asdict(row), of.queries_key),
                    map_key=key_of(map_parts),
                    is_in_order=row.follow or length_of(spec, row.sequence) > 1,
                )
            )
    return rows, failed


def _measured_by_workers(rows: Sequence[RowOnSet], cache: Cache, workers: int, progress: Progress[Any]) -> Failures:
    """Let workers make the maps and then ask the queries; cache each result. Return why some rows have none."""
    maps = {row.map_key: row for row in rows}
    failed: dict[str, str] = {}  # by the key of a map or of a row
    with _pool(min(workers, len(rows))) as pool:
        jobs = {pool.submit(_make_map, row, cache.folder): key for key, row in maps.items()}
        for job in progress(as_completed(jobs), len(jobs), "maps"):
            if why := job.result():
                failed[jobs[job]] = why
        left = {row.key: row for row in rows if row.map_key not in failed}
        parts: dict[str, list[Future[list[QueryAnswer] | str]]] = {}
        for key, row in left.items():
            shares = _shared_out(row, max(1, workers // len(left)))
            parts[key] = [pool.submit(_ask, row, cache.folder, queries) for queries in shares]
        asked = {part: key for key, several in parts.items() for part in several}
        for part in progress(as_completed(asked), len(asked), f"rows, {len(left)} of {len(rows)}"):
            key = asked[part]
            if key in parts and all(each.done() for each in parts[key]):
                answers: list[QueryAnswer] = []
                for found in (each.result() for each in parts.pop(key)):
                    if isinstance(found, str):
                        failed[key] = found
                    else:
                        answers += found
                if key not in failed:
                    _keep(cache, left[key], answers, workers)
    return {row.name: why for row in rows if (why := failed.get(row.map_key) or failed.get(row.key))}


def _shared_out(row: RowOnSet, count: int) -> list[tuple[ScoredQuery, ...]]:
    """Split the queries of a row into at most `count` parts, one a worker. There is one part if their order matters."""
    queries = row.of.dataset.queries
    size = len(queries) if row.is_in_order else -(-len(queries) // count)
    return [queries[at : at + size] for at in range(0, len(queries), size)]


@contextmanager
def _pool(workers: int) -> Iterator[ProcessPoolExecutor]:
    """Context manager: a pool of workers that die with this process and are killed at once if it is interrupted."""
    os.environ.update(_ENVIRONMENT)
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(workers, context, _begin, (os.getpid(),))
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


def _begin(parent_pid: int) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # only the parent process is to act on Ctrl-C
    end_with_parent(parent_pid)


def _make_map(row: RowOnSet, folder: Path) -> str | None:
    """In a worker: make the map of a row if the cache (`folder`) lacks it. Return what went wrong, None if nothing."""
    images = row.of.dataset.ref_dir

    def make(path: Path) -> None:
        make_map(path, all_frames(open_source(str(images), live=False)), row.technique(), images)

    try:
        Cache(folder).keep("maps", row.map_key, make)
    except Exception as problem:
        return _sentence(problem)
    return None


def _ask(row: RowOnSet, folder: Path, queries: tuple[ScoredQuery, ...]) -> list[QueryAnswer] | str:
    """In a worker: ask `queries` on the cached map of a row. Return the answers, or a text on what went wrong."""
    try:
        path = Cache(folder).path("maps", row.map_key)
        dataset = replace(row.of.dataset, queries=queries)
        return answers_on(path, row.technique(), dataset, row.row)
    except Exception as problem:
        return _sentence(problem)


def _sentence(problem: Exception) -> str:
    """Describe `problem` as a text. Even an unexpected exception, such as one of a library, ends one row only."""
    if isinstance(problem, EdgevprError):
        return str(problem)
    return f"an unforeseen {type(problem).__name__} ({problem}): report it."


def _keep(cache: Cache, row: RowOnSet, answers: Sequence[QueryAnswer], workers: int) -> None:
    """Sum up the answers to all queries of a row, and cache the result."""
    technique, references = row.technique(), len(row.of.dataset.references)
    ranks = np.array([answer.first_right for answer in answers])
    made = Made(date=today(), machine=machine(), versions=versions(), workers=workers)
    result = summary(technique, references, answers, length_of(technique.spec, row.row.sequence))
    content = {
        "result": asdict(result),
        "recalls": [metrics.recall_at(k, ranks) for k in range(1, min(CURVE_TO, references) + 1)],
        "answers": [asdict(answer) for answer in answers],
        "made": asdict(made),
    }
    cache.keep("results", row.key, lambda path: path.write_text(json.dumps(content), "utf-8"))


def _kept(cache: Cache, row: RowOnSet) -> MeasuredRow | None:
    """Return the cached result of a row on a set; None if there is none. A damaged file is deleted: None as well."""
    path = cache.path("results", row.key)
    try:
        content = json.loads(path.read_text("utf-8"))
        return MeasuredRow(
            set_name=row.of.name,
            label=row.label,
            result=replace(from_json(content["result"]), technique=row.label),
            recalls=tuple(content["recalls"]),
            answers=tuple(_answer(each) for each in content["answers"]),
            made=Made(**content["made"]),
        )
    except FileNotFoundError:
        return None
    except (ValueError, KeyError, TypeError):  # damaged: it is measured anew
        path.unlink(missing_ok=True)
        return None


def _answer(content: dict[str, Any]) -> QueryAnswer:
    return QueryAnswer(**{**content, **{stage: StageCost(**content[stage]) for stage in ("encoding", "matching")}})


def _compared(found: Sequence[MeasuredRow]) -> tuple[MeasuredRow, ...]:
    """Return the rows with the PCU (see `metrics.pcu`) filled in. It depends on the slowest encoder on each set."""
    done: list[MeasuredRow] = []
    for name in dict.fromkeys(row.set_name for row in found):
        of_set = [row for row in found if row.set_name == name]
        results = compare(row.result for row in of_set)
        done += [replace(row, result=result) for row, result in zip(of_set, results, strict=True)]
    return tuple(done)
