"""Costs of `cohog` on an ARM board that is not this machine.

Times are computed from the instruction counts of `make bench-arm64` and the instructions per second of one core of the
board (`arm64_mips` in its profile): they are for the board's own instruction set, and unaffected by other programs.
Memory is not converted. The costs of other techniques, and on other boards, are known only on the board itself.
"""

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from edgevpr.core.types import StageCost
from edgevpr.power.boards import Board
from edgevpr.runtime.preflight.probe import TechniqueCosts

COUNTED_PATH = Path(__file__).with_name("counted.json")
_COUNTED_SETTINGS = {"w1": 512, "w2": 16, "bins": 8, "entropy": "shannon", "matching": "displacement"}


def count_work(name: str, parameters: Mapping[str, Any]) -> dict[str, float] | None:
    """Return the instruction counts of the technique `name` with these parameters on an ARM core, keyed by the field of
    `TechniqueCosts` that they determine; None if they were not counted."""
    if name != "cohog" or any(parameters.get(key, value) != value for key, value in _COUNTED_SETTINGS.items()):
        return None
    work: dict[str, float] = json.loads(COUNTED_PATH.read_text("utf-8"))[parameters.get("camera", "forward")]
    return work


def compute_costs(costs: TechniqueCosts, board: Board, work: Mapping[str, float] | None) -> TechniqueCosts | None:
    """Return a copy of `costs`, which were measured on this machine, with the times of one core of `board`, estimated
    from the instruction counts `work`; None if these or the board's `arm64_mips` are unknown."""
    mips = board.benchmark_score.arm64_mips
    if work is None or mips is None:
        return None
    times = {stage: StageCost(count / (1e6 * mips), count / (1e6 * mips)) for stage, count in work.items()}
    return replace(costs, **times)  # type: ignore[arg-type]  # all are fields of TechniqueCosts


def explain_unknown_costs(board: Board) -> str:
    """Return why costs on `board` are unknown, and what to do, to follow "the cost is"."""
    return f"unknown on {board.title}: run `edgevpr profile` on the board itself"
