"""Figures that `edgevpr profile --measure` has found on this machine, kept in a file with a description of the machine.

Figures of another machine, or of other versions of the measured software, are never used: the user is told, and the
techniques are tried anew.
"""

import contextlib
import json
import math
import os
import platform
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, astuple, dataclass, replace
from datetime import datetime, timezone
from importlib import metadata
from itertools import groupby
from pathlib import Path
from typing import Any

from edgevpr import techniques
from edgevpr.core.config import build
from edgevpr.core.errors import ConfigError, EdgevprError, UsageError
from edgevpr.core.files import own_folder, read_file, require_folder, write_whole
from edgevpr.frames.images import list_images, read_image
from edgevpr.power import machine
from edgevpr.power.boards import Board, MachineSpeed
from edgevpr.runtime.preflight.offers import Offer
from edgevpr.runtime.preflight.scale import is_same
from edgevpr.runtime.preflight.trial import Trial, model_of, trial_of, try_each

_FORMAT = 3  # 1 had no cost of a scan that is paid once, 2 times that passed
_MAX_FILE_BYTES = 10_000_000
_PICTURES = 8
_SAME_RAM = 0.02  # kernels keep some RAM for themselves, every version another amount
_PACKAGES = {
    "edgevpr": ("edgevpr",),
    "numpy": ("numpy",),
    "opencv": ("opencv-python-headless", "opencv-python", "opencv-contrib-python-headless", "opencv-contrib-python"),
    "onnxruntime": ("onnxruntime", "onnxruntime-gpu"),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class StoredFigures:
    """Figures of all techniques on one machine: the `date` (local time), the `pictures`, the `threads` of a network,
    what the machine is (`identity`) and how fast (`score`, by the micro-benchmark)."""

    date: str
    identity: dict[str, Any]
    pictures: str
    threads: int
    score: MachineSpeed
    trials: tuple[Trial, ...]

    def of(self, offer: Offer) -> Trial | None:
        """Return the stored trial of an offer; None where it was not measured, could not be used then, or has another
        network now."""
        for trial in self.trials:
            if trial.costs and trial.label == offer.label and _same_settings(trial, offer):
                try:
                    return trial if model_of(offer.name, offer.settings) == trial.model else None
                except EdgevprError:
                    return None
        return None


def _same_settings(trial: Trial, offer: Offer) -> bool:
    """Tell whether an offer asks for the settings that were tried: a setting that is named may be the default."""
    had = {**techniques.parameters(offer.name), **trial.parameters}
    return {**had, **offer.settings} == {**had, **trial.settings}


def default_path() -> Path:
    """Return the file in which figures are kept unless the user says otherwise."""
    return own_folder() / "measured.json"


def identity(root: Path = Path("/")) -> dict[str, Any]:
    """Return everything that the figures of a machine depend on."""
    return {
        "machine": machine.title(root),
        "cores": os.cpu_count(),
        "usable cores": machine.cores(root),
        "RAM in MB": round(machine.ram_mb(root)),
        "kernel": platform.release(),
        **{name: _version(packages) for name, packages in _PACKAGES.items()},
    }


def pictures_of(folder: str | None) -> tuple[list[Path], str]:
    """Choose up to eight images of a folder, spread over it, and a text that names them; without a folder, none, for
    generated ones.

    Raises SourceError for a folder without images, ImageError for one that cannot be used.
    """
    if folder is None:
        return [], f"{_PICTURES} generated pictures"
    images = list_images(folder)
    chosen = [images[i * len(images) // _PICTURES] for i in range(_PICTURES)] if len(images) > _PICTURES else images
    for path in chosen:
        read_image(path)
    return chosen, f"{len(chosen)} pictures of {folder}"


def measure_each(wanted: Iterable[Offer], threads: int, images: Sequence[Path]) -> Iterator[Trial]:
    """Try each offer thoroughly: on the pictures `images`, or on eight generated ones."""
    return try_each(wanted, threads, images, rounds=_PICTURES)


def micro_benchmark() -> MachineSpeed:
    """Measure how fast this machine is. Takes about two seconds."""
    from edgevpr.power import speed

    found = speed.score()
    figures = {name: float(f"{value:.3g}") for name, value in asdict(found).items()}
    source = "edgevpr's micro-benchmark, run on it; single and multi are means of both kinds"
    return MachineSpeed(**figures, verified=True, source=source)


def gathered(trials: Iterable[Trial], pictures: str, threads: int, score: MachineSpeed) -> StoredFigures:
    """Put together the figures of trials made just now on this machine."""
    now = datetime.now(timezone.utc).astimezone().isoformat(timespec="minutes")
    return StoredFigures(
        date=now, identity=identity(), pictures=pictures, threads=threads, score=score, trials=tuple(trials)
    )


def require_room(path: Path, make: bool) -> None:
    """Raise UsageError or EdgevprError where `save` could not write to `path`: before the measuring, not after it. With
    `make` the folder may be made."""
    if path.suffix != ".json":
        raise UsageError(f"{path}: the name of a file of figures ends in .json: choose such a name.")
    folder = path.resolve().parent
    if make:
        if not folder.is_absolute() or str(path).startswith("~"):
            raise UsageError(
                f"{path}: there is no home to keep figures in: set XDG_DATA_HOME, or give --out FILE.json."
            )
        folder.mkdir(parents=True, exist_ok=True)
    require_folder(path)
    if path.is_dir() or not os.access(folder, os.W_OK) or (path.exists() and not os.access(path, os.W_OK)):
        raise EdgevprError(f"{path} cannot be written: give another --out, or correct the permissions.")


def save(found: StoredFigures, path: Path) -> None:
    """Write the figures, completely or not at all."""
    text = json.dumps({"format": _FORMAT, **asdict(found)}, indent=1)
    write_whole(path, lambda unfinished: unfinished.write_text(text + "\n", "utf-8"))


def load(path: Path) -> tuple[StoredFigures | None, str | None]:
    """Read the figures of this machine; return None for figures that cannot be used, with a sentence that says why.

    Both are None where there is no file.
    """
    again = "the techniques are tried anew; `edgevpr profile --measure` replaces them."
    try:
        fields = json.loads(read_file(path, _MAX_FILE_BYTES))
        if fields.pop("format") != _FORMAT:
            return None, f"{path} is of another version of edgevpr: {again}"
        trials = tuple(trial_of(each) for each in fields["trials"])
        found = StoredFigures(**{**fields, "score": MachineSpeed(**fields["score"]), "trials": trials})
        _require_figures(found)
        different = _differences(found.identity, identity())
    except FileNotFoundError:
        return None, None
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError, ConfigError):
        return None, f"{path} holds no figures that can be read: {again}"
    if different:
        return None, f"The figures in {path} are of another machine or installation ({different}): {again}"
    return found, None


def _require_figures(found: StoredFigures) -> None:
    """Raise ConfigError, TypeError or ValueError for a file that has the form of figures but no valid numbers."""
    build(MachineSpeed, asdict(found.score), "score")
    for trial in found.trials:
        if not (isinstance(trial.settings, dict) and isinstance(trial.parameters, dict)):
            raise TypeError(f"the settings of {trial.label} are none")
        if costs := trial.costs:
            stages = [*astuple(costs.encode), *astuple(costs.match_per_place)]
            sizes = [costs.ram_bytes_per_place, costs.disk_bytes_per_place, costs.process_mb]
            above_0 = [*stages, *sizes, costs.sequence, costs.in_full]
            parts = [costs.scan_per_place, costs.scan_once, costs.compare_once]
            rest = [costs.encode_mb or 0.0, costs.candidates or 0, costs.waited]
            others = [*(value for part in parts for value in astuple(part)), *rest]
            if not (all(0 < each < math.inf for each in above_0) and all(0 <= each < math.inf for each in others)):
                raise ValueError(f"the costs of {trial.label} are no figures")


def _differences(there: dict[str, Any], here: dict[str, Any]) -> str:
    found = []
    for key, value in here.items():
        said = there.get(key)
        if key == "RAM in MB":
            if isinstance(said, int) and abs(said - value) <= _SAME_RAM * value:
                continue
        elif said == value:
            continue
        found.append(f"{key}: {said} there, {value} here")
    return ", ".join(found)


def known_and_tried(
    wanted: Iterable[Offer], board: Board, stored: StoredFigures | None
) -> Iterator[tuple[Trial, bool]]:
    """Yield each offer's trial, in the order of `wanted`, and True if it was stored; any other is tried now,
    quickly."""
    for _, forms in groupby(wanted, key=lambda offer: offer.name):
        known = [(offer, stored.of(offer) if stored else None) for offer in forms]
        tried = try_each([offer for offer, trial in known if trial is None], board.threads)
        for _, trial in known:
            if trial:
                yield trial, True
            elif now := next(tried, None):  # there is no further trial of a technique that cannot be used
                yield now, False


def scaled_from(here: Board, board: Board, stored: StoredFigures | None) -> Board:
    """Return the machine `here` with the score that its figures are scaled from, of the same kind as that of `board`.

    If `board` has a published score only (no `passes`) and that of `here` is verified, it is the profile's. Otherwise
    it is the micro-benchmark's, stored or run (two seconds).
    """
    published = here.benchmark_score.verified and board.benchmark_score.passes is None
    if is_same(here, board) or published:
        return here
    return replace(here, benchmark_score=stored.score if stored else micro_benchmark())


def _version(packages: tuple[str, ...]) -> str | None:
    for package in packages:
        with contextlib.suppress(metadata.PackageNotFoundError):
            return metadata.version(package)
    return None
