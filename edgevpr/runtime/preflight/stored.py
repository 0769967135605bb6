"""Figures that `edgevpr profile --measure` has measured on this machine, stored in a file with a description of the
machine; and the profile that it writes.

Figures of another machine, or of other versions of the measured software, are never used: the user is told, and the
techniques are tried anew.
"""

import contextlib
import json
import os
import platform
import sys
from collections.abc import Iterable
from dataclasses import asdict, dataclass, replace
from datetime import datetime, timezone
from importlib import metadata
from pathlib import Path
from typing import Any

from edgevpr import __version__, techniques
from edgevpr.core.config import build
from edgevpr.core.errors import ConfigError, EdgevprError, UsageError
from edgevpr.core.files import own_folder, read_file, require_folder, write_whole
from edgevpr.power import machine
from edgevpr.power.boards import Board, MachineSpeed, own_profile, profile_text
from edgevpr.power.speed import micro_benchmark
from edgevpr.runtime.preflight.scale import is_same
from edgevpr.runtime.preflight.trial import Trial, model_of, trial_of

_FORMAT = 4  # another one for each change of `Trial` or `TechniqueCosts`
_MAX_FILE_BYTES = 10_000_000
_PACKAGES = ("numpy", "opencv", "onnxruntime")  # what the names of packages begin with that the times depend on


@dataclass(frozen=True, slots=True, kw_only=True)
class StoredFigures:
    """Figures of all techniques on one machine. `date`: local time of the measurement. `identity`: see `identity()`.
    `threads`: number of threads that networks used. `score`: the machine's speed by the micro-benchmark."""

    date: str
    identity: dict[str, Any]
    threads: int
    score: MachineSpeed
    trials: tuple[Trial, ...]

    def of(self, offer: Trial) -> Trial | None:
        """Return the stored trial of the technique and settings of `offer`, a trial not yet made. None if none was
        stored, if the technique could not be used then, or if it has another network now."""
        for trial in self.trials:
            if trial.costs and trial.label == offer.label and _same_settings(trial, offer):
                with contextlib.suppress(EdgevprError):
                    if model_of(offer.name, offer.settings) == trial.model:
                        return replace(trial, measured=True)
        return None


def default_path() -> Path:
    """Return the file in which figures are stored by default."""
    return own_folder() / "measured.json"


def identity(root: Path = Path("/")) -> dict[str, Any]:
    """Return everything that the figures of this machine depend on: hardware, kernel, and versions of software."""
    return {
        "machine": machine.title(root),
        "cores": os.cpu_count(),
        "usable cores": machine.cores(root),
        "kernel": platform.release(),
        "edgevpr": __version__,
        **{each.name: each.version for each in metadata.distributions() if (each.name or "").startswith(_PACKAGES)},
    }


def gathered(trials: Iterable[Trial], threads: int, score: MachineSpeed) -> StoredFigures:
    """Combine trials made just now with the date and the identity of this machine."""
    now = datetime.now(timezone.utc).astimezone().isoformat(timespec="minutes")
    return StoredFigures(date=now, identity=identity(), threads=threads, score=score, trials=tuple(trials))


def require_room(path: Path) -> None:
    """Check, before the measurement, that figures can be stored at `path`: raise UsageError if its name does not end in
    .json, or its folder does not exist. The folder of `default_path` is made if needed."""
    if path == default_path() and path.is_absolute():
        path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix != ".json":
        raise UsageError(f"{path}: the name of a file of figures ends in .json: choose such a name.")
    require_folder(path)


def save(figures: StoredFigures, path: Path) -> None:
    """Write the figures, completely or not at all."""
    text = json.dumps({"format": _FORMAT, **asdict(figures)}, indent=1)
    write_whole(path, lambda unfinished: unfinished.write_text(text + "\n", "utf-8"))


def load(path: Path) -> tuple[StoredFigures | None, str | None]:
    """Read the figures stored for this machine. Returns two things, both None if there is no file:
    - the figures (None: they cannot be used);
    - a sentence that says why they cannot be used (None: they can)."""
    again = "the techniques are tried anew; `edgevpr profile --measure` replaces them."
    try:
        fields = json.loads(read_file(path, _MAX_FILE_BYTES))
        if fields.pop("format") != _FORMAT:
            return None, f"{path} is of another version of edgevpr: {again}"
        fields["score"] = build(MachineSpeed, fields["score"], "score")
        fields["trials"] = tuple(map(trial_of, fields["trials"]))
        figures, here = StoredFigures(**fields), identity()
        both = {key: (figures.identity.get(key), here.get(key)) for key in {**here, **figures.identity}}
        different = [f"{key}: {there} there, {now} here" for key, (there, now) in both.items() if there != now]
    except FileNotFoundError:
        return None, None
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError, ConfigError):
        return None, f"{path} holds no figures that can be read: {again}"
    if different:
        return None, f"The figures in {path} are of another machine or installation ({', '.join(different)}): {again}"
    return figures, None


def scaled_from(here: Board, board: Board, stored: StoredFigures | None) -> Board:
    """Return the machine `here` with the speed score from which its figures are scaled to `board`. Both scores must be
    of one kind.

    If `board` has a published score only (no `passes`) and that of `here` is verified, the score in the profile of
    `here` is kept. Otherwise it is that of the micro-benchmark, stored or run now (two seconds).
    """
    published = here.benchmark_score.verified and board.benchmark_score.passes is None
    if is_same(here, board) or published:
        return here
    return replace(here, benchmark_score=stored.score if stored else micro_benchmark())


def write_profile(path: Path, board: Board) -> None:
    """Write a board's profile to a new file, completely or not at all. Raises UsageError if the name does not end in
    .yaml, the folder does not exist, or the file exists already."""
    if path.suffix not in (".yaml", ".yml"):
        raise UsageError(f"{path}: a profile's name ends in .yaml: choose such a name.")
    require_folder(path)
    try:
        write_whole(path, lambda unfinished: unfinished.write_text(profile_text(board), "utf-8"), instead=False)
    except FileExistsError:
        raise UsageError(f"{path} is there already: move it away, or choose another name.") from None


def measured_profile(figures: Path, score: MachineSpeed) -> tuple[Path | None, str]:
    """Measure idle and load power with this machine's power meter (minutes), and write a profile beside the file
    `figures`. Raises MeterError. Returns two things:
    - the path of the profile (None: there is no meter);
    - a sentence for the user."""
    from edgevpr.power.calibrate import NO_METER, calibrate, find_meters

    meter = next(iter(find_meters()), None)
    if meter is None:
        return None, NO_METER
    said = f"measuring power with the {meter.title}: load"
    fit = calibrate(meter, progress=lambda share: print(f"{said} {share:.0%}", file=sys.stderr))
    path = figures.with_name(f"{figures.stem}-{datetime.now():%Y%m%d-%H%M%S}.yaml")
    write_profile(path, fit.applied_to(own_profile(score), meter))
    return path, (
        f"Power: {fit.idle_w:.3g} W idle, {fit.full_w:.3g} W with every core busy, by the {meter.title} "
        f"(residual {fit.residual_w:.2g} W, R2 {fit.r2:.3f}); written to {path}: use it with --board {path}."
    )


def _same_settings(trial: Trial, offer: Trial) -> bool:
    """Return True if `offer` has the settings that `trial` was made with. A setting not named has its default."""
    had = {**techniques.parameters(offer.name), **trial.parameters}
    return {**had, **offer.settings} == {**had, **trial.settings}
