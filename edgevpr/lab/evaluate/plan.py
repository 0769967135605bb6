"""Plan of an evaluation: every row (a technique with its settings) is measured on every data set. A plan is read from
the sections `sets` and `rows` of a YAML file, or made from flags of `edgevpr eval`; `many` carries it out."""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from edgevpr.core.config import bounded, build, key
from edgevpr.core.errors import ConfigError
from edgevpr.core.text import meant
from edgevpr.core.yamlfile import read_yaml
from edgevpr.lab.evaluate.dataset import Dataset, Nearness, load_dataset, match_positions, open_folder
from edgevpr.lab.evaluate.evaluate import MatchOptions, Progress
from edgevpr.lab.evaluate.videos import extract_pictures
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

    def open(self, videos: Path, progress: Progress) -> Dataset:
        """Read the data set; pictures of a video are kept in the folder `videos`. Raises UsageError and SourceError as
        `open_folder` does, and EdgevprError as `extract_pictures` does."""
        if self.folder:
            return open_folder(self.folder, self)
        sides = self.query or "", self.ref or ""
        if self.ground_truth:
            return load_dataset(*sides, self.ground_truth)
        query, ref = (extract_pictures(Path(side), videos, self.rate_hz, progress) for side in sides)
        return match_positions(query, ref, self)


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
        if not isinstance(section, dict) or not section or not all(isinstance(keys, dict) for keys in section.values()):
            raise ConfigError(f"{where}: `{name}` needs at least one name, and below each name its keys, indented.")
    sets = {str(name): build(SetPlan, keys, where, f"sets.{name}.") for name, keys in sections["sets"].items()}
    rows = {str(name): build(RowPlan, keys, where, f"rows.{name}.") for name, keys in sections["rows"].items()}
    for name, plan in sets.items():
        if bool(plan.folder) == any((plan.query, plan.ref, plan.ground_truth)) or bool(plan.query) != bool(plan.ref):
            raise ConfigError(
                f"{where}: the set `{name}` needs either `folder`, which has its own ground truth, or `query` and "
                "`ref`, beside which `ground_truth` may stand."
            )
        folder, query, ref, truth = (
            path and str(base / path) for path in (plan.folder, plan.query, plan.ref, plan.ground_truth)
        )
        sets[name] = replace(plan, folder=folder, query=query, ref=ref, ground_truth=truth)
    return EvaluationPlan(sets, rows)
