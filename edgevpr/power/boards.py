"""The boards that edgevpr knows, one YAML file each in `profiles/`: what they have, draw, and may spend on edgevpr."""

import difflib
import os
from dataclasses import dataclass, replace
from pathlib import Path

from edgevpr.config import bounded, build, read_yaml
from edgevpr.errors import ConfigError
from edgevpr.power import machine
from edgevpr.resources import shipped

_ANY_MACHINE = "generic-x86"


@dataclass(frozen=True, slots=True)
class Board:
    """A board's profile.

    `idle_w` and `full_w` are the thesis's a and a + s in watts at the board's input; `verified` is whether `source`
    measured them on this very board. `cpu_share` (of all cores), `budget_mb` (index of the map) and `memory_max_mb`
    (whole process) are what edgevpr may take; `rate_hz` is how often it is asked, unless the user says otherwise.
    `relative_speed` is the speed of one thread, 1 on the machine that `profiles/generic-x86.yaml` names, None where
    nobody has published it. A machine whose device tree's model contains `recognised_by` is this board.
    """

    name: str
    title: str
    recognised_by: str | None
    ram_mb: float = bounded(64, 4_000_000)
    cores: int = bounded(1, 1024)
    idle_w: float = bounded(0, 1000)
    full_w: float = bounded(0.01, 1000)
    verified: bool
    source: str
    rate_hz: float = bounded(0.01, 60)
    cpu_share: float = bounded(0.01, 1)
    budget_mb: float = bounded(1, 65_536)
    memory_max_mb: float = bounded(1, 4_000_000)
    relative_speed: float | None = bounded(0.001, 100)
    speed_verified: bool
    speed_source: str


def board_names() -> tuple[str, ...]:
    """Names of the boards that travel with edgevpr."""
    return tuple(sorted(path.stem for path in shipped("profiles").glob("*.yaml")))


def load_board(name: str, root: Path = Path("/")) -> Board:
    """The board called `name`: "this" (the machine itself), one of `board_names()`, or the path of a YAML file.

    Raises ConfigError for a board that is not there, and for a file that does not say what it must. `root` is where
    the machine's /proc and /sys are.
    """
    if name == "this":
        return _this_machine(root)
    if name in board_names():
        return _read(shipped("profiles") / f"{name}.yaml")
    if name.endswith((".yaml", ".yml")) or "/" in name:
        return _read(Path(name))
    near = difflib.get_close_matches(name, ["this", *board_names()], n=1)
    hint = (
        f"did you mean `{near[0]}`?" if near else f"use this, {', '.join(board_names())}, or the path of a YAML file."
    )
    raise ConfigError(f"There is no board `{name}`: {hint}")


def _read(path: Path) -> Board:
    board = build(Board, {"name": path.stem, **read_yaml(path)}, str(path))
    if board.full_w < board.idle_w:
        raise ConfigError(
            f"{path}: `full_w` is {board.full_w:g}, below `idle_w`, {board.idle_w:g}: correct one of them."
        )
    if not board.budget_mb <= board.memory_max_mb <= board.ram_mb:
        raise ConfigError(
            f"{path}: `budget_mb` ({board.budget_mb:g}) must fit in `memory_max_mb` ({board.memory_max_mb:g}), and "
            f"that in `ram_mb` ({board.ram_mb:g}): correct them."
        )
    return board


def _this_machine(root: Path) -> Board:
    """The profile of the board that this is, or of any machine, with the cores and the memory that are really there."""
    model = machine.model(root)
    profile = _read(shipped("profiles") / f"{_ANY_MACHINE}.yaml")
    if model is None:
        title = f"this machine ({profile.title})"
    else:
        known = (_read(shipped("profiles") / f"{name}.yaml") for name in board_names())
        recognised = next((b for b in known if b.recognised_by and b.recognised_by.lower() in model.lower()), None)
        if recognised:
            profile, title = recognised, f"this machine ({recognised.title})"
        else:
            profile = replace(profile, relative_speed=None, speed_source=f"nobody has measured a {model}")
            title = f"this machine ({model}, which has no profile: the figures of {_ANY_MACHINE})"

    ram_mb = machine.ram_mb(root)
    # The shares of the profile, of the memory that is there; a control group may allow less than that.
    memory_max_mb = min(profile.memory_max_mb / profile.ram_mb * ram_mb, machine.ram_limit_mb(root))
    # The power model speaks of all cores of the machine, so a quota lowers the share and not their number.
    cores = os.cpu_count() or 1
    return replace(
        profile,
        title=title,
        ram_mb=ram_mb,
        cores=cores,
        cpu_share=min(profile.cpu_share, machine.cores(root) / cores),
        budget_mb=memory_max_mb * profile.budget_mb / profile.memory_max_mb,
        memory_max_mb=memory_max_mb,
    )
