"""Metering of queries: wall and CPU seconds, utilisation and charge of each query. Also the machine's CPU load and
memory, to report to autopilot and ground station. Energies add up, powers do not (see `equations`)."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import psutil

from edgevpr.core.config import BatteryConfig
from edgevpr.core.types import NO_COST, QueryCost, StageCost, StepCosts
from edgevpr.power import machine
from edgevpr.power.boards import Board
from edgevpr.power.equations import Pack, marginal_energy_j, pack_ah, parse_pack, stage_energy_j

Clock = Callable[[], float]
_MIN_WAIT_FRACTION = 0.15  # of working time; other programs delayed a thread that was off the CPU for longer


@dataclass(slots=True)
class Stage:
    """A metered stage. `cost` is set when the stage ends, unless a signal interrupts it at that moment."""

    cost: StageCost = NO_COST


@contextmanager
def meter_stage(wall_clock: Clock = time.perf_counter, cpu_clock: Clock = time.process_time) -> Iterator[Stage]:
    """Meter a block of code: `with meter_stage() as encoding: ...`, then `encoding.cost`: CPU time of all threads."""
    stage = Stage()
    wall_s, cpu_s = wall_clock(), cpu_clock()
    try:
        yield stage
    finally:
        stage.cost = StageCost(wall_clock() - wall_s, cpu_clock() - cpu_s)


class QueryMeter:
    """Measures the steps of queries, one after the other, and the charge that each draws from the `battery` (None: a
    default, if only times are needed). `wall_clock` and `cpu_clock` (all threads) return seconds, `memory_mb` the
    resident memory of this process."""

    def __init__(
        self,
        board: Board,
        battery: BatteryConfig | None = None,
        *,
        wall_clock: Clock = time.perf_counter,
        cpu_clock: Clock = time.process_time,
        memory_mb: Callable[[], float] = machine.read_rss_mb,
    ) -> None:
        self.board = board
        battery = battery or BatteryConfig()
        self._pack, self._regulator_efficiency = parse_pack(battery.pack), battery.regulator_efficiency
        self._wall_clock, self._cpu_clock = wall_clock, cpu_clock
        self._memory_mb = memory_mb
        self._costs: dict[str, StageCost] = {}

    def begin(self) -> None:
        """Begin a new query and discard the steps of the previous one."""
        self._costs = {}

    @contextmanager
    def step(self, name: str) -> Iterator[None]:
        """Meter a step of the query (a field of `StepCosts`): `with meter.step("encode"):`. Repeated steps add up."""
        stage = Stage()
        try:
            with meter_stage(self._wall_clock, self._cpu_clock) as stage:
                yield
        finally:
            self._costs[name] = self._costs.get(name, NO_COST) + stage.cost

    def steps(self) -> StepCosts:
        """Return the cost of every step of the query so far."""
        return StepCosts(**self._costs)

    def cost(self) -> QueryCost:
        """Return the cost of the query so far."""
        steps, efficiency = self.steps(), self._regulator_efficiency
        return compute_query_cost(steps.encoding, steps.match, self.board, self._pack, efficiency, self._memory_mb())


def compute_query_cost(
    encode: StageCost, match: StageCost, board: Board, pack: Pack, regulator_efficiency: float, rss_mb: float
) -> QueryCost:
    """Compute the cost of one query by equations 5.1-5.6, with the energies of both stages summed. Charges are drawn
    from the pack: `used_mah` for (a + s U) t, and `marginal_mah` for s U t, the addition to an idle board."""
    stages = [(cost.utilisation(board.cores), cost.wall_s) for cost in (encode, match)]
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
    )


@dataclass(frozen=True, slots=True)
class MachineLoad:
    """Load of the machine: utilisation of each core, 0..1, since the last `measure_machine_load`; RAM in bytes."""

    core_usage: tuple[float, ...]
    ram_used_bytes: int
    ram_total_bytes: int


def measure_machine_load() -> MachineLoad:
    """Measure the load of the machine. The first call has no earlier one to compare with and reports idle cores."""
    memory, percents = psutil.virtual_memory(), psutil.cpu_percent(percpu=True)
    return MachineLoad(tuple(percent / 100 for percent in percents), memory.total - memory.available, memory.total)


class ProcessLoad:
    """Measures the fraction of all `cores` that this process uses, and the fraction of time in which other programs
    delay its work, between two calls of `measure`. `cpu_clock` counts all threads of this process."""

    def __init__(self, cores: int, clock: Clock = time.monotonic, cpu_clock: Clock = time.process_time) -> None:
        self._cores, self._clock, self._cpu_clock = cores, clock, cpu_clock
        self._work_s = self._work_cpu_s = 0.0
        self._measured_s, self._cpu_s = clock(), cpu_clock()

    @property
    def age_s(self) -> float:
        """Seconds since the last call of `measure`."""
        return self._clock() - self._measured_s

    def add_work(self, work: StageCost) -> None:
        """Add work. Its `cpu_s` is the CPU time of the one thread (`time.thread_time`) that did it or waited for it."""
        self._work_s += work.wall_s
        self._work_cpu_s += work.cpu_s

    def measure(self) -> tuple[float, float]:
        """Return two fractions since the last call, 0..1: that of all cores that this process used, and that of the
        time taken by the added work if other programs delayed it, else 0."""
        now_s, cpu_s = self._clock(), self._cpu_clock()
        span = StageCost(now_s - self._measured_s, cpu_s - self._cpu_s)
        was_delayed = self._work_cpu_s < (1 - _MIN_WAIT_FRACTION) * self._work_s
        late_share = min(1.0, self._work_s / span.wall_s) if was_delayed and span.wall_s > 0 else 0.0
        self._measured_s, self._cpu_s = now_s, cpu_s
        self._work_s = self._work_cpu_s = 0.0
        return span.utilisation(self._cores), late_share
