"""Many rows on many sets: what is kept from earlier runs is taken, the rest is shared out to workers, and goes on where
an earlier run broke off."""

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, dataclass, field, replace
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from edgevpr.core.crew import Crew
from edgevpr.core.errors import ModelError
from edgevpr.lab.evaluate.asking import Answer, in_order
from edgevpr.lab.evaluate.evaluate import compare
from edgevpr.lab.evaluate.kept import Kept
from edgevpr.lab.evaluate.measured import (
    Measured,
    OpenSet,
    Pair,
    answer_from_kept,
    as_kept,
    from_kept,
    made_now,
    measured,
    open_set,
    pair_of,
)
from edgevpr.lab.evaluate.plan import Plan
from edgevpr.techniques import create

_WORKER = "edgevpr.lab.evaluate.worker"
# Products are small here: more threads make them slower. And a result must not depend on the number of workers.
_ENVIRONMENT = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
_CHUNK = 16  # pictures of one job: no worker is without work for long at the end

Shown = Callable[[Iterable[None], int, str], Iterable[None]]


@dataclass(frozen=True, slots=True, kw_only=True)
class Outcome:
    """All that was measured, the sets it was measured on, and by (set, row) why others were not. `damaged` entries of
    the cache were made anew."""

    sets: tuple[OpenSet, ...]
    found: tuple[Measured, ...]
    failed: dict[tuple[str, str], str]
    damaged: int
    cache_bytes: int


@dataclass(slots=True, kw_only=True)
class _Map:
    """A map that is to be made or is there, and the pairs that ask it. `left` jobs are under way or wait."""

    pairs: list[Pair] = field(default_factory=list)
    left: int = 0


def measure(plan: Plan, cache: str | Path, workers: int, progress: Shown) -> Outcome:
    """Measure every row of a plan on every set. Raises EdgevprError for a set that cannot be read and for a full disk.
    A row whose technique, or a picture for it, cannot be used fails by itself."""
    kept = Kept(cache)
    sets = tuple(open_set(name, each, kept, progress) for name, each in plan.sets.items())
    run = _Run(kept, workers)
    pairs, failed = _pairs(plan, sets)
    run.failed |= failed
    for pair in pairs:
        run.take(pair)
    # A worker costs a second to start.
    if run.jobs:
        units = run.units
        with Crew(_WORKER, min(workers, len(run.jobs)), _ENVIRONMENT) as crew:
            for _ in progress(run.through(crew), units, f"{len(run.open)} of {len(pairs)} rows"):
                pass
    order = [(each.of.name, each.label) for each in pairs]
    return Outcome(
        sets=sets,
        found=_compared([run.found[each] for each in order if each in run.found]),
        failed={
            each: run.failed[each]
            for each in ((of.name, row) for of in sets for row in plan.rows)
            if each in run.failed
        },
        damaged=kept.damaged + run.damaged,
        cache_bytes=kept.size_bytes(),
    )


def _pairs(plan: Plan, sets: Iterable[OpenSet]) -> tuple[list[Pair], dict[tuple[str, str], str]]:
    found, failed = [], {}
    made: dict[str, Any] = {}
    for of in sets:
        for label, row in plan.rows.items():
            settings = row.settings(of.plan.camera)
            who = repr((row.technique, settings))
            try:
                technique = made.get(who) or made.setdefault(who, create(row.technique, settings))
                found.append(pair_of(of, label, row, technique, settings))
            except ModelError as error:  # a network that cannot be used stops no other row
                failed[of.name, label] = str(error)
    return found, failed


def _compared(found: list[Measured]) -> tuple[Measured, ...]:
    """Fill in the PCU, which measures each row against the slowest encoder on its set."""
    done = []
    for name in dict.fromkeys(each.set_name for each in found):
        of_set = [each for each in found if each.set_name == name]
        results = compare(each.result for each in of_set)
        done += [replace(each, result=result) for each, result in zip(of_set, results, strict=True)]
    return tuple(done)


