"""Estimate of a flight before take-off: memory, time, charge and accuracy of each technique on a board, from costs
measured on some machine. `edgevpr profile` shows it.

`dataclasses.asdict` of a FlightEstimate can be written as JSON.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from edgevpr.core.errors import UsageError
from edgevpr.power.boards import Board
from edgevpr.power.equations import Pack, endurance_min, pack_ah, queries_ah
from edgevpr.power.meter import query_cost
from edgevpr.runtime.preflight.accuracy import Accuracy
from edgevpr.runtime.preflight.choose import Demand, Option, best, front, nothing_to_choose, options
from edgevpr.runtime.preflight.scale import UNKNOWN_PRODUCTS, Ratios, counted_work, is_same, on_board, ratios
from edgevpr.runtime.preflight.trial import Trial

_BUSY_SHARE = 0.1  # of the time of a trial; if other programs had the processor for more, a note says so


@dataclass(frozen=True, slots=True, kw_only=True)
class FlightPlan:
    """Plan of a flight.

    `places`: in the map. `rate_hz`: queries per second. `flight_min`: minutes in the air. `budget_mb`: RAM for the
    map's index. `regulator_efficiency`: share of the pack's energy that reaches the board, 0..1. `hover_w`: watts that
    the aircraft draws to hover (None: not given). `camera`: "nadir" or "forward" (None: forward). `min_recall`: least
    recall@1 asked for (None: the highest that fits). Raises UsageError for a number that is not finite or not above 0.
    """

    places: int
    rate_hz: float
    flight_min: float
    pack: Pack
    regulator_efficiency: float
    budget_mb: float
    hover_w: float | None = None
    camera: str | None = None
    min_recall: float | None = None

    @property
    def demand(self) -> Demand:
        """Requirements of this flight on a technique."""
        return Demand(places=self.places, rate_hz=self.rate_hz, budget_mb=self.budget_mb, camera=self.camera)

    def __post_init__(self) -> None:
        numbers = {
            "number of places": self.places,
            "rate in Hz": self.rate_hz,
            "length of the flight in minutes": self.flight_min,
            "budget in MB": self.budget_mb,
            "hover power in W": self.hover_w,
            "least recall": self.min_recall,
        }
        for what, value in numbers.items():
            if value is not None and not 0 < value < float("inf"):
                raise UsageError(f"The {what} is {value:g}: give a number above 0.")
        if self.min_recall is not None and self.min_recall > 1:
            raise UsageError(f"The least recall is {self.min_recall:g}: give a share of the queries, up to 1.")


@dataclass(frozen=True, slots=True, kw_only=True)
class TechniqueEstimate:
    """Estimate of one technique, in one form, on the board. Symbols (a, s, U, t) and equations: see `power.equations`.

    `technique`: label of the option (see `choose.Option`). `candidates`: number of places compared, if below the
    default (None: the default). `accuracy`: by `make results` (None: not measured). `on_front`: the front of `choose`.
    `objection`: why it is not chosen automatically (None: no reason, or it does not fit). `shortfalls`: why it does not
    fit. `remedies`: what would make it fit.
    `process_ram_mb`: peak with the map. `encode_ram_mb`: its part that encoding takes for a moment (None: unknown).
    `u_query`: U over a whole query. `measured`: True for stored costs, False for costs measured just now.
    `query_mah`: (a + s U) t of encoding and matching. `query_marginal_mah`: s U t (5.6). `flight_mah`: what the board
    draws in the flight. `flight_marginal_mah`: its part that the queries add (5.7). All charges are drawn from the
    pack, and `flight_pack_frac` is `flight_mah` as a share of its capacity.
    `lost_min`: minutes of hovering on a full pack that the board costs. `lost_marginal_min`: its part that recognising
    costs (both None: hover power unknown).
    """

    technique: str
    name: str
    candidates: int | None
    accuracy: Accuracy | None
    on_front: bool
    objection: str | None
    fits: bool
    ram_bytes_per_place: int
    disk_bytes_per_place: int
    map_ram_mb: float
    map_disk_mb: float
    process_ram_mb: float
    encode_ram_mb: float | None
    t_encode_s: float
    t_match_s: float
    u_encode: float
    u_match: float
    u_query: float
    reachable_hz: float
    query_mah: float
    query_marginal_mah: float
    flight_mah: float
    flight_marginal_mah: float
    flight_pack_frac: float
    lost_min: float | None
    lost_marginal_min: float | None
    shortfalls: tuple[str, ...]
    remedies: tuple[str, ...]
    measured: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class FlightEstimate:
    """Estimates of all techniques on one board.

    `times`: "measured" (on this machine, for this machine), "scaled" (from this machine to the board, by `ratios`) or
    "unscaled" (this machine's, since a score is missing). `measured_on`: date of the stored figures (None: none were
    used). `recommended`: label of the technique to use (None: none can be; see `choose`). `reason`: why, in a sentence.
    `notes`: remarks on the estimate. `unusable`: techniques that cannot be used here, each with the reason. `weights`:
    names of the weights of networks.
    """

    board: str
    title: str
    verified: bool
    times: str
    ratios: Ratios | None
    measured_on: str | None
    plan: FlightPlan
    techniques: tuple[TechniqueEstimate, ...]
    recommended: str | None
    reason: str
    notes: tuple[str, ...]
    unusable: dict[str, str]
    weights: tuple[str, ...]


def estimate(
    board: Board,
    here: Board,
    trials: Iterable[tuple[Trial, bool]],
    plan: FlightPlan,
    map_technique: str | None = None,
    measured_on: str | None = None,
) -> FlightEstimate:
    """Estimate every technique of `trials`, in their order, for a flight of `board`.

    The trials were made on the machine `here`. Each is paired with True if its costs were stored, on the date
    `measured_on`, and with False if it was made just now. `map_technique` is the technique that an existing map was
    built with (None: no map).
    """
    trials = list(trials)
    wanted: dict[str, Option] = {}
    stored: dict[str, bool] = {}
    for trial, is_stored in trials:
        if trial.costs:
            work = counted_work(trial.name, {**trial.parameters, **trial.settings})
            costs = on_board(trial.costs, here, board, work)
            for option in options(board, trial.label, trial.name, costs, plan.demand):
                wanted[option.label], stored[option.label] = option, is_stored
    on_front = {option.label for option in front(wanted.values())}
    rows = tuple(_technique(option, board, plan, stored[label], label in on_front) for label, option in wanted.items())
    ratio = ratios(here, board)
    times = "unscaled" if ratio is None else "measured" if is_same(here, board) else "scaled"
    waited = max((option.costs.waited for option in wanted.values()), default=0.0)
    recommended, reason = _recommended(list(wanted.values()), rows, board, plan, map_technique)
    return FlightEstimate(
        board=board.name,
        title=board.title,
        verified=board.verified,
        times=times,
        ratios=ratio,
        measured_on=measured_on if any(stored.values()) else None,
        plan=plan,
        techniques=rows,
        recommended=recommended,
        reason=reason,
        notes=(*_notes_on_times(board, here, ratio), *_notes_on_figures(board, plan, waited)),
        unusable={trial.label: trial.problem for trial, _ in trials if trial.problem},
        weights=tuple(dict.fromkeys(trial.weights for trial, _ in trials if trial.weights)),
    )


def _technique(option: Option, board: Board, plan: FlightPlan, stored: bool, on_front: bool) -> TechniqueEstimate:
    costs, fit = option.costs, option.fit
    encode, match = costs.encode, costs.match(plan.places)
    query = query_cost(encode, match, board, plan.pack, plan.regulator_efficiency, rss_mb=costs.process_mb)
    flight_s = 60 * plan.flight_min
    marginal_mah = queries_ah(min(plan.rate_hz, fit.reachable_hz) * flight_s, query.marginal_mah)
    # Equation 5.7 leaves out the idle power between two queries, which the pack supplies too.
    idle_mah = 1000 * pack_ah(board.idle_w * flight_s, plan.pack, plan.regulator_efficiency)
    lost_min, lost_marginal_min = _lost_min(plan, idle_mah, marginal_mah)
    return TechniqueEstimate(
        technique=option.label,
        name=option.name,
        candidates=option.candidates,
        accuracy=option.accuracy,
        on_front=on_front,
        objection=None if fit.shortfalls else option.objection,
        fits=not fit.shortfalls,
        ram_bytes_per_place=costs.ram_bytes_per_place,
        disk_bytes_per_place=costs.disk_bytes_per_place,
        map_ram_mb=fit.map_ram_mb,
        map_disk_mb=costs.disk_bytes_per_place * plan.places / 1e6,
        process_ram_mb=fit.process_ram_mb,
        encode_ram_mb=costs.encode_mb,
        t_encode_s=query.t_encode_s,
        t_match_s=query.t_match_s,
        u_encode=query.u_encode,
        u_match=query.u_match,
        u_query=fit.cpu_s / (fit.t_query_s * board.cores),
        reachable_hz=fit.reachable_hz,
        query_mah=query.used_mah,
        query_marginal_mah=query.marginal_mah,
        flight_mah=idle_mah + marginal_mah,
        flight_marginal_mah=marginal_mah,
        flight_pack_frac=(idle_mah + marginal_mah) / plan.pack.capacity_mah,
        lost_min=lost_min,
        lost_marginal_min=lost_marginal_min,
        shortfalls=fit.shortfalls,
        remedies=fit.remedies,
        measured=stored,
    )


def _lost_min(plan: FlightPlan, idle_mah: float, marginal_mah: float) -> tuple[float | None, float | None]:
    """Return two durations in minutes (None: the hover power is unknown):
    - by how much the board shortens hovering on a full pack;
    - the part of it that recognising causes."""
    if plan.hover_w is None:
        return None, None
    w_per_mah = plan.pack.nominal_v / 1000 * 60 / plan.flight_min
    idle_w, marginal_w = idle_mah * w_per_mah, marginal_mah * w_per_mah
    without, idling, recognising = (
        endurance_min(plan.pack, plan.hover_w + more_w) for more_w in (0.0, idle_w, idle_w + marginal_w)
    )
    return without - recognising, idling - recognising


def _recommended(
    wanted: list[Option],
    rows: tuple[TechniqueEstimate, ...],
    board: Board,
    plan: FlightPlan,
    map_technique: str | None,
) -> tuple[str | None, str]:
    """Choose among the options of `map_technique` (None: among all) and return two texts:
    - the label of the technique to use (None: none can be);
    - the reason, in a sentence."""
    usable = [option for option in wanted if map_technique in (None, option.name)]
    served = f"the map was built with {map_technique}, and " if map_technique else ""
    if not usable:
        return None, f"None: the map was built with {map_technique}, which cannot be used here."
    taken = best(usable, board, plan.min_recall)
    if taken is None:
        return None, f"None: {served}{nothing_to_choose(usable, board, plan.min_recall)}."
    row = next(row for row in rows if row.technique == taken.label)
    if taken.accuracy is None:
        why = "it is what the board's profile names, and it was never measured"
    elif plan.min_recall is None:
        why = f"nothing that fits finds more: {taken.accuracy}"
    else:
        why = f"it is the cheapest with a recall@1 of at least {plan.min_recall:g}: {taken.accuracy}"
    return taken.label, (
        f"{taken.label}: {served}{why}; {row.process_ram_mb:.0f} of {board.memory_max_mb:.0f} MB, "
        f"{row.reachable_hz:.3g} Hz where {plan.rate_hz:g} are asked, {row.u_query:.0%} of the CPU during a query, and "
        f"{row.flight_marginal_mah:.3g} mAh a flight beside the {row.flight_mah - row.flight_marginal_mah:.3g} of the "
        "idle board."
    )


def _notes_on_times(board: Board, here: Board, ratio: Ratios | None) -> Iterator[str]:
    score, own_score = board.benchmark_score, here.benchmark_score
    if ratio is None:
        unknown = board if score.single is None else here
        yield (
            f"The times are this machine's, unscaled, not measured on this board: the speed of {unknown.title} is not "
            f"known ({unknown.benchmark_score.source})."
        )
    elif not is_same(here, board):
        doubt = "" if score.verified and own_score.verified else "unverified; "
        apart = f"; its products are not known apart: {UNKNOWN_PRODUCTS:g} of its single thread"
        yield (
            f"The times are scaled from this machine, not measured on this board: networks and full comparisons to "
            f"{ratio.products:.2g} of its speed, everything else to {ratio.passes:.2g} ({doubt}the board by "
            f"{score.source}; this machine by {own_score.source}){'' if score.products or score.arm64_mips else apart}."
        )
        if score.arm64_mips:
            yield (
                f"Those of cohog are the instructions that it takes on an ARM core (`make bench-arm64`), at "
                f"{score.arm64_mips:g} million a second."
            )


def _notes_on_figures(board: Board, plan: FlightPlan, waited: float) -> Iterator[str]:
    if waited > _BUSY_SHARE:
        yield (
            f"This machine was busy: while techniques were tried, other programs had it for {waited:.0%} of the time. "
            "Times of the processor were measured, which that changes little; to be sure, ask again when it is idle."
        )
    if not board.verified:
        yield f"The power of {board.title} is unverified: {board.source}."
    if plan.hover_w is None:
        yield "Give the hover power of the aircraft (--hover-w W) to see how many minutes of flight this costs."
