"""What each technique will cost a board in a flight, said before take-off, from what `choose.probe` has measured.

`dataclasses.asdict` of an Estimate is ready for JSON.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from edgevpr.errors import UsageError
from edgevpr.power.boards import Board
from edgevpr.power.equations import Pack, pack_ah, queries_ah
from edgevpr.power.meter import query_cost
from edgevpr.runtime.choose import TechniqueCosts, fit, on_board, speed_ratio


@dataclass(frozen=True, slots=True)
class FlightPlan:
    """What is asked of the board: places in the map, queries a second, minutes in the air, from which pack, and how
    much memory the map's index may take. Raises UsageError for a number that is none."""

    places: int
    rate_hz: float
    flight_min: float
    pack: Pack
    regulator_efficiency: float
    budget_mb: float

    def __post_init__(self) -> None:
        asked = {
            "number of places": self.places,
            "rate in Hz": self.rate_hz,
            "length of the flight in minutes": self.flight_min,
            "budget in MB": self.budget_mb,
        }
        for what, value in asked.items():
            if not 0 < value < float("inf"):
                raise UsageError(f"The {what} is {value:g}: give a number above 0.")


@dataclass(frozen=True, slots=True)
class TechniqueEstimate:
    """One technique on the board.

    `process_ram_mb` includes the map. `query_mah` is (a + s U) t over encoding and matching, `query_marginal_mah` is
    s U t (5.6); `flight_ah` is what the board draws from start to end, `flight_marginal_ah` what the queries add to it
    (5.7); all of it from the pack. `shortfalls` say why it does not fit, `remedies` what would make it fit.
    """

    technique: str
    fits: bool
    ram_bytes_per_place: int
    disk_bytes_per_place: int
    map_ram_mb: float
    map_disk_mb: float
    process_ram_mb: float
    t_encode_s: float
    t_match_s: float
    u_encode: float
    u_match: float
    reachable_hz: float
    query_mah: float
    query_marginal_mah: float
    flight_ah: float
    flight_marginal_ah: float
    flight_pack_frac: float
    shortfalls: tuple[str, ...]
    remedies: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Estimate:
    """All techniques on one board. `times` is "measured" (on this machine, for this machine), "scaled" (from this
    machine to the board) or "unscaled" (this machine's, for want of a figure); `notes` say what to know about it."""

    board: str
    title: str
    verified: bool
    times: str
    plan: FlightPlan
    techniques: tuple[TechniqueEstimate, ...]
    notes: tuple[str, ...]


def estimate(board: Board, here: Board, costs: Mapping[str, TechniqueCosts], plan: FlightPlan) -> Estimate:
    """Estimate every technique of `costs`, which were probed on the machine `here`, for a flight of `board`."""
    ratio = speed_ratio(here, board)
    if ratio is None:
        times = "unscaled"
    else:
        times = "measured" if here.name == board.name else "scaled"
    rows = tuple(_technique(name, on_board(each, here, board), board, plan) for name, each in costs.items())
    notes = tuple(_notes(board, here, ratio, times))
    return Estimate(board.name, board.title, board.verified, times, plan, rows, notes)


