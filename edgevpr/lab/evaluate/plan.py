"""Plan of an evaluation: every row (a technique with its settings) is measured on every data set. A plan is read from
the sections `sets` and `rows` of a YAML file, or made from flags of `edgevpr eval`; `many` carries it out."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeVar

from edgevpr import techniques
from edgevpr.core.config import FORMS, bounded, build
from edgevpr.core.errors import ConfigError
from edgevpr.core.text import meant
from edgevpr.core.yamlfile import read_yaml
from edgevpr.lab.evaluate.asking import MatchOptions, Progress
from edgevpr.lab.evaluate.cache import Cache
from edgevpr.lab.evaluate.dataset import Dataset, load_dataset
from edgevpr.lab.evaluate.layouts import Nearness, of_positions, open_folder
from edgevpr.lab.evaluate.videos import VideoPictures
from edgevpr.runtime.preflight.pick import camera_setting

CAMERAS = ("nadir", "forward")
T = TypeVar("T")


@dataclass(frozen=True, slots=True, kw_only=True)
class SetPlan(Nearness):
    """A data set of a plan: either a `folder` of any known layout, or the folders or videos `query` and `ref`. The
    right references are those in `ground_truth` (a CSV, only with `query` and `ref`) or in the folder's own ground
    truth; if there is neither, those near the query. `rate_hz` pictures a second are taken from a video (None: every
    frame). `camera` is "nadir" (looks straight down), "forward" (looks ahead) or None (unknown)."""

    folder: str | None = None
    query: str | None = None
    ref: str | None = None
    ground_truth: str | None = None
    camera: str | None = None
    rate_hz: float | None = bounded(0.001, 1000, default=None)

    def open(self, cache: Cache, progress: Progress[Any]) -> Dataset:
        """Read the data set; pictures of a video are kept in `cache`. Raises UsageError and SourceError as
        `open_folder` does, and EdgevprError as `VideoPictures` does."""
        pictures = VideoPictures(cache, self.rate_hz, progress)
        if self.folder:
            return open_folder(self.folder, self, pictures)
        if self.ground_truth:
            return load_dataset(self.query or "", self.ref or "", self.ground_truth)
        return of_positions(self.query or "", self.ref or "", self, pictures)


@dataclass(frozen=True, slots=True, kw_only=True)
class RowPlan(MatchOptions):
    """A row of the result tables: a technique, its parameters, the `form` of its vectors (see the glossary; None: that
    of the technique), and the options of matching."""

    technique: str
    parameters: dict[str, Any] = field(default_factory=dict)
    form: str | None = None

    def settings(self, camera: str | None) -> dict[str, Any]:
        """Return the settings of the technique, by name, for a set with this `camera` (None: unknown). A parameter of
        the row overrides the setting that follows from the camera."""
        form = {"form": self.form} if self.form else {}
        return {**camera_setting(self.technique, camera), **self.parameters, **form}


@dataclass(frozen=True, slots=True)
class EvaluationPlan:
    """All that is measured: every row on every set. Rows and sets are by their names."""

    sets: dict[str, SetPlan]
    rows: dict[str, RowPlan]


def read_plan(path: str | Path) -> EvaluationPlan:
    """Read a plan from a YAML file; relative paths in it start at the folder of the file. Raises ConfigError with file,
    key and what to do, and UsageError for an unknown technique or parameter."""
    content, where = read_yaml(path), str(path)
    for key in content:
        _require_one_of(key, ("sets", "rows"), f"{where}: unknown section")
    sections = {key: _sections(content, key, where) for key in ("sets", "rows")}
    sets = {name: build(SetPlan, each, where, f"sets.{name}.") for name, each in sections["sets"].items()}
    rows = {name: build(RowPlan, each, where, f"rows.{name}.") for name, each in sections["rows"].items()}
    return checked(EvaluationPlan({name: _below(Path(path).parent, each) for name, each in sets.items()}, rows), where)


def checked(plan: EvaluationPlan, where: str) -> EvaluationPlan:
    """Return `plan` if it can be measured. Raises ConfigError if not, and UsageError for an unknown technique or
    parameter. `where` names the origin of the plan in messages."""
    for name, each in plan.sets.items():
        if bool(each.folder) == bool(each.query and each.ref) or (each.folder and (each.query or each.ref)):
            raise ConfigError(f"{where}: the set `{name}` needs either `folder`, or `query` and `ref`: name them.")
        if each.folder and each.ground_truth:
            raise ConfigError(
                f"{where}: `sets.{name}.ground_truth` goes with `query` and `ref`: a folder has its own; leave it out."
            )
        if each.camera is not None:
            _require_one_of(each.camera, CAMERAS, f"{where}: `sets.{name}.camera` is")
    for name, row in plan.rows.items():
        _require_one_of(row.technique, techniques.names(), f"{where}: `rows.{name}.technique` is")
        known = techniques.parameters(row.technique)
        for key, value in row.parameters.items():
            if not isinstance(key, str) or isinstance(value, bool) or not isinstance(value, str | int | float):
                raise ConfigError(
                    f"{where}: `rows.{name}.parameters` has `{key!s:.80}: {value!r:.80}`: write a number or a word."
                )
            _require_one_of(key, known, f"{where}: `rows.{name}.parameters` has")
        if row.form is not None:
            _require_one_of(row.form, FORMS, f"{where}: `rows.{name}.form` is")
            if "form" not in known:
                raise ConfigError(f"{where}: {row.technique} has one form only: leave `rows.{name}.form` out.")
            if "form" in row.parameters:
                raise ConfigError(f"{where}: `rows.{name}` has its form twice: leave it out of the parameters.")
    return plan


def of_flags(folders: Sequence[str], chosen: dict[str, RowPlan], common: SetPlan) -> EvaluationPlan:
    """Make the plan of the command line: each of `folders` is a data set, and the rows `chosen` are measured on all.
    `common` has the settings of all sets; its `query` and `ref`, if given, are one more set. Sets are named by their
    folders."""
    sets: dict[str, SetPlan] = {}
    if common.query and common.ref:
        query, ref = (str(Path(each).resolve()) for each in (common.query, common.ref))
        sets[f"{Path(query).name} on {Path(ref).name}"] = replace(common, query=query, ref=ref)
    for folder in folders:
        path = Path(folder).resolve()
        name = path.name if path.name not in sets else str(path)
        sets[name] = replace(common, folder=str(path))
    return checked(EvaluationPlan(sets, chosen), "the command line")


def _sections(content: dict[str, Any], key: str, where: str) -> dict[str, dict[str, Any]]:
    section = content.get(key)
    if not isinstance(section, dict) or not section:
        raise ConfigError(f"{where}: the section `{key}` is missing or empty: name at least one below it, indented.")
    for name, each in section.items():
        if not isinstance(name, str) or not name.strip():
            raise ConfigError(f"{where}: `{key}` has the name {name!r:.80}: write a word, in quotes if it is a number.")
        if not isinstance(each, dict):
            raise ConfigError(f"{where}: `{key}.{name}` is a section: write its keys below it, indented.")
    return section


def _below(base: Path, each: SetPlan) -> SetPlan:
    def at(path: str | None) -> str | None:
        return None if path is None else str(base / path)

    return replace(
        each, folder=at(each.folder), query=at(each.query), ref=at(each.ref), ground_truth=at(each.ground_truth)
    )


def _require_one_of(value: object, known: Iterable[str], what: str) -> None:
    names = list(known)
    if value not in names:
        hint = meant(str(value)[:80], names, f"known: {', '.join(names) or 'none'}")
        raise ConfigError(f"{what} `{value!s:.80}` ({hint}).")
