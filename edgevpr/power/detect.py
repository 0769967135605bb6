"""Detection of this machine, and a profile for a machine that has none.

Looks at the device tree (ARM boards), DMI (x86), the processor, and the limits of this process's control groups and
affinity. `root` is the root of the file system: another tree can stand in its place.
"""

from __future__ import annotations

import json
import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from edgevpr.power import machine
from edgevpr.power.boards import MachineSpeed, board_names, load_board
from edgevpr.power.thermal import limit_c

if TYPE_CHECKING:  # imports NumPy, which recognising a board does not need
    from edgevpr.power.calibrate import Calibration

_ANY_MACHINE = "generic-x86"


@dataclass(frozen=True, slots=True, kw_only=True)
class Detected:
    """Description of this machine. `board` is the name of its profile, None where it has none. `model` is its name in
    the device tree or DMI. `usable_cores` and `ram_limit_mb` are what affinity and control groups leave of `cores` and
    `ram_mb`. It begins to slow down at `thermal_limit_c`."""

    board: str | None
    model: str | None
    from_device_tree: bool
    cpu: str
    cores: int
    usable_cores: float
    ram_mb: float
    ram_limit_mb: float
    thermal_limit_c: float
    title: str


def detect(root: Path = Path("/")) -> Detected:
    """Look at this machine. Never guesses: a value that is found nowhere is None or says "unknown"."""
    tree_model = machine.model(root)
    cores = _cores(root)
    return Detected(
        board=_profile_of(tree_model),
        model=tree_model or machine.dmi_model(root),
        from_device_tree=tree_model is not None,
        cpu=machine.cpu(root),
        cores=cores,
        usable_cores=min(float(cores), machine.cores(root)),
        ram_mb=machine.ram_mb(root),
        ram_limit_mb=machine.ram_limit_mb(root),
        thermal_limit_c=limit_c(root),
        title=machine.title(root),
    )


def findings(found: Detected) -> tuple[str, ...]:
    """Say what this machine is, and how that was found, a sentence each."""
    if found.from_device_tree:
        said = f"The device tree calls it `{found.model}`"
    elif found.model:
        said = f"There is no device tree; its firmware (DMI) calls it `{found.model}`"
    else:
        said = "There is no device tree, and its firmware (DMI) does not name it"
    board = (
        f"that is the board {found.board}"
        if found.board
        else f"no board of edgevpr's is that: {_ANY_MACHINE} stands in"
    )
    cores = f"{found.cores} cores are switched on ({found.cpu})"
    if found.usable_cores < found.cores:
        cores += f"; affinity and control groups leave this process {found.usable_cores:.3g}"
    ram = f"{found.ram_mb:.0f} MB of RAM"
    if found.ram_limit_mb < found.ram_mb:
        ram += f"; its control group leaves this process {found.ram_limit_mb:.0f}"
    return (
        f"{said}: {board}.",
        f"{cores}.",
        f"{ram}.",
        f"It begins to slow down at {found.thermal_limit_c:g} degrees Celsius.",
    )


def profile_text(found: Detected, score: MachineSpeed | None = None, calibration: Calibration | None = None) -> str:
    """Write a whole profile for `found` as YAML, which `load_board` accepts.

    Its watts are the calibration's; without one those of the known board; else relative figures, marked as not
    measured. Its speed is the score's; without one the known board's; else unknown. Memory and shares are what the
    known board (or any machine) may take, within the limits of the control groups.
    """
    base = load_board(found.board or _ANY_MACHINE)
    if calibration:
        idle_w, full_w = calibration.fit.idle_w, calibration.fit.full_w
        verified, source = calibration.verified, calibration.source
    elif found.board:
        idle_w, full_w, verified, source = base.idle_w, base.full_w, base.verified, base.source
    else:
        idle_w, full_w, verified = 0.0, 1.0, False
        source = f"nobody has measured a {found.model or 'machine like this'}: relative figures (idle 0, full load 1 W)"
    if score:
        speed = score
    elif found.board:
        speed = base.benchmark_score
    else:
        speed = MachineSpeed(
            single=None, multi=None, products=None, passes=None, verified=False, source="nobody has measured it"
        )
    memory_max_mb = max(1.0, min(found.ram_mb * base.memory_max_mb / base.ram_mb, found.ram_limit_mb))
    budget_mb = max(1.0, memory_max_mb * base.budget_mb / base.memory_max_mb)
    cpu_share = max(0.01, min(base.cpu_share, found.usable_cores / found.cores))
    recognised_by = _quoted(found.model) if found.from_device_tree and found.model else "null"
    return f"""\
# Written by edgevpr for the machine it ran on. Name this file with --board PATH.

title: {_quoted(found.title)}
recognised_by: {recognised_by}
machine: {_quoted(found.title)}
ram_mb: {_floor(found.ram_mb)}
cores: {found.cores}

# Watts at the board's input, idle and with every core busy.
idle_w: {idle_w:.4g}
full_w: {full_w:.4g}
verified: {_word(verified)}
source: {_quoted(source)}

# What edgevpr may take: change it as the other programs of this machine need.
technique: {base.technique or "null"}
rate_hz: {base.rate_hz:g}
cpu_share: {cpu_share:.3g}
threads: {max(1, min(base.threads, int(cpu_share * found.cores)))}
budget_mb: {_floor(budget_mb)}
memory_max_mb: {_floor(memory_max_mb)}

# Where the machine begins to slow down, in degrees Celsius.
thermal_limit_c: {(found.board and base.thermal_limit_c) or found.thermal_limit_c:g}

# How fast it is beside one core of the reference: generic-x86.yaml says what each figure is.
benchmark_score:
  single: {_number(speed.single)}
  multi: {_number(speed.multi)}
  products: {_number(speed.products)}
  passes: {_number(speed.passes)}
  arm64_mips: {_number(speed.arm64_mips)}
  verified: {_word(speed.verified)}
  source: {_quoted(speed.source)}
"""


def _profile_of(model: str | None) -> str | None:
    for name in board_names() if model else ():
        by = load_board(name).recognised_by
        if by and by.lower() in model.lower():
            return name
    return None


def _cores(root: Path) -> int:
    """Count the cores of the machine that are switched on, whatever this process may use of them."""
    spans = re.findall(r"(\d+)(?:-(\d+))?", machine.text(root / "sys/devices/system/cpu/online") or "")
    return sum(int(last or first) - int(first) + 1 for first, last in spans) or os.cpu_count() or 1


def _quoted(text: str) -> str:
    """Quote a text so that YAML reads it back as it is, whatever a board is called: JSON's quotes are YAML's too."""
    return json.dumps("".join(c if c.isprintable() else " " for c in text), ensure_ascii=False)


def _floor(megabytes: float) -> str:
    """Round megabytes down and format them, so that what has to fit still fits."""
    return f"{int(megabytes * 10) / 10:g}" if megabytes < 1000 else f"{int(megabytes)}"


def _number(value: float | None) -> str:
    return "null" if value is None else f"{value:g}"


def _word(yes: bool) -> str:
    return "true" if yes else "false"
