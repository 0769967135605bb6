"""Plan of an evaluation: every row (a technique with its settings) is measured on every data set. A plan is read from
the sections `sets` and `rows` of a YAML file, or made from flags of `edgevpr eval`; `many` carries it out."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

from edgevpr.core.config import bounded, build, key
from edgevpr.core.errors import ConfigError
from edgevpr.core.text import meant
from edgevpr.core.yamlfile import read_yaml
from edgevpr.lab.evaluate.asking import MatchOptions, Progress
from edgevpr.lab.evaluate.dataset import Dataset, load_dataset
from edgevpr.lab.evaluate.layouts import Nearness, of_positions, open_folder
from edgevpr.lab.evaluate.numbered import KINDS, load_numbered
from edgevpr.lab.evaluate.videos import pictures_of
from edgevpr.runtime.preflight.pick import camera_setting


@dataclass(frozen=True, slots=True, kw_only=True)
class SetPlan(Nearness):
    """A data set of a plan: either a `folder` of any known layout, or the folders or videos `query` and `ref`. The
    right references are those in `ground_truth` (a file, only with `query` and `ref`) or in the folder's own ground
    truth; if there is neither, those near the query. `rate_hz` pictures a second are taken from a video (None: every
    frame). `camera` is "nadir" (looks straight down), "forward" (looks ahead) or None (unknown)."""

    folder: str | None = None
    query: str | None = None
    ref: str | None = None
    ground_truth: str | None = None
    camera: str | None = key(choices=("nadir", "forward"), default=None)
    rate_hz: float | None = bounded(0.001, 1000, default=None)

    def open(self, videos: Path, progress: Progress[Any]) -> Dataset:
        """Read the data set; pictures of a video are kept in the folder `videos`. Raises UsageError and SourceError as
        `open_folder` does, and EdgevprError as `pictures_of` does."""
        if self.folder:
            return open_folder(self.folder, self)
        if self.ground_truth:
            load = load_numbered if Path(self.ground_truth).suffix in KINDS else load_dataset
            return load(self.query or "", self.ref or "", self.ground_truth)
        pictures = partial(pictures_of, kept=videos, rate_hz=self.rate_hz, progress=progress)
        return of_positions(self.query or "", self.ref or "", self, pictures)


@dataclass(frozen=True, slots=True, kw_only=True)
class RowPlan(MatchOptions):
    """A row of the result tables: a technique, its parameters, the `form` of its vectors (see the glossary; None: that
    of the technique), and the options of matching."""

    technique: str
    parameters: dict[str, Any] = field(default_factory=dict)
    form: str | None = None

    def settings(self, camera: str | None) -> dict[str, str]:
        """Return the settings of the technique, by name, for a set with this `camera` (None: unknown). A parameter of
        the row overrides the setting that follows from the camera."""
        form = {"form": self.form} if self.form else {}
        chosen = {**camera_setting(self.technique, camera), **self.parameters, **form}
        return {str(key): str(value) for key, value in chosen.items()}


@dataclass(frozen=True, slots=True)
class EvaluationPlan:
    """All that is measured: every row on every set. Rows and sets are by their names."""

    sets: dict[str, SetPlan]
    rows: dict[str, RowPlan]


def read_plan(path: str | Path) -> EvaluationPlan:
    """Read a plan from a YAML file; relative paths in it start at the folder of the file. Raises ConfigError with file,
    key and what to do."""
    content, where, base = read_yaml(path), str(path), Path(path).parent
    sections = {"sets": content.pop("sets", None), "rows": content.pop("rows", None)}
    if content:
        unknown = str(next(iter(content)))[:80]
        raise ConfigError(f"{where}: unknown section `{unknown}` ({meant(unknown, sections, 'known: sets, rows')}).")
    for name, section in sections.items():
        if not isinstance(section, dict) or not section or not all(isinstance(each, dict) for each in section.values()):
            raise ConfigError(f"{where}: `{name}` needs at least one name, and below each name its keys, indented.")
    sets = {str(name): build(SetPlan, each, where, f"sets.{name}.") for name, each in sections["sets"].items()}
    rows = {str(name): build(RowPlan, each, where, f"rows.{name}.") for name, each in sections["rows"].items()}
    for name, each in sets.items():
        if bool(each.folder) == any((each.query, each.ref, each.ground_truth)) or bool(each.query) != bool(each.ref):
            raise ConfigError(
                f"{where}: the set `{name}` needs either `folder`, which has its own ground truth, or `query` and "
                "`ref`, beside which `ground_truth` may stand."
            )
        folder, query, ref, truth = (
            given and str(base / given) for given in (each.folder, each.query, each.ref, each.ground_truth)
        )
        sets[name] = replace(each, folder=folder, query=query, ref=ref, ground_truth=truth)
    return EvaluationPlan(sets, rows)


def of_flags(folders: Sequence[str], chosen: dict[str, RowPlan], common: SetPlan) -> EvaluationPlan:
    """Make the plan of the command line: each of `folders` is a data set, and the rows `chosen` (techniques with their
    settings) are measured on all. `common` has the settings of all sets; its `query` and `ref`, if given, are one more
    set, named by both folders. Raises ConfigError if `common` has a ground truth although there are `folders`."""
    sets: dict[str, SetPlan] = {}
    if common.query and common.ref:
        query, ref = (str(Path(each).resolve()) for each in (common.query, common.ref))
        sets[f"{Path(query).name} on {Path(ref).name}"] = replace(common, query=query, ref=ref)
    if folders and common.ground_truth:
        raise ConfigError("--ground-truth goes with --query and --ref: a folder of --data has its own.")
    for folder in folders:
        path = Path(folder).resolve()
        name = path.name if path.name not in sets else str(path)
        sets[name] = replace(common, folder=str(path), query=None, ref=None)
    return EvaluationPlan(sets, chosen)
