"""Costs measured on one machine as they would be on another: times by the ratio of two scores, memory as it is."""

from dataclasses import dataclass, replace

from edgevpr.power.boards import Board, MachineSpeed
from edgevpr.runtime.preflight.probe import TechniqueCosts
from edgevpr.types import StageCost

# Of a single thread's score, where nobody has measured products: the Raspberry Pi 4's share, the lowest that is known
# (Pi 5: 0.21). What is not known is not promised.
UNKNOWN_PRODUCTS = 0.15


@dataclass(frozen=True, slots=True)
class Ratios:
    """How fast one thread of a board is beside one of the machine that measured: at matrix `products` (pictures through
    a network, and full comparisons of candidates) and at `passes` over bytes (everything else)."""

    products: float
    passes: float


def is_same(here: Board, board: Board) -> bool:
    """Whether `board` is the machine `here`, so that nothing has to be scaled."""
    return here.name == board.name or (board.machine is not None and board.machine == here.machine)


def ratios(here: Board, board: Board) -> Ratios | None:
    """The ratios of `board` to `here`, the machine that measured; None where nobody knows. Passes that are not known
    apart are taken from the single thread's score, and products as a modest share of it."""
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
    """The costs measured `here` as they would be on `board`; its times stay as they are where no ratio is known."""
    found = ratios(here, board)
    if found is None or is_same(here, board):
        return costs
    # A network's layers are products, and so is the comparison of all regions with all regions; what reads and makes
    # rows of the index, or pictures, is passes.
    return replace(
        costs,
        encode=_scaled(costs.encode, found.products, board, board.threads)
        if costs.is_network
        else _scaled(costs.encode, found.passes, board),
        match_per_place=_scaled(
            costs.match_per_place, found.passes if costs.candidates is None else found.products, board
        ),
        scan_per_place=_scaled(costs.scan_per_place, found.passes, board),
    )


def _scaled(cost: StageCost, ratio: float, board: Board, threads: int | None = None) -> StageCost:
    """A stage on `board`, where it may use `threads` (None: as many as it did)."""
    busy_cores = cost.cpu_s / cost.wall_s if cost.wall_s else 0.0
    if busy_cores <= 1:
        return StageCost(cost.wall_s / ratio, cost.cpu_s / ratio)
    busy_cores = min(busy_cores, board.cores, threads or board.cores)
    wall_s = cost.cpu_s / ratio / (busy_cores * _kept(board.benchmark_score, busy_cores))
    return StageCost(wall_s, wall_s * busy_cores)


def _kept(score: MachineSpeed, busy_cores: float) -> float:
    """What share of a single core's speed each of so many busy ones keeps: they share memory, heat and current."""
    if score.single is None or score.multi is None:
        return 1.0
    return min(1.0, score.multi / (busy_cores * score.single))
