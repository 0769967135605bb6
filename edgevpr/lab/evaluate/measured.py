"""A row on a set: the keys of its work, and its result with the story of how it was measured."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

from edgevpr.core.contract import Technique
from edgevpr.core.files import sha256_of
from edgevpr.core.types import StageCost
from edgevpr.frames.images import list_images
from edgevpr.frames.positions import find_positions
from edgevpr.lab.evaluate.asking import Answer, Progress, rank_or_none, recall_curve
from edgevpr.lab.evaluate.dataset import Dataset, Query
from edgevpr.lab.evaluate.evaluate import TechniqueResult, from_json, summary
from edgevpr.lab.evaluate.kept import Kept, key_of
from edgevpr.lab.evaluate.plan import RowPlan, SetPlan
from edgevpr.lab.evaluate.provenance import code_of_everything, commit_of, machine, versions
from edgevpr.lab.evaluate.remembering import identity
from edgevpr.places.sequence import length_of

CURVE_TO = 25  # the curve of recall@K ends there


@dataclass(frozen=True, slots=True, kw_only=True)
class OpenSet:
    """A data set that was read: its name, the plan of it, its queries and references, and the hashes of all its
    files."""

    name: str
    plan: SetPlan
    dataset: Dataset
    hashes_of_references: tuple[str, ...]
    hashes_of_queries: dict[str, str]  # of all in the folder of the queries, by name

    @property
    def references(self) -> list[Path]:
        """The pictures of the references, in the order in which they are mapped."""
        return list_images(self.dataset.ref_dir)


def open_set(name: str, plan: SetPlan, kept: Kept, progress: Progress) -> OpenSet:
    """Read a data set; the pictures of a video are kept. Raises EdgevprError for one that cannot be used."""
    dataset = plan.open(kept, progress)
    positions = find_positions(dataset.ref_dir)
    hashes = [sha256_of(path) for path in list_images(dataset.ref_dir)]
    return OpenSet(
        name=name,
        plan=plan,
        dataset=dataset,
        hashes_of_references=(*hashes, *dataset.references, sha256_of(positions) if positions else ""),
        hashes_of_queries={path.name: sha256_of(path) for path in list_images(dataset.queries[0].path.parent)},
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Pair:
    """A row on a set, with the technique as it is set there, and the keys under which its work is kept: that of its
    result, and that of its map, which other rows may share."""

    of: OpenSet
    label: str
    row: RowPlan
    settings: dict[str, Any]
    technique: Technique
    key: str
    map_key: str

    @property
    def is_in_order(self) -> bool:
        """True where an answer may depend on the queries before it."""
        return self.row.follow or length_of(self.technique.spec, self.row.sequence) > 1

    def answer_key(self, query: Query) -> str:
        """Return the key of the answer to a query. Costs of two machines are never put together."""
        return key_of("answer", self.key, query.path.name, machine())


def pair_of(of: OpenSet, label: str, row: RowPlan, technique: Technique, settings: dict[str, Any]) -> Pair:
    """Name the work of a row on a set."""
    spec, dataset = technique.spec, of.dataset
    code = code_of_everything()
    truth = [[query.path.name, sorted(query.right), sorted(query.ignored)] for query in dataset.queries]
    asked = [of.hashes_of_queries, truth]
    return Pair(
        of=of,
        label=label,
        row=row,
        settings=settings,
        technique=technique,
        key=key_of("pair", code, identity(spec), spec.form, asdict(row.asking), of.hashes_of_references, asked),
        map_key=key_of("map", code, machine(), identity(spec), of.hashes_of_references),
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Made:
    """Story of a result: the dates (UTC) of its first and its last query, the machine, the versions and the
    commit at that time (None: no checkout), the `workers` that were busy beside each other, and whether it `was_kept`
    from an earlier run."""

    first: str
    last: str
    machine: dict[str, Any]
    versions: dict[str, str | None]
    commit: str | None
    workers: int
    was_kept: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class Measured:
    """The result of a row on a set, `recalls` at K from 1 on, all answers, and how it was made."""

    set_name: str
    label: str
    result: TechniqueResult
    recalls: tuple[float, ...]
    answers: tuple[Answer, ...]
    made: Made


def measured(pair: Pair, answers: Sequence[Answer], made: Made) -> Measured:
    """Sum up the answers to all queries."""
    references = len(pair.of.dataset.references)
    result = replace(
        summary(pair.technique, references, answers), sequence=length_of(pair.technique.spec, pair.row.sequence)
    )
    recalls = recall_curve(answers, min(CURVE_TO, references))
    return Measured(
        set_name=pair.of.name,
        label=pair.label,
        result=replace(result, technique=pair.label),
        recalls=recalls,
        answers=tuple(answers),
        made=made,
    )


def made_now(first: str, last: str, workers: int) -> Made:
    """Return the story of what was measured on this machine by this edgevpr."""
    return Made(first=first, last=last, machine=machine(), versions=versions(), commit=commit_of(), workers=workers)


def as_kept(found: Measured) -> dict[str, Any]:
    """Return a result as JSON holds it."""
    return {
        "result": asdict(found.result),
        "recalls": found.recalls,
        "answers": [answer_as_kept(each) for each in found.answers],
        "made": asdict(found.made),
    }


def from_kept(pair: Pair, content: dict[str, Any]) -> Measured:
    """Return a result that was kept, under the names that it has now."""
    return Measured(
        set_name=pair.of.name,
        label=pair.label,
        result=replace(from_json(content["result"]), technique=pair.label),
        recalls=tuple(content["recalls"]),
        answers=tuple(map(answer_from_kept, content["answers"])),
        made=Made(**{**content["made"], "was_kept": True}),
    )


def answer_as_kept(answer: Answer) -> dict[str, Any]:
    """Return an answer as JSON holds it."""
    return {**asdict(answer), "first_right": rank_or_none(answer.first_right)}


def answer_from_kept(content: dict[str, Any]) -> Answer:
    """Return an answer that was kept."""
    known = {each.name: content[each.name] for each in fields(Answer)}
    rank = known["first_right"]
    costs = {name: StageCost(**known[name]) for name in ("encoding", "matching")}
    return Answer(**{**known, **costs, "first_right": float("inf") if rank is None else float(rank)})