def _technique(name: str, costs: TechniqueCosts, board: Board, plan: FlightPlan) -> TechniqueEstimate:
    found = fit(board, costs, plan.places, plan.rate_hz, plan.budget_mb)
    query = query_cost(costs.encode, costs.match(plan.places), board, plan.pack, plan.regulator_efficiency)
    flight_s = 60 * plan.flight_min
    marginal_ah = queries_ah(min(plan.rate_hz, found.reachable_hz) * flight_s, query.marginal_mah / 1000)
    # 5.7 leaves out the idle power between two queries; the pack does not.
    flight_ah = pack_ah(board.idle_w * flight_s, plan.pack, plan.regulator_efficiency) + marginal_ah
    return TechniqueEstimate(
        technique=name,
        fits=not found.shortfalls,
        ram_bytes_per_place=costs.ram_bytes_per_place,
        disk_bytes_per_place=costs.disk_bytes_per_place,
        map_ram_mb=found.map_ram_mb,
        map_disk_mb=costs.disk_bytes_per_place * plan.places / 1e6,
        process_ram_mb=found.process_ram_mb,
        t_encode_s=query.t_encode_s,
        t_match_s=query.t_match_s,
        u_encode=query.u_encode,
        u_match=query.u_match,
        reachable_hz=found.reachable_hz,
        query_mah=query.used_mah,
        query_marginal_mah=query.marginal_mah,
        flight_ah=flight_ah,
        flight_marginal_ah=marginal_ah,
        flight_pack_frac=1000 * flight_ah / plan.pack.capacity_mah,
        shortfalls=found.shortfalls,
        remedies=found.remedies,
    )


def _notes(board: Board, here: Board, ratio: float | None, times: str) -> Iterator[str]:
    if times == "unscaled":
        unknown = board if board.relative_speed is None else here
        yield (
            f"The times are this machine's, unscaled, not measured on this board: the speed of {unknown.title} is not "
            f"known ({unknown.speed_source})."
        )
    if times == "scaled":
        doubt = "" if board.speed_verified and here.speed_verified else "unverified; "
        yield (
            f"The times are scaled from this machine to {ratio:.2g} of its speed ({doubt}{board.speed_source}), not "
            "measured on this board; large matrix products can take several times longer still."
        )
    if not board.verified:
        yield f"The power of {board.title} is unverified: {board.source}."


_HEADS = (
    "technique", "fits", "bytes/place", "map MB", "disk MB", "process MB", "t_e s", "t_m s", "U_e", "U_m", "Hz",
    "mAh/query", "marginal", "Ah/flight", "marginal", "of pack",
)  # fmt: skip


def format_table(estimate: Estimate) -> str:
    """The estimate as plain text: a table with a line for each technique, then why (not), then the notes."""
    plan = estimate.plan
    rows = [_HEADS, *(_cells(row) for row in estimate.techniques)]
    widths = [max(len(row[column]) for row in rows) for column in range(len(_HEADS))]
    lines = [
        f"{estimate.title}: {plan.places} places, {plan.rate_hz:g} Hz, {plan.flight_min:g} min, "
        f"{plan.pack.cells}S{plan.pack.capacity_mah} at {plan.regulator_efficiency:.0%} regulator efficiency; times "
        f"{estimate.times}"
    ]
    for row in rows:
        first, *others = (
            cell.ljust(width) if column < 2 else cell.rjust(width)
            for column, (cell, width) in enumerate(zip(row, widths, strict=True))
        )
        lines.append("  ".join([first, *others]).rstrip())
    for each in estimate.techniques:
        if not each.fits:
            remedy = f"; it would fit {', or '.join(each.remedies)}" if each.remedies else ""
            lines.append(f"{each.technique} does not fit: {' and '.join(each.shortfalls)}{remedy}.")
    return "\n".join([*lines, *estimate.notes])


def _cells(row: TechniqueEstimate) -> tuple[str, ...]:
    return (
        row.technique,
        "yes" if row.fits else "no",
        f"{row.ram_bytes_per_place}",
        f"{row.map_ram_mb:.1f}",
        f"{row.map_disk_mb:.1f}",
        f"{row.process_ram_mb:.0f}",
        f"{row.t_encode_s:.3f}",
        f"{row.t_match_s:.3f}",
        f"{row.u_encode:.2f}",
        f"{row.u_match:.2f}",
        f"{row.reachable_hz:.3g}",
        f"{row.query_mah:.4f}",
        f"{row.query_marginal_mah:.4f}",
        f"{row.flight_ah:.3f}",
        f"{row.flight_marginal_ah:.3f}",
        f"{row.flight_pack_frac:.1%}",
    )
