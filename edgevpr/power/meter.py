"""Metering of queries: wall and CPU seconds, utilisation and charge of each, and the totals of a flight.

Energies add up, powers do not (see `equations`, which explains a, s and U). The idle energy a T of a flight of T
seconds, plus s U t of every stage, is exactly the integral of 5.1 over the flight, in whatever order the stages run.
"""

import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from edgevpr.core.types import NO_COST, QueryCost, StageCost, Steps
from edgevpr.power import machine
from edgevpr.power.boards import Board
from edgevpr.power.equations import Pack, marginal_energy_j, pack_ah, stage_energy_j

Clock = Callable[[], float]
_PSS_EVERY_S = 20.0


@dataclass(slots=True)
class Stage:
    """A stage that is being metered. `cost` is set when the stage ends, unless a signal interrupts just then."""

    cost: StageCost = NO_COST


@contextmanager
def stage(wall_clock: Clock = time.perf_counter, cpu_clock: Clock = time.process_time) -> Iterator[Stage]:
    """Meter a block of code: `with stage() as encoding: ...`, then read `encoding.cost`. It counts the CPU time of all
    threads."""
    metered = Stage()
    wall_s, cpu_s = wall_clock(), cpu_clock()
    try:
        yield metered
    finally:
        metered.cost = StageCost(wall_clock() - wall_s, cpu_clock() - cpu_s)


class OwnMemory:
    """Memory of this process: RSS, and PSS (with shared pages in proportion). PSS is read at most once in twenty
    seconds: the kernel walks through all pages for it, which takes some hundredths of the time of a query."""

    def __init__(self, clock: Clock = time.monotonic, read: Callable[[], float | None] = machine.pss_mb) -> None:
        self._clock, self._read = clock, read
        self._read_s = -math.inf
        self._pss_mb: float | None = None

    def look(self) -> tuple[float, float | None]:
        """Return two numbers in MB:
        - the RSS now;
        - the PSS that was read last; None if the kernel does not report it."""
        now_s = self._clock()
        if now_s - self._read_s >= _PSS_EVERY_S:
            self._read_s, self._pss_mb = now_s, self._read()
        return machine.rss_mb(), self._pss_mb


class QueryMeter:
    """Meter of the steps of one query after another, and of the charge that each query draws from the pack of a board.
    `wall_clock` and `cpu_clock` (all threads) give seconds; `memory_mb` is like `OwnMemory.look` (None: that one)."""

    def __init__(
        self,
        board: Board,
        pack: Pack,
        regulator_efficiency: float,
        *,
        wall_clock: Clock = time.perf_counter,
        cpu_clock: Clock = time.process_time,
        memory_mb: Callable[[], tuple[float, float | None]] | None = None,
    ) -> None:
        self.board = board
        self._pack, self._regulator_efficiency = pack, regulator_efficiency
        self._wall_clock, self._cpu_clock = wall_clock, cpu_clock
        self._memory_mb = memory_mb or OwnMemory().look
        self._taken: dict[str, StageCost] = {}

    def begin(self) -> None:
        """Begin a new query, without the steps of the last one."""
        self._taken = {}

    @contextmanager
    def step(self, name: str) -> Iterator[None]:
        """Meter a step of the query (a field of `Steps`): `with meter.step("encode"): ...`. A repeated step adds up."""
        metered = Stage()
        try:
            with stage(self._wall_clock, self._cpu_clock) as metered:
                yield
        finally:
            self._taken[name] = self._taken.get(name, NO_COST) + metered.cost

    def steps(self) -> Steps:
        """Return the cost of every step of the query so far."""
        return Steps(**self._taken)

    def cost(self) -> QueryCost:
        """Return the cost of the query so far."""
        steps, (rss_mb, pss_mb) = self.steps(), self._memory_mb()
        return query_cost(
            steps.encoding,
            steps.match,
            self.board,
            self._pack,
            self._regulator_efficiency,
            rss_mb=rss_mb,
            pss_mb=pss_mb,
        )


def query_cost(
    encode: StageCost,
    match: StageCost,
    board: Board,
    pack: Pack,
    regulator_efficiency: float,
    *,
    rss_mb: float,
    pss_mb: float | None = None,
) -> QueryCost:
    """Compute the cost of one query by equations 5.1-5.6. The energies of both stages are added, not their powers.

    Charges are drawn from the pack. `used_mah` is (a + s U) t. `marginal_mah` is s U t, what is added to an idle board.
    """
    stages = [(each.utilisation(board.cores), each.wall_s) for each in (encode, match)]
    used_j = sum(stage_energy_j(board.idle_w, board.full_w, u, t_s) for u, t_s in stages)
    marginal_j = sum(marginal_energy_j(board.idle_w, board.full_w, u, t_s) for u, t_s in stages)
    return QueryCost(
        t_encode_s=encode.wall_s,
        t_match_s=match.wall_s,
        u_encode=stages[0][0],
        u_match=stages[1][0],
        cpu_s=encode.cpu_s + match.cpu_s,
        rss_mb=rss_mb,
        used_mah=1000 * pack_ah(used_j, pack, regulator_efficiency),
        marginal_mah=1000 * pack_ah(marginal_j, pack, regulator_efficiency),
        pss_mb=pss_mb,
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class EnergySoFar:
    """Totals since the start: wall seconds; energy in joules at the board's input (`idle_j`: of the idle board,
    `marginal_j`: what the stages add); CPU-seconds of the stages and of the whole process."""

    elapsed_s: float
    idle_j: float
    marginal_j: float
    stages_cpu_s: float
    process_cpu_s: float


class RunningEnergy:
    """Sum of the energy of stages, in flight. `clock` gives wall seconds, `cpu_clock` CPU-seconds of all threads."""

    def __init__(
        self,
        board: Board,
        clock: Clock = time.monotonic,
        cpu_clock: Clock = time.process_time,
    ) -> None:
        self._board, self._clock, self._cpu_clock = board, clock, cpu_clock
        self._start_s, self._cpu_start_s = clock(), cpu_clock()
        self._marginal_j = self._stages_cpu_s = 0.0

    def add(self, *stages: StageCost) -> None:
        """Add stages that have ended. The time between stages costs idle power only; `so_far` adds it from the
        clock."""
        for stage in stages:
            u = stage.utilisation(self._board.cores)
            self._marginal_j += marginal_energy_j(self._board.idle_w, self._board.full_w, u, stage.wall_s)
            self._stages_cpu_s += stage.cpu_s

    def so_far(self) -> EnergySoFar:
        """Return the totals until now."""
        elapsed_s = self._clock() - self._start_s
        return EnergySoFar(
            elapsed_s=elapsed_s,
            idle_j=self._board.idle_w * elapsed_s,
            marginal_j=self._marginal_j,
            stages_cpu_s=self._stages_cpu_s,
            process_cpu_s=self._cpu_clock() - self._cpu_start_s,
        )
