"""The boards that edgevpr knows, one YAML file each in `profiles/`: what they have, draw, and may spend on edgevpr."""

import os
from dataclasses import dataclass, field, replace
from pathlib import Path

from edgevpr.core.config import BUDGET_MB, HIGHEST_RATE_HZ, LOWEST_RATE_HZ, bounded, build
from edgevpr.core.errors import ConfigError
from edgevpr.core.files import shipped
from edgevpr.core.text import meant
from edgevpr.core.yamlfile import read_yaml
from edgevpr.power import machine, thermal

_ANY_MACHINE = "generic-x86"
_SAME_RAM = 1.02  # kernels keep some RAM for themselves, every version another amount


@dataclass(frozen=True, slots=True, kw_only=True)
class MachineSpeed:
    """Speed of a machine relative to one core of the reference, which `profiles/generic-x86.yaml` names (None:
    unknown).

    `single` is one thread at integer code and bytes, `multi` all cores together at the same; `products` and `passes`
    are one thread at matrix products and at passes over bytes, where they are known apart. `arm64_mips` is how many
    million instructions a second one thread of an aarch64 board runs. `verified` tells whether `source` measured it on
    this very board.
    """

    single: float | None = bounded(0.0001, 100)
    multi: float | None = bounded(0.0001, 10_000)
    products: float | None = bounded(0.0001, 100)
    passes: float | None = bounded(0.0001, 100)
    arm64_mips: float | None = field(default=None, metadata={"range": (1, 1_000_000)})
    verified: bool
    source: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Board:
    """A board's profile.

    `idle_w` and `full_w` are the thesis's a and a + s in watts at the board's input; `verified` tells whether `source`
    measured them on this very board. `cpu_share` (of all cores), `budget_mb` (index of the map) and `memory_max_mb`
    (whole process) are what edgevpr may take. `rate_hz` is the number of queries a second, unless the user says
    otherwise. `technique` is flown where none is named, if it fits (None: the best that fits). `threads` is how many a
    network may use. From `thermal_limit_c` on the board slows itself down (None: its kernel says where). A machine is
    this board if the model in its device tree contains `recognised_by`, or if its own title is `machine`: a profile
    that was written on a machine contains its title.
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
    rate_hz: float = bounded(LOWEST_RATE_HZ, HIGHEST_RATE_HZ)
    cpu_share: float = bounded(0.01, 1)
    budget_mb: float = bounded(*BUDGET_MB)
    memory_max_mb: float = bounded(1, 4_000_000)
    thermal_limit_c: float | None = bounded(30, 125)
    benchmark_score: MachineSpeed
    technique: str | None = None
    threads: int = field(default=1, metadata={"range": (1, 64)})
    machine: str | None = None


def board_names() -> tuple[str, ...]:
    """Return the names of the boards that come with edgevpr."""
    return tuple(sorted(path.stem for path in shipped("profiles").glob("*.yaml")))


def load_board(name: str, root: Path = Path("/")) -> Board:
    """Load the board called `name`: "this" (the machine itself), one of `board_names()`, or the path of a YAML file.

    Raises ConfigError for a board that does not exist, for an incomplete or invalid file, and for a file of this very
    machine that promises more memory than there is. `root` is where the machine's /proc and /sys are.
    """
    if name == "this":
        return _this_machine(root)
    if name in board_names():
        return _read(shipped("profiles") / f"{name}.yaml")
    if name.endswith((".yaml", ".yml")) or "/" in name:
        board, there_mb = _read(Path(name)), machine.ram_mb(root)
        if is_this_machine(board, root) and board.ram_mb > _SAME_RAM * there_mb:
            raise ConfigError(
                f"{name}: `ram_mb` is {board.ram_mb:g}, and this machine, whose profile it is, has {there_mb:.0f}: "
                "correct it."
            )
        return board
    names = ["this", *board_names()]
    hint = meant(name, names, f"use {', '.join(names)}, or the path of a YAML file.")
    raise ConfigError(f"There is no board `{name}`: {hint}")


def is_this_machine(board: Board, root: Path = Path("/")) -> bool:
    """Tell whether a profile is of the machine that this runs on."""
    model = machine.model(root)
    recognised = board.recognised_by and model and board.recognised_by.lower() in model.lower()
    return bool(recognised) or (board.machine is not None and board.machine == machine.title(root))


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
    """Return the profile of this machine's board, or of any machine, with the cores and the memory that are really
    there."""
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
            unknown = MachineSpeed(
                single=None,
                multi=None,
                products=None,
                passes=None,
                verified=False,
                source=f"nobody has measured a {model}",
            )
            profile = replace(profile, benchmark_score=unknown)
            title = f"this machine ({model}, which has no profile: the figures of {_ANY_MACHINE})"

    ram_mb = machine.ram_mb(root)
    # The profile's shares of the memory that is really there; a control group may allow less.
    memory_max_mb = min(profile.memory_max_mb / profile.ram_mb * ram_mb, machine.ram_limit_mb(root))
    # The power model speaks of all cores of the machine, so a quota lowers the share and not their number.
    cores = os.cpu_count() or 1
    cpu_share = min(profile.cpu_share, machine.cores(root) / cores)
    return replace(
        profile,
        title=title,
        ram_mb=ram_mb,
        cores=cores,
        cpu_share=cpu_share,
        thermal_limit_c=profile.thermal_limit_c or thermal.limit_c(root),
        machine=machine.title(root),
        threads=max(1, min(profile.threads, round(cpu_share * cores))),
        budget_mb=memory_max_mb * profile.budget_mb / profile.memory_max_mb,
        memory_max_mb=memory_max_mb,
    )
