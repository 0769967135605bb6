"""Costs measured on one machine, converted to another: times by the ratio of two scores, memory unchanged."""

from dataclasses import dataclass, replace

from edgevpr.power.boards import Board, MachineSpeed
from edgevpr.runtime.preflight.probe import TechniqueCosts
from edgevpr.types import StageCost

# Share of a single thread's score, for boards whose products have not been measured: that of the Raspberry Pi 4, the
# lowest that is known (Pi 5: 0.21), so that the estimate does not promise too much.
UNKNOWN_PRODUCTS = 0.15


@dataclass(frozen=True, slots=True)
class Ratios:
    """Speed of one thread of a board relative to one of the machine that measured: at matrix `products` (pictures
    through a network, and full comparisons of candidates) and at `passes` over bytes (everything else)."""

    products: float
    passes: float


def is_same(here: Board, board: Board) -> bool:
    """Tell whether `board` is the machine `here`, so that nothing has to be scaled."""
    return here.name == board.name or (board.machine is not None and board.machine == here.machine)


def ratios(here: Board, board: Board) -> Ratios | None:
    """Return the ratios of `board` to `here`, the machine that measured; None where a score is unknown.

    Where passes have no figure, the single thread's score stands in for it, and where products have none, a modest
    share of it.
    """
    if is_same(here, board):
        return Ratios(1.0, 1.0)
    mine, other = here.benchmark_score, board.benchmark_score
    pairs = [
        (_products(other), _products(mine)),
        (other.passes or other.single, mine.passes or mine.single),
    ]
    if not all(there and here_too for there, here_too in pairs):
        return None
    return Ratios(*(there / here_too for there, here_too in pairs))


def _products(score: MachineSpeed) -> float | None:
    return score.products or (score.single and UNKNOWN_PRODUCTS * score.single)


def on_board(costs: TechniqueCosts, here: Board, board: Board) -> TechniqueCosts:
    """Convert costs measured `here` to `board`; the times stay as they are where no ratio is known."""
    found = ratios(here, board)
    if found is None or is_same(here, board):
        return costs
    # A network's layers are products, and so is the comparison of all regions with all regions. Work on pictures and on
    # rows of the index is passes.
    return replace(
        costs,
        encode=_scaled(costs.encode, found.products, board, board.threads)
        if costs.is_network
        else _scaled(costs.encode, found.passes, board),
        match_per_place=_scaled(
            costs.match_per_place, found.passes if costs.candidates is None else found.products, board
        ),
        scan_per_place=_scaled(costs.scan_per_place, found.passes, board),
        scan_once=_scaled(costs.scan_once, found.passes, board),
    )


def _scaled(cost: StageCost, ratio: float, board: Board, threads: int | None = None) -> StageCost:
    """Scale a stage to `board`, where it may use `threads` (None: as many as it did)."""
    busy_cores = cost.cpu_s / cost.wall_s if cost.wall_s else 0.0
    if busy_cores <= 1:
        return StageCost(cost.wall_s / ratio, cost.cpu_s / ratio)
    busy_cores = min(busy_cores, board.cores, threads or board.cores)
    wall_s = cost.cpu_s / ratio / (busy_cores * _kept(board.benchmark_score, busy_cores))
    return StageCost(wall_s, wall_s * busy_cores)


def _kept(score: MachineSpeed, busy_cores: float) -> float:
    """Return the share of a single core's speed that each of `busy_cores` keeps: they share memory, heat and
    current."""
    if score.single is None or score.multi is None:
        return 1.0
    return min(1.0, score.multi / (busy_cores * score.single))
