"""Estimate of a flight: what each technique will cost a board, before take-off, from costs measured on some machine.

`dataclasses.asdict` of an Estimate is ready for JSON.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from edgevpr.errors import UsageError
from edgevpr.power.boards import Board
from edgevpr.power.equations import Pack, endurance_min, pack_ah, queries_ah
from edgevpr.power.meter import query_cost
from edgevpr.runtime.preflight.choose import fit
from edgevpr.runtime.preflight.probe import TechniqueCosts
from edgevpr.runtime.preflight.scale import UNKNOWN_PRODUCTS, Ratios, is_same, on_board, ratios
from edgevpr.runtime.preflight.trial import Trial


@dataclass(frozen=True, slots=True, kw_only=True)
class FlightPlan:
    """Plan of a flight: places in the map, queries a second, minutes in the air, the pack, the memory that the map's
    index may take, and the watts that the aircraft draws to hover (None: not given). Raises UsageError for a number
    that is not finite and above 0."""

    places: int
    rate_hz: float
    flight_min: float
    pack: Pack
    regulator_efficiency: float
    budget_mb: float
    hover_w: float | None = None

    def __post_init__(self) -> None:
        asked = {
            "number of places": self.places,
            "rate in Hz": self.rate_hz,
            "length of the flight in minutes": self.flight_min,
            "budget in MB": self.budget_mb,
            "hover power in W": self.hover_w,
        }
        for what, value in asked.items():
            if value is not None and not 0 < value < float("inf"):
                raise UsageError(f"The {what} is {value:g}: give a number above 0.")


@dataclass(frozen=True, slots=True, kw_only=True)
class TechniqueEstimate:
    """One technique, in one form, on the board.

    `process_ram_mb` is the peak with the map, and `encode_ram_mb` the part of it that encoding takes for a moment.
    `query_mah` is (a + s U) t over encoding and matching, and `query_marginal_mah` is s U t (5.6). `flight_mah` is what
    the board draws from start to end, and `flight_marginal_mah` what the queries add to it (5.7). All charges are drawn
    from the pack. `lost_min` is how many minutes less a full pack hovers with the board on the aircraft, and
    `lost_marginal_min` the part of them that recognising costs (None: the hover power is unknown). `shortfalls` say why
    the technique does not fit, `remedies` what would make it fit. `measured` is True for stored costs, False for costs
    tried just now.
    """

    technique: str
    name: str
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
class Estimate:
    """All techniques on one board.

    `times` is "measured" (on this machine, for this machine), "scaled" (from this machine to the board, by `ratios`) or
    "unscaled" (this machine's, since a figure is missing). `measured_on` is the date of stored figures. `recommended`
    is the best technique that fits (None: none does), and `reason` says why in a sentence. `notes` are remarks on the
    estimate; `unusable` are techniques that cannot be used here, each with the reason; `weights` name the weights of
    networks.
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
) -> Estimate:
    """Estimate every technique of `trials`, best first, for a flight of `board`.

    The trials were made on the machine `here`; each is paired with True if it was stored, on `measured_on`.
    `map_technique` is the technique that an existing map was built with (None: there is no map).
    """
    trials = list(trials)
    rows = tuple(
        _technique(trial, on_board(trial.costs, here, board), board, plan, stored)
        for trial, stored in trials
        if trial.costs
    )
    found = ratios(here, board)
    times = "unscaled" if found is None else "measured" if is_same(here, board) else "scaled"
    used_stored = any(row.measured for row in rows)
    recommended, reason = _recommended(rows, board, plan, map_technique)
    return Estimate(
        board=board.name,
        title=board.title,
        verified=board.verified,
        times=times,
        ratios=found,
        measured_on=measured_on if used_stored else None,
        plan=plan,
        techniques=rows,
        recommended=recommended,
        reason=reason,
        notes=tuple(_notes(board, here, found, times, plan)),
        unusable={trial.label: trial.problem for trial, _ in trials if trial.problem},
        weights=tuple(dict.fromkeys(trial.weights for trial, _ in trials if trial.weights)),
    )


