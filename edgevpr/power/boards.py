"""Profiles of boards: hardware, power, and what edgevpr may use of them. Each is a YAML file in `profiles/`. This
module also detects the machine that it runs on. The flight, `edgevpr profile` and `edgevpr service` use it.

`root` is the root of the file system with /proc and /sys: another tree can stand in.
"""

import json
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from edgevpr.core.config import BUDGET_MB, HIGHEST_RATE_HZ, LOWEST_RATE_HZ, bounded, build
from edgevpr.core.errors import ConfigError
from edgevpr.core.files import shipped
from edgevpr.core.text import meant
from edgevpr.core.yamlfile import read_yaml
from edgevpr.power import machine, thermal

_ANY_MACHINE = "generic-x86"


@dataclass(frozen=True, slots=True, kw_only=True)
class MachineSpeed:
    """Speed of a machine relative to one core of the reference machine of `profiles/generic-x86.yaml` (None: unknown).

    `single`: one thread at integer and byte operations. `multi`: all cores together at such operations.
    `products`: one thread at matrix products. `passes`: one thread at passes over bytes.
    `arm64_mips`: million instructions per second of one thread of an aarch64 board (not relative).
    `verified`: True if `source` measured the figures on this very board.
    """

    single: float | None = bounded(0.0001, 100)
    multi: float | None = bounded(0.0001, 10_000)
    products: float | None = bounded(0.0001, 100)
    passes: float | None = bounded(0.0001, 100)
    arm64_mips: float | None = bounded(1, 1_000_000, default=None)
    verified: bool
    source: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Board:
    """Profile of a board.

    `idle_w`, `full_w`: power at the board's input, idle and with all cores busy (a and a + s in the thesis).
    `verified`: True if `source` measured this power on this very board.
    `rate_hz`: queries per second, unless the user sets another rate.
    `cpu_share` (of all cores), `budget_mb` (index of the map), `memory_max_mb` (whole process): what edgevpr may use.
    `thermal_limit_c`: degrees Celsius at which the board begins to slow down (None: read from its kernel).
    `technique`: used if the user names none, provided that it fits (None: the best that fits).
    `threads`: number of threads that a network may use.
    `recognised_by`, `machine`: a machine is this board if the model in its device tree contains the first text; the
    profile was written on the machine whose `machine.title` is the second (None: neither is known).
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
    threads: int = bounded(1, 64, default=1)
    machine: str | None = None


def board_names() -> tuple[str, ...]:
    """Return the names of the boards that come with edgevpr."""
    return tuple(sorted(path.stem for path in shipped("profiles").glob("*.yaml")))


def load_board(name: str, root: Path = Path("/")) -> Board:
    """Load the profile called `name`: "this" (the machine itself), one of `board_names()`, or the path of a YAML file.
    Raises ConfigError if there is no such board, or if the file is incomplete or invalid."""
    if name == "this":
        return _this_machine(root)
    if name.endswith((".yaml", ".yml")) or "/" in name:
        return _read(Path(name))
    if name in board_names():
        return _shipped(name)
    names = ["this", *board_names()]
    hint = meant(name, names, f"use {', '.join(names)}, or the path of a YAML file.")
    raise ConfigError(f"There is no board `{name}`: {hint}")


def detect(root: Path = Path("/")) -> dict[str, Any]:
    """Describe this machine: its `title`, `cpu`, `cores`, `ram_mb`, and `thermal_limit_c`, the degrees Celsius at which
    it begins to slow down; `usable_cores` and `ram_limit_mb`, what CPU affinity and control groups leave of them to
    this process; `board`, the name of its profile, and `model`, its name by its maker (None: unknown)."""
    cores, recognised = machine.cores_online(root), _recognised(root)
    return {
        "board": recognised.name if recognised else None,
        "model": machine.model(root) or machine.dmi_model(root),
        "cpu": machine.cpu(root),
        "cores": cores,
        "usable_cores": min(float(cores), machine.cores(root)),
        "ram_mb": machine.ram_mb(root),
        "ram_limit_mb": machine.ram_limit_mb(root),
        "thermal_limit_c": thermal.limit_c(root),
        "title": machine.title(root),
    }


def own_profile(speed: MachineSpeed, root: Path = Path("/")) -> Board:
    """Return a profile of this machine with the score `speed`. Its power is that of the shipped profile of its board,
    else relative (idle 0 W, full load 1 W). Memory and shares are those of `load_board("this")`."""
    board, model = _this_machine(root), machine.model(root)
    source = board.source if _recognised(root) else "relative figures (idle 0, full load 1 W): nobody has measured it"
    return replace(board, title=machine.title(root), recognised_by=model, source=source, benchmark_score=speed)


def profile_text(board: Board) -> str:
    """Return a profile as YAML text, which `load_board` can read."""
    # The name is that of the file. JSON values are valid YAML, whatever characters they contain.
    lines = [f"{key}: {json.dumps(value)}\n" for key, value in asdict(board).items() if key != "name"]
    about = f"# Written by edgevpr for the machine it ran on; profiles/{_ANY_MACHINE}.yaml explains it.\n\n"
    return about + "".join(lines)


def _recognised(root: Path) -> Board | None:
    """Return the shipped profile of the board whose device tree is below `root`; None if there is none."""
    model = (machine.model(root) or "").lower()
    known = map(_shipped, board_names() if model else ())
    return next((board for board in known if board.recognised_by and board.recognised_by.lower() in model), None)


def _shipped(name: str) -> Board:
    return _read(shipped("profiles") / f"{name}.yaml")


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
    """Return the profile of this machine's board, else generic-x86, with the cores and memory that are really there."""
    model, recognised = machine.model(root), _recognised(root)
    profile = recognised or _shipped(_ANY_MACHINE)
    title, speed = profile.title, profile.benchmark_score
    if model and not recognised:
        title = f"{model}, which has no profile: the figures of {_ANY_MACHINE}"
        unknown = f"nobody has measured a {model}"
        speed = MachineSpeed(single=None, multi=None, products=None, passes=None, verified=False, source=unknown)
    ram_mb = machine.ram_mb(root)
    # Keep the profile's shares, but of the memory that the machine really has; a control group may allow less.
    memory_max_mb = min(profile.memory_max_mb / profile.ram_mb * ram_mb, machine.ram_limit_mb(root))
    # The power model counts all cores of the machine, so a CPU quota lowers `cpu_share` and not the number of cores.
    cores = machine.cores_online(root)
    cpu_share = min(profile.cpu_share, machine.cores(root) / cores)
    return replace(
        profile,
        title=f"this machine ({title})",
        benchmark_score=speed,
        ram_mb=ram_mb,
        cores=cores,
        cpu_share=cpu_share,
        thermal_limit_c=profile.thermal_limit_c or thermal.limit_c(root),
        machine=machine.title(root),
        threads=max(1, min(profile.threads, round(cpu_share * cores))),
        budget_mb=memory_max_mb * profile.budget_mb / profile.memory_max_mb,
        memory_max_mb=memory_max_mb,
    )
