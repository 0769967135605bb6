"""Estimates a flight before take-off, for `edgevpr profile`: memory, time, charge and accuracy of each technique
on a board. They are measured if the board is this machine, else computed from instruction counts (see `instructions`).

`dataclasses.asdict` of a FlightEstimate can be written as JSON.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from edgevpr.core.types import QueryCost
from edgevpr.power.boards import Board
from edgevpr.power.equations import Pack, pack_ah, queries_ah
from edgevpr.power.meter import compute_query_cost
from edgevpr.runtime.preflight.choose import Demand, Option, choose_best, explain_no_choice, make_option
from edgevpr.runtime.preflight.instructions import compute_costs, count_work, explain_unknown_costs
from edgevpr.runtime.preflight.trial import Trial


@dataclass(frozen=True, slots=True, kw_only=True)
class FlightPlan(Demand):
    """Plan of a flight: its requirements (`Demand`), and the inputs of its energy budget.

    `flight_min`: flight time in minutes. `pack`: the aircraft's battery. `regulator_efficiency`: fraction of the pack's
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
    an idle board (equation 5.7). `flight_pack_frac`: `flight_mah` as a fraction of the pack's capacity, which is also
    the fraction of its endurance that the aircraft loses. All charges are drawn from the pack.
    """

    option: Option
    query: QueryCost
    flight_mah: float
    flight_marginal_mah: float
    flight_pack_frac: float


@dataclass(frozen=True, slots=True, kw_only=True)
class FlightEstimate:
    """Estimates of all techniques on one board.

    `times`: "measured" (the board is this machine), "counted" (computed from instruction counts) or "unknown".
    `techniques`: those whose costs on the board are known. `unknown`: labels of the others. `recommended`: label of the
    recommended option (None: no option is suitable). `reason`: sentence that explains the recommendation, or why there
    is none. `notes`: remarks on the estimate. `unusable`: the reason for each technique that cannot be used on this
    machine.
    """

    board: str
    title: str
    times: str
    plan: FlightPlan
    techniques: tuple[TechniqueEstimate, ...]
    unknown: tuple[str, ...]
    recommended: str | None
    reason: str
    notes: tuple[str, ...]
    unusable: dict[str, str]


def estimate_flight(board: Board, trials: Iterable[Trial], plan: FlightPlan) -> FlightEstimate:
    """Estimate every technique of `trials` for a flight with `board`. The trials were run on this machine."""
    trials, is_measured = list(trials), board.is_this_machine()
    rows: list[TechniqueEstimate] = []
    unknown: list[str] = []
    for trial in trials:
        if trial.costs:
            work = count_work(trial.name, trial.parameters)
            costs = trial.costs if is_measured else compute_costs(trial.costs, board, work)
            if costs is None:
                unknown.append(trial.label)
            else:
                rows.append(_estimate_option(make_option(board, trial.label, trial.name, costs, plan), board, plan))
    recommended, reason = _recommend(rows, unknown, board, plan)
    times = "measured" if is_measured else "counted" if rows else "unknown"
    weights = dict.fromkeys(f"Weights of {trial.weights}." for trial in trials if trial.weights)
    return FlightEstimate(
        board=board.name,
        title=board.title,
        times=times,
        plan=plan,
        techniques=tuple(rows),
        unknown=tuple(unknown),
        recommended=recommended,
        reason=reason,
        notes=(*weights, *_list_notes(board, times, unknown)),
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


def _recommend(
    rows: list[TechniqueEstimate], unknown: list[str], board: Board, plan: FlightPlan
) -> tuple[str | None, str]:
    """Return `recommended` and `reason` as in `FlightEstimate`, given its `unknown`."""
    options = [row.option for row in rows]
    if unknown and not options:
        return None, f"None: the cost of every technique is {explain_unknown_costs(board)}."
    if not options:
        return None, "None: no technique can be used on this machine."
    best = choose_best(options)
    if best is None:
        return None, f"None: {explain_no_choice(options, board)}."
    row = rows[options.index(best)]
    return best.label, (
        f"{best.label}: the most accurate that fits: {best.accuracy}; "
        f"{best.process_ram_mb:.0f} of {board.memory_max_mb:.0f} MB, {best.reachable_hz:.3g} Hz "
        f"({plan.rate_hz:g} needed), {best.cpu_s / best.t_query_s / board.cores:.0%} of the CPU during a query, and "
        f"{row.flight_marginal_mah:.3g} mAh per flight in addition to the "
        f"{row.flight_mah - row.flight_marginal_mah:.3g} mAh of the idle board."
    )


def _list_notes(board: Board, timing_method: str, unknown: list[str]) -> Iterator[str]:
    score = board.benchmark_score
    if timing_method == "counted":
        unverified = "" if score.verified else "unverified; "
        yield (
            f"The cohog times are computed from its instruction counts on an ARM core (`make bench-arm64`), at "
            f"{score.arm64_mips:g} million instructions per second ({unverified}{score.source})."
        )
    if unknown:
        yield f"The costs of {', '.join(unknown)} are {explain_unknown_costs(board)}."
    if not board.verified:
        yield f"The power of {board.title} is unverified: {board.source}."
