"""Conversion of costs measured on this machine to another board. Memory is not converted.

Times are scaled by the ratio of the machines' speeds: the board's from its profile, this machine's from the
micro-benchmark. For cohog on a board whose profile gives instructions per second of one core (`arm64_mips`), times are
computed from the instruction counts of `make bench-arm64` instead: they are for the board's own instruction set, and
unaffected by other programs.
"""

import json
from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

from edgevpr.core.types import StageCost
from edgevpr.power.boards import Board, MachineSpeed
from edgevpr.power.speed import REFERENCE_PASSES_HZ, REFERENCE_PRODUCTS_HZ, Speed, run_micro_benchmark
from edgevpr.runtime.preflight.probe import TechniqueCosts

SAME_MACHINE = Speed(1.0, 1.0)
# Speed at matrix products as a share of `single`, for boards where it was not measured: the Raspberry Pi 4's, which is
# the lowest known (Pi 5: 0.21), so that the estimate is conservative.
UNKNOWN_PRODUCTS = 0.15
COUNTED_PATH = Path(__file__).with_name("counted.json")
_COUNTED_SETTINGS = {"w1": 512, "w2": 16, "bins": 8, "entropy": "shannon", "matching": "displacement"}


def count_work(name: str, parameters: Mapping[str, Any]) -> dict[str, float] | None:
    """Return the instruction counts of the technique `name` with these parameters on an ARM core, by the field of
    `TechniqueCosts` that they determine; None if they were not counted."""
    if name != "cohog" or any(parameters.get(key, value) != value for key, value in _COUNTED_SETTINGS.items()):
        return None
    work: dict[str, float] = _read_counts()[parameters.get("camera", "forward")]
    return work


def compare_speed(board: Board) -> Speed | None:
    """Return the speed of `board` divided by that of this machine (None: the speed of the board is unknown). Unless the
    board is this machine, runs the micro-benchmark."""
    if board.is_this_machine():
        return SAME_MACHINE
    speed = _compute_board_speed(board.benchmark_score)
    if speed is None:
        return None
    this = run_micro_benchmark()
    return Speed(products=speed.products / this.products, passes=speed.passes / this.passes)


def scale_to_board(
    costs: TechniqueCosts, board: Board, ratio: Speed | None, work: Mapping[str, float] | None = None
) -> TechniqueCosts:
    """Convert costs measured on this machine to `board`: from the instruction counts `work` if they and the board's
    `arm64_mips` are known, else by the `ratio` of `compare_speed`. Without a ratio, times stay unchanged."""
    if ratio in (None, SAME_MACHINE):
        return costs
    if work and (mips := board.benchmark_score.arm64_mips):
        times = {stage: StageCost(count / (1e6 * mips), count / (1e6 * mips)) for stage, count in work.items()}
        return replace(costs, **times)  # type: ignore[arg-type]  # all are fields of TechniqueCosts
    # The layers of a network and the comparison of all regions with all regions are matrix products. Work on images and
    # on rows of the index is passes over memory.
    encode_by, threads = (ratio.products, board.threads) if costs.is_network else (ratio.passes, board.cores)
    match_by = ratio.passes if costs.candidates is None else ratio.products
    return replace(
        costs,
        encode=_scale_cost(costs.encode, encode_by, threads),
        match_per_place=_scale_cost(costs.match_per_place, match_by, board.cores),
        compare_once=_scale_cost(costs.compare_once, ratio.products, board.cores),
        scan_per_place=_scale_cost(costs.scan_per_place, ratio.passes, board.cores),
        scan_once=_scale_cost(costs.scan_once, ratio.passes, board.cores),
    )


def _compute_board_speed(score: MachineSpeed) -> Speed | None:
    """Return the speed of a board relative to the reference (None: unknown). For an aarch64 board it is computed from
    `arm64_mips` and the instructions counted for a round of the micro-benchmark. For other boards, the speed at passes
    is `single`, and the speed at products a small share of it. A known `products` score takes precedence."""
    if mips := score.arm64_mips:
        products = 1e6 * mips / float(_read_counts()["products"]) / REFERENCE_PRODUCTS_HZ
        return Speed(score.products or products, 1e6 * mips / float(_read_counts()["passes"]) / REFERENCE_PASSES_HZ)
    if single := score.single:
        return Speed(score.products or UNKNOWN_PRODUCTS * single, single)
    return None


def _scale_cost(cost: StageCost, ratio: float, threads: int) -> StageCost:
    """Return the cost of a stage on a machine with threads `ratio` times as fast, of which it may use `threads`."""
    busy_cores = cost.cpu_s / cost.wall_s if cost.wall_s else 0.0
    if busy_cores <= 1:
        return cost * (1 / ratio)
    wall_s = cost.cpu_s / ratio / min(busy_cores, threads)
    return StageCost(wall_s, cost.cpu_s / ratio)


@cache
def _read_counts() -> dict[str, Any]:
    """Return the instruction counts: of cohog by camera direction, and of one round of each micro-benchmark."""
    content: dict[str, Any] = json.loads(COUNTED_PATH.read_text("utf-8"))
    return content
