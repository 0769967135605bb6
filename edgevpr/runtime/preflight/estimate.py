"""Estimate of a flight before take-off, shown by `edgevpr profile`: memory, time, charge and accuracy of each technique
on a board, computed from costs measured on this machine.

`dataclasses.asdict` of a FlightEstimate can be written as JSON.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from edgevpr.core.types import QueryCost
from edgevpr.power.boards import Board
from edgevpr.power.equations import Pack, pack_ah, queries_ah
from edgevpr.power.meter import compute_query_cost
from edgevpr.power.speed import Speed
from edgevpr.runtime.preflight.choose import Demand, Option, choose_best, explain_no_choice, make_option
from edgevpr.runtime.preflight.scale import SAME_MACHINE, count_work, scale_to_board
from edgevpr.runtime.preflight.trial import Trial


@dataclass(frozen=True, slots=True, kw_only=True)
class FlightPlan(Demand):
    """Plan of a flight: its requirements (`Demand`), and the inputs of its energy budget.

    `flight_min`: flight time in minutes. `pack`: the aircraft's battery. `regulator_efficiency`: share of the pack's
    energy that reaches the board, 0..1.
    """

    flight_min: float
    pack: Pack
    regulator_efficiency: float


@dataclass(frozen=True, slots=True, kw_only=True)
class TechniqueEstimate:
    """Estimate of one technique, in one form, on the board. `option`: its accuracy and cost, and whether it fits.

    `query`: time, utilisation and charge of a query (symbols and equations: see `power.equations`).
    `flight_mah`: charge that the board draws during the flight. `flight_marginal_mah`: the part that the queries add to
    an idle board (equation 5.7). `flight_pack_frac`: `flight_mah` as a share of the pack's capacity, which is also the
    share of its endurance that the aircraft loses. All charges are drawn from the pack.
    """

    option: Option
    query: QueryCost
    flight_mah: float
    flight_marginal_mah: float
    flight_pack_frac: float


@dataclass(frozen=True, slots=True, kw_only=True)
class FlightEstimate:
    """Estimates of all techniques on one board.

    `times`: "measured" (the board is this machine), "scaled" (from this machine to the board, by `ratio`) or "unscaled"
    (this machine's times, because the speed of the board is unknown). `recommended`: label of the recommended option
    (None: no option is suitable). `reason`: sentence that explains the recommendation, or why there is none. `notes`:
    remarks on the estimate. `unusable`: the reason for each technique that cannot be used on this machine.
    """

    board: str
    title: str
    times: str
    ratio: Speed | None
    plan: FlightPlan
    techniques: tuple[TechniqueEstimate, ...]
    recommended: str | None
    reason: str
    notes: tuple[str, ...]
    unusable: dict[str, str]


def estimate_flight(board: Board, ratio: Speed | None, trials: Iterable[Trial], plan: FlightPlan) -> FlightEstimate:
    """Estimate every technique of `trials` for a flight with `board`. The trials were run on this machine. `ratio`:
    speed of the board relative to this machine (see `compare_speed`)."""
    trials = list(trials)
    rows: list[TechniqueEstimate] = []
    for trial in trials:
        if trial.costs:
            costs = scale_to_board(trial.costs, board, ratio, count_work(trial.name, trial.parameters))
            rows.append(_estimate_option(make_option(board, trial.label, trial.name, costs, plan), board, plan))
    recommended, reason = _recommend(rows, board, plan)
    weights = dict.fromkeys(f"Weights of {trial.weights}." for trial in trials if trial.weights)
    return FlightEstimate(
        board=board.name,
        title=board.title,
        times="unscaled" if ratio is None else "measured" if ratio == SAME_MACHINE else "scaled",
        ratio=ratio,
        plan=plan,
        techniques=tuple(rows),
        recommended=recommended,
        reason=reason,
        notes=(*weights, *_list_notes(board, ratio)),
        unusable={trial.label: trial.problem for trial in trials if trial.problem},
    )


def _estimate_option(option: Option, board: Board, plan: FlightPlan) -> TechniqueEstimate:
    costs, match = option.costs, option.costs.match(plan.places)
    query = compute_query_cost(
        costs.encode, match, board, plan.pack, plan.regulator_efficiency, rss_mb=costs.process_mb
    )
    flight_s = 60 * plan.flight_min
    marginal_mah = queries_ah(min(plan.rate_hz, option.reachable_hz) * flight_s, query.marginal_mah)
    # Equation 5.7 omits the idle power between queries, which the pack also supplies.
    idle_mah = 1000 * pack_ah(board.idle_w * flight_s, plan.pack, plan.regulator_efficiency)
    return TechniqueEstimate(
        option=option,
        query=query,
        flight_mah=idle_mah + marginal_mah,
        flight_marginal_mah=marginal_mah,
        flight_pack_frac=(idle_mah + marginal_mah) / plan.pack.capacity_mah,
    )


def _recommend(rows: list[TechniqueEstimate], board: Board, plan: FlightPlan) -> tuple[str | None, str]:
    """Return `recommended` and `reason` as in `FlightEstimate`."""
    options = [row.option for row in rows]
    if not options:
        return None, "None: no technique can be used on this machine."
    chosen = choose_best(options, board)
    if chosen is None:
        return None, f"None: {explain_no_choice(options, board)}."
    row = rows[options.index(chosen)]
    reason = "the board's profile names it, and it was never measured"
    if chosen.accuracy:
        reason = f"the most accurate that fits: {chosen.accuracy}"
    return chosen.label, (
        f"{chosen.label}: {reason}; {chosen.process_ram_mb:.0f} of {board.memory_max_mb:.0f} MB, "
        f"{chosen.reachable_hz:.3g} Hz ({plan.rate_hz:g} needed), "
        f"{chosen.cpu_s / chosen.t_query_s / board.cores:.0%} of the CPU during a query, and "
        f"{row.flight_marginal_mah:.3g} mAh per flight in addition to the "
        f"{row.flight_mah - row.flight_marginal_mah:.3g} mAh of the idle board."
    )


def _list_notes(board: Board, ratio: Speed | None) -> Iterator[str]:
    score = board.benchmark_score
    if ratio is None:
        yield (
            f"The times are this machine's: they are neither measured on the board nor scaled to it, because its speed "
            f"is unknown ({score.source})."
        )
    elif ratio != SAME_MACHINE:
        unverified = "" if score.verified else "unverified; "
        yield (
            f"The times are scaled from this machine, not measured on the board: networks and full comparisons run at "
            f"{ratio.products:.2g} times this machine's speed, everything else at {ratio.passes:.2g} times "
            f"({unverified}board speed: {score.source}; this machine's speed: edgevpr's micro-benchmark)."
        )
        if score.arm64_mips:
            yield (
                f"The times of cohog are computed from its instruction counts on an ARM core (`make bench-arm64`), at "
                f"{score.arm64_mips:g} million instructions per second."
            )
    if not board.verified:
        yield f"The power of {board.title} is unverified: {board.source}."