def _technique(trial: Trial, costs: TechniqueCosts, board: Board, plan: FlightPlan, stored: bool) -> TechniqueEstimate:
    found = fit(board, costs, plan.places, plan.rate_hz, plan.budget_mb)
    query = query_cost(costs.encode, costs.match(plan.places), board, plan.pack, plan.regulator_efficiency)
    flight_s = 60 * plan.flight_min
    marginal_mah = queries_ah(min(plan.rate_hz, found.reachable_hz) * flight_s, query.marginal_mah)
    # Equation 5.7 leaves out the idle power between two queries; the pack supplies it all the same.
    idle_mah = 1000 * pack_ah(board.idle_w * flight_s, plan.pack, plan.regulator_efficiency)
    lost_min, lost_marginal_min = _lost_min(plan, idle_mah, marginal_mah)
    return TechniqueEstimate(
        technique=trial.label,
        name=trial.name,
        fits=not found.shortfalls,
        ram_bytes_per_place=costs.ram_bytes_per_place,
        disk_bytes_per_place=costs.disk_bytes_per_place,
        map_ram_mb=found.map_ram_mb,
        map_disk_mb=costs.disk_bytes_per_place * plan.places / 1e6,
        process_ram_mb=found.process_ram_mb,
        encode_ram_mb=costs.encode_mb,
        t_encode_s=query.t_encode_s,
        t_match_s=query.t_match_s,
        u_encode=query.u_encode,
        u_match=query.u_match,
        reachable_hz=found.reachable_hz,
        query_mah=query.used_mah,
        query_marginal_mah=query.marginal_mah,
        flight_mah=idle_mah + marginal_mah,
        flight_marginal_mah=marginal_mah,
        flight_pack_frac=(idle_mah + marginal_mah) / plan.pack.capacity_mah,
        lost_min=lost_min,
        lost_marginal_min=lost_marginal_min,
        shortfalls=found.shortfalls,
        remedies=found.remedies,
        measured=stored,
    )


def _lost_min(plan: FlightPlan, idle_mah: float, marginal_mah: float) -> tuple[float | None, float | None]:
    """Return the minutes of hovering on a full pack that the board costs, and those of them that recognising costs."""
    if plan.hover_w is None:
        return None, None
    w_per_mah = plan.pack.nominal_v / 1000 * 60 / plan.flight_min
    idle_w, marginal_w = idle_mah * w_per_mah, marginal_mah * w_per_mah
    without, idling, recognising = (
        endurance_min(plan.pack, plan.hover_w + more_w) for more_w in (0.0, idle_w, idle_w + marginal_w)
    )
    return without - recognising, idling - recognising


def _recommended(
    rows: tuple[TechniqueEstimate, ...], board: Board, plan: FlightPlan, map_technique: str | None
) -> tuple[str | None, str]:
    """Return the best technique that fits, of those that the map can serve, and the reason. `rows` come best first."""
    usable = [row for row in rows if map_technique in (None, row.name)]
    fitting = [row for row in usable if row.fits]
    served = f"the map was built with {map_technique}, and " if map_technique else ""
    if not usable:
        return None, f"None: the map was built with {map_technique}, which cannot be used here."
    if not fitting:
        remedies = [f"{row.technique} {' or '.join(row.remedies)}" for row in usable if row.remedies]
        hint = f"what would fit is {', or '.join(remedies[:3])}" if remedies else "use a larger board"
        return None, f"None: {served}nothing that was tried fits {board.title}; {hint}."
    # `rows` are in the order of the registry; the board's own technique goes first.
    best = min(fitting, key=lambda row: row.name != board.technique)
    if map_technique or best.name != board.technique:
        why = f"it is the first, in order of preference, of the {len(fitting)} that fit"
    else:
        why = "it is what the board's profile prefers, and it fits"
    return best.technique, (
        f"{best.technique}: {served}{why}: {best.process_ram_mb:.0f} of {board.memory_max_mb:.0f} MB, "
        f"{best.reachable_hz:.3g} Hz where {plan.rate_hz:g} are asked, and {best.flight_marginal_mah:.3g} mAh a flight "
        f"beside the {best.flight_mah - best.flight_marginal_mah:.3g} of the idle board."
    )


def _notes(board: Board, here: Board, found: Ratios | None, times: str, plan: FlightPlan) -> Iterator[str]:
    if found is None:
        unknown = board if board.benchmark_score.single is None else here
        yield (
            f"The times are this machine's, unscaled, not measured on this board: the speed of {unknown.title} is not "
            f"known ({unknown.benchmark_score.source})."
        )
    if found and times == "scaled":
        score = board.benchmark_score
        doubt = "" if score.verified and here.benchmark_score.verified else "unverified; "
        apart = (
            "" if score.products else f"; its products are not known apart: {UNKNOWN_PRODUCTS:g} of its single thread"
        )
        yield (
            f"The times are scaled from this machine, not measured on this board: networks and full comparisons to "
            f"{found.products:.2g} of its speed, everything else to {found.passes:.2g} ({doubt}the board by "
            f"{score.source}; this machine by {here.benchmark_score.source}){apart}."
        )
    if not board.verified:
        yield f"The power of {board.title} is unverified: {board.source}."
    if plan.hover_w is None:
        yield "Give the hover power of the aircraft (--hover-w W) to see how many minutes of flight this costs."
