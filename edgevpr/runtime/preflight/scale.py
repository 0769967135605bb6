"""Conversion of costs measured on one machine to another machine. Memory stays unchanged.

Times are converted by the ratio of the machines' scores (`MachineSpeed`). For cohog on a board whose profile gives
instructions per second of one core (`arm64_mips`), they are computed from the instructions that `make bench-arm64`
counted: these are of the board's own instruction set, and other programs cannot disturb the count.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

from edgevpr.core.types import StageCost
from edgevpr.power.boards import Board, MachineSpeed
from edgevpr.power.speed import REFERENCE_PASSES_HZ, REFERENCE_PRODUCTS_HZ, micro_benchmark
from edgevpr.runtime.preflight.probe import TechniqueCosts

# Score at products as a share of `single`, for boards where it was not measured: that of the Raspberry Pi 4, the
# lowest that is known (Pi 5: 0.21), so that the estimate does not promise too much.
UNKNOWN_PRODUCTS = 0.15
COUNTED_PATH = Path(__file__).with_name("counted.json")
_COUNTED_SETTINGS = {"w1": 512, "w2": 16, "bins": 8, "entropy": "shannon", "matching": "displacement"}


@dataclass(frozen=True, slots=True)
class Ratios:
    """Speed of one thread of a board divided by that of one thread of the machine that measured. `products`: at matrix
    products (networks, and full comparisons of candidates). `passes`: at passes over bytes (everything else)."""

    products: float
    passes: float


def count_work(name: str, parameters: Mapping[str, Any]) -> dict[str, float] | None:
    """Return the number of instructions that the technique `name` with these parameters takes on an ARM core, by the
    name of the field of `TechniqueCosts` that they are the cost of; None if they were not counted."""
    if name != "cohog" or any(parameters.get(key, value) != value for key, value in _COUNTED_SETTINGS.items()):
        return None
    work: dict[str, float] = _counted()[parameters.get("camera", "forward")]
    return work


def is_same(here: Board, board: Board) -> bool:
    """Return True if `board` is the machine `here`, so that nothing has to be converted."""
    return here.name == board.name or (board.machine is not None and board.machine == here.machine)


def with_comparable_score(here: Board, board: Board) -> Board:
    """Return the machine `here` with the speed score from which its costs are scaled to `board`. Both scores must be
    of one kind: that of the profile of `here` if it is verified and `board` has a published score only (no `passes`),
    else that of the micro-benchmark, run now."""
    published = here.benchmark_score.verified and board.benchmark_score.passes is None
    return here if published or is_same(here, board) else replace(here, benchmark_score=micro_benchmark())


def ratios(here: Board, board: Board) -> Ratios | None:
    """Return the speed of `board` divided by that of `here`, the machine that measured; None if a score is unknown."""
    if is_same(here, board):
        return Ratios(1.0, 1.0)
    (products, passes), (own_products, own_passes) = _speeds(board.benchmark_score), _speeds(here.benchmark_score)
    if not (products and own_products and passes and own_passes):
        return None
    return Ratios(products / own_products, passes / own_passes)


def on_board(
    costs: TechniqueCosts, here: Board, board: Board, work: Mapping[str, float] | None = None
) -> TechniqueCosts:
    """Convert costs measured on the machine `here` to `board`: by the counted instructions (`work`) if they and the
    board's `arm64_mips` are known, else by the ratios. Without ratios the times stay unchanged."""
    if is_same(here, board):
        return costs
    if work and (mips := board.benchmark_score.arm64_mips):
        times = {stage: StageCost(count / (1e6 * mips), count / (1e6 * mips)) for stage, count in work.items()}
        return replace(costs, **times)  # type: ignore[arg-type]  # they are fields of TechniqueCosts
    if (ratio := ratios(here, board)) is None:
        return costs
    # A network's layers are products, and so is the comparison of all regions with all regions. Work on pictures and on
    # rows of the index is passes.
    encode_by, threads = (ratio.products, board.threads) if costs.is_network else (ratio.passes, board.cores)
    match_by = ratio.passes if costs.candidates is None else ratio.products
    return replace(
        costs,
        encode=_scale(costs.encode, encode_by, board, threads),
        match_per_place=_scale(costs.match_per_place, match_by, board, board.cores),
        compare_once=_scale(costs.compare_once, ratio.products, board, board.cores),
        scan_per_place=_scale(costs.scan_per_place, ratio.passes, board, board.cores),
        scan_once=_scale(costs.scan_once, ratio.passes, board, board.cores),
    )


def _speeds(score: MachineSpeed) -> tuple[float | None, float | None]:
    """Return the speed of one thread at products and at passes (None: unknown). One that is missing is computed from
    `arm64_mips` and the instructions counted for that part of the micro-benchmark. Without `arm64_mips`, `single` is
    used for passes, and a modest share of it for products."""
    products, passes = score.single and UNKNOWN_PRODUCTS * score.single, score.single
    if mips := score.arm64_mips:
        products = 1e6 * mips / float(_counted()["products"]) / REFERENCE_PRODUCTS_HZ
        passes = 1e6 * mips / float(_counted()["passes"]) / REFERENCE_PASSES_HZ
    return score.products or products, score.passes or passes


def _scale(cost: StageCost, ratio: float, board: Board, threads: int) -> StageCost:
    """Return the cost of a stage on `board`, where a thread is `ratio` times as fast and the stage may use at most
    `threads` threads."""
    busy_cores = cost.cpu_s / cost.wall_s if cost.wall_s else 0.0
    if busy_cores <= 1:
        return cost * (1 / ratio)
    busy_cores = min(busy_cores, board.cores, threads)
    # Cores share memory and current, so that all together may be less than so many times a single one.
    score, together = board.benchmark_score, busy_cores
    if score.single and score.multi:
        together = min(busy_cores, score.multi / score.single)
    wall_s = cost.cpu_s / ratio / together
    return StageCost(wall_s, wall_s * busy_cores)


@cache
def _counted() -> dict[str, Any]:
    """Return the counted instructions: of cohog by camera direction, and of a round of each micro-benchmark."""
    content: dict[str, Any] = json.loads(COUNTED_PATH.read_text("utf-8"))
    return content
