"""Estimates a flight before take-off, for `edgevpr profile`: memory, time, charge and accuracy of each technique
on a board. They are measured if the board is this machine. On another ARM board, the times of `cohog` are computed from
instruction counts; the costs of other techniques, and on other boards, are known only on the board itself.

`dataclasses.asdict` of a FlightEstimate can be written as JSON."""

import json
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from edgevpr.core.types import QueryCost, StageCost
from edgevpr.power.boards import Board
from edgevpr.power.equations import pack_ah, queries_ah
from edgevpr.power.meter import compute_query_cost
from edgevpr.runtime.preflight.choose import FlightPlan, Option, choose_best, make_option
from edgevpr.runtime.preflight.probe import TechniqueCosts
from edgevpr.runtime.preflight.trial import Trial

COUNTED_PATH = Path(__file__).with_name("counted.json")
_MAX_OBJECTIONS = 3  # number reported if no option can be chosen
_COUNTED = {"w1": 512, "w2": 16, "bins": 8, "entropy": "shannon", "matching": "displacement"}


@dataclass(frozen=True, slots=True, kw_only=True)
class TechniqueEstimate:
    """Estimate of one technique, in one form, on the board. `option`: its accuracy and cost, and whether it fits.

    `query`: time, utilisation and charge of a query (symbols and equations: see `power.equations`).
    `flight_mah`: charge that the board draws during the flight. `flight_marginal_mah`: the part that the queries add to
    an idle board (equation 5.7). `flight_pack_frac`: `flight_mah` as a fraction of the pack's capacity, which is also
    the fraction of its endurance that the aircraft loses. All charges are drawn from the pack."""

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
    machine."""

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
            costs = trial.costs if is_measured else compute_counted_costs(trial, board)
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


def compute_counted_costs(trial: Trial, board: Board) -> TechniqueCosts | None:
    """Return the costs of a trial on this machine, with the times of one core of another `board`: the instruction
    counts of `make bench-arm64`, which are for an ARM core and unaffected by other programs, divided by the board's
    `arm64_mips`. Memory is not converted. None if the instructions were not counted, or that speed is unknown."""
    settings, mips = trial.parameters, board.benchmark_score.arm64_mips
    is_counted = trial.name == "cohog" and all(settings.get(key, value) == value for key, value in _COUNTED.items())
    if trial.costs is None or mips is None or not is_counted:
        return None
    work: dict[str, float] = json.loads(COUNTED_PATH.read_text("utf-8"))[settings.get("camera", "forward")]
    times = {stage: StageCost(count / (1e6 * mips), count / (1e6 * mips)) for stage, count in work.items()}
    return replace(trial.costs, **times)  # type: ignore[arg-type]  # all are fields of TechniqueCosts


def _estimate_option(option: Option, board: Board, plan: FlightPlan) -> TechniqueEstimate:
    costs, match = option.costs, option.costs.match(plan.places)
    query = compute_query_cost(costs.encode, match, board, plan.pack, plan.regulator_efficiency, costs.process_mb)
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
        return None, f"None: the cost of every technique is {_explain_unknown_costs(board)}."
    if not options:
        return None, "None: no technique can be used on this machine."
    best = choose_best(options)
    if best is None:
        objections = (f"{option.label} {option.objection}" for option in options[:_MAX_OBJECTIONS])
        return None, f"None: no technique suits {board.title}: {', and '.join(objections)}."
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
        yield f"The costs of {', '.join(unknown)} are {_explain_unknown_costs(board)}."
    if not board.verified:
        yield f"The power of {board.title} is unverified: {board.source}."


def _explain_unknown_costs(board: Board) -> str:
    """Return why costs on `board` are unknown, and what to do, to follow "the cost is"."""
    return f"unknown on {board.title}: run `edgevpr profile` on the board itself"
