"""Costs measured on one machine, converted to another: times by the ratio of two scores, or by the instructions that
were counted; memory unchanged."""

from dataclasses import asdict, dataclass, replace

from edgevpr.core.types import StageCost
from edgevpr.power.boards import Board, MachineSpeed
from edgevpr.power.speed import REFERENCE_PASSES_HZ, REFERENCE_PRODUCTS_HZ
from edgevpr.runtime.preflight import counted
from edgevpr.runtime.preflight.counted import Work
from edgevpr.runtime.preflight.probe import TechniqueCosts

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

    Where products or passes have no figure, the counted instructions of such work stand in for it, on a board that says
    how many a second it runs. On others the single thread's score stands in for passes, and a modest share of it for
    products.
    """
    if is_same(here, board):
        return Ratios(1.0, 1.0)
    mine, other = here.benchmark_score, board.benchmark_score
    pairs = [
        (_products(other), _products(mine)),
        (_passes(other), _passes(mine)),
    ]
    if not all(there and here_too for there, here_too in pairs):
        return None
    return Ratios(*(there / here_too for there, here_too in pairs))


def _products(score: MachineSpeed) -> float | None:
    if score.products is None and score.arm64_mips:
        return counted.rounds_hz("products", score.arm64_mips) / REFERENCE_PRODUCTS_HZ
    return score.products or (score.single and UNKNOWN_PRODUCTS * score.single)


def _passes(score: MachineSpeed) -> float | None:
    if score.passes is None and score.arm64_mips:
        return counted.rounds_hz("passes", score.arm64_mips) / REFERENCE_PASSES_HZ
    return score.passes or score.single


def on_board(costs: TechniqueCosts, here: Board, board: Board, work: Work | None = None) -> TechniqueCosts:
    """Convert costs measured `here` to `board`: by the counted `work` of the technique, where it is known and the board
    says how many instructions a second it runs, else by the ratios. The times stay as they are where no ratio is
    known."""
    if is_same(here, board):
        return costs
    if work and (mips := board.benchmark_score.arm64_mips):
        times_s = {stage: instructions / (1e6 * mips) for stage, instructions in asdict(work).items()}
        return replace(costs, **{stage: StageCost(time_s, time_s) for stage, time_s in times_s.items()})
    found = ratios(here, board)
    if found is None:
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
        compare_once=_scaled(costs.compare_once, found.products, board),
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