class _Run:
    """The work that is left, job by job. Asking waits for the map, and the map for the descriptors."""

    def __init__(self, kept: Kept, workers: int) -> None:
        self._kept, self._workers = kept, workers
        self.jobs: deque[dict[str, Any]] = deque()
        self.found: dict[tuple[str, str], Measured] = {}
        self.failed: dict[tuple[str, str], str] = {}
        self.open: dict[str, list[Pair]] = {}  # by key: rows may differ in name only
        self.damaged = self.units = 0
        self._maps: dict[str, _Map] = {}
        self._asked: dict[str, int] = {}  # jobs of a pair that are left

    def take(self, pair: Pair) -> None:
        """Take the result of a pair from what is kept, or find out what is left to do for it."""
        if self._take_kept(pair):
            return
        if pair.key in self.open:
            self.open[pair.key].append(pair)
            return
        self.open[pair.key] = [pair]
        missing = self._missing(pair)
        self.units += len(missing)
        if not missing:  # killed between the last answer and its result
            self._finish(pair)
            return
        known = self._maps.get(pair.map_key)
        if known is None:
            known = self._maps[pair.map_key] = _Map()
            if self._kept.get_file("maps", pair.map_key) is None:
                paths = [str(path) for path in pair.of.references]
                jobs = [self._job("encode", pair, paths=part) for part in _parts(paths)]
                known.left = len(jobs)
                self.jobs.extend(jobs)
                self.units += 2 * len(paths)  # once to encode, once for the map
        known.pairs.append(pair)
        if not known.left:
            self._ask(pair)

    def _take_kept(self, pair: Pair) -> bool:
        """Take what stands under the key of a pair, for all rows that share it; return whether anything does."""
        if (content := self._kept.get_json("pairs", pair.key)) is None:
            return False
        for each in (*self.open.get(pair.key, ()), pair):
            self.found[each.of.name, each.label] = from_kept(each, content)
        return True

    def through(self, crew: Crew) -> Iterator[None]:
        """Have all jobs done; yield once for each picture that is done with."""
        while self.jobs or crew.is_working:
            while self.jobs and crew.has_idle:
                crew.give(self.jobs.popleft())
            job, answer = crew.next_done()
            self.damaged += answer["damaged"]
            for _ in range(self._done(job, answer["error"])):
                yield

    def _done(self, job: dict[str, Any], error: list[Any] | None) -> int:
        known, kind = self._maps[job["map_key"]], job["do"]
        if error:
            concerned = [pair for pair in known.pairs if kind != "ask" or pair.key == job["key"]]
            self._fail(concerned, error[0])
            return 0
        if kind == "encode":
            known.left -= 1
            if not known.left and (alive := self._alive(known.pairs)):
                known.left = 1
                self.jobs.appendleft(self._job("map", alive[0], ref_dir=str(alive[0].of.dataset.ref_dir)))
            return len(job["paths"])
        if kind == "map":
            known.left = 0
            for pair in self._alive(known.pairs):
                self._ask(pair)
            return len(known.pairs[0].of.references)
        self._asked[job["key"]] -= 1
        (pair, *_) = self.open[job["key"]]
        if not self._asked[job["key"]] and self._alive([pair]):
            self._finish(pair)
        return len(job["queries"])

    def _ask(self, pair: Pair) -> None:
        missing = self._missing(pair)
        if not missing:  # another run has asked them meanwhile
            self._finish(pair)
            return
        everything = [str(path) for path in in_order(pair.of.dataset)] if pair.is_in_order else None
        parts = [missing] if pair.is_in_order else _parts(missing)
        self._asked[pair.key] = len(parts)
        for part in parts:
            self.jobs.append(
                self._job(
                    "ask",
                    pair,
                    key=pair.key,
                    asking=asdict(pair.row.asking),
                    references=pair.of.dataset.references,
                    queries=part,
                    in_order=everything,
                )
            )

    def _missing(self, pair: Pair) -> list[list[Any]]:
        """List the queries that have no answer yet. Of those that are asked in order all are asked again: what came
        before decides an answer."""
        keys = {pair.answer_key(query): query for query in pair.of.dataset.queries}
        missing = [key for key in keys if self._kept.get_json("answers", key) is None]
        if missing and pair.is_in_order:
            missing = list(keys)
        return [[str(keys[key].path), key, sorted(keys[key].right), sorted(keys[key].ignored)] for key in missing]

    def _finish(self, pair: Pair) -> None:
        keys = [pair.answer_key(query) for query in pair.of.dataset.queries]
        entries = [self._kept.get_json("answers", key) for key in keys]
        if any(entry is None for entry in entries):
            # Another run may have finished the row, and have no more use for its answers.
            if not self._take_kept(pair):
                self._fail([pair], "answers are damaged or gone from the cache: run again, to ask them anew")
            return
        answers: list[Answer] = [answer_from_kept(entry[0]) for entry in entries]
        times_s = [t_s for _, *both in entries for t_s in both]
        story = made_now(_date(min(times_s)), _date(max(times_s)), self._workers)
        for each in self.open[pair.key]:
            self.found[each.of.name, each.label] = measured(each, answers, story)
        self._kept.put_json("pairs", pair.key, as_kept(self.found[pair.of.name, pair.label]))
        for key in keys:
            self._kept.drop("answers", key)

    def _fail(self, pairs: list[Pair], why: str) -> None:
        for pair in pairs:
            for each in self.open[pair.key]:
                self.failed[each.of.name, each.label] = why
        dead = {pair.key for pair in pairs}
        maps = {pair.map_key for pair in pairs if not self._alive(self._maps[pair.map_key].pairs)}
        self.jobs = deque(job for job in self.jobs if job.get("key") not in dead and job["map_key"] not in maps)

    def _alive(self, pairs: list[Pair]) -> list[Pair]:
        return [pair for pair in pairs if (pair.of.name, pair.label) not in self.failed]

    def _job(self, kind: str, pair: Pair, **more: Any) -> dict[str, Any]:
        return {
            "do": kind,
            "cache": str(self._kept.folder.resolve()),
            "technique": pair.row.technique,
            "settings": pair.settings,
            "map_key": pair.map_key,
            **more,
        }


def _parts(items: list[Any]) -> list[list[Any]]:
    return [items[at : at + _CHUNK] for at in range(0, len(items), _CHUNK)]


def _date(t_s: float) -> str:
    return datetime.fromtimestamp(t_s, timezone.utc).strftime("%Y-%m-%d")
