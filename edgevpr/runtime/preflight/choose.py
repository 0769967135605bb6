"""Choice of a technique: the costs of a short trial are compared with the board, and the best that fits is taken."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

from edgevpr import techniques
from edgevpr.config import LOWEST_RATE_HZ
from edgevpr.errors import ConfigError, UsageError
from edgevpr.power.boards import Board
from edgevpr.runtime.preflight.probe import TechniqueCosts
from edgevpr.types import FIX_MAX_AGE_S


@dataclass(frozen=True, slots=True, kw_only=True)
class Fit:
    """Fit of a technique on a board; `t_query_s` is the time of one query. It fits where there are no `shortfalls`;
    `remedies` would make it fit."""

    t_query_s: float
    map_ram_mb: float
    process_ram_mb: float
    reachable_hz: float
    shortfalls: tuple[str, ...]
    remedies: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Choice:
    """The technique taken, and the reason in one line."""

    technique: str
    reason: str


def fit(board: Board, costs: TechniqueCosts, places: int, rate_hz: float, budget_mb: float) -> Fit:
    """Check whether a technique fits: its map in `budget_mb`, its process in the board's memory, its queries in the
    CPU's time.

    A query must be over before the next one begins and before its fix is too old to be sent. All queries together may
    take `cpu_share` of the cores at most.
    """
    encode, match = costs.encode, costs.match(places)
    usable_cores = board.cores * board.cpu_share
    map_ram_mb = costs.ram_bytes_per_place * places / 1e6
    process_ram_mb = costs.process_mb + map_ram_mb
    query = encode + match
    reachable_hz = min(1 / query.wall_s, usable_cores / query.cpu_s)

    shortfalls, remedies = [], []
    if map_ram_mb > budget_mb:
        shortfalls.append(f"its map takes {map_ram_mb:.1f} MB of RAM and {budget_mb:.1f} are allowed")
    if process_ram_mb > board.memory_max_mb:
        shortfalls.append(f"the process takes {process_ram_mb:.0f} MB and {board.memory_max_mb:.0f} are allowed")
    if reachable_hz < rate_hz:
        shortfalls.append(f"it reaches {_rounded_down(reachable_hz):g} Hz of {rate_hz:g}")
    if query.wall_s > FIX_MAX_AGE_S:
        shortfalls.append(too_late(query.wall_s))
    if shortfalls:
        most_places = min(
            min(budget_mb, board.memory_max_mb - costs.process_mb) * 1e6 / costs.ram_bytes_per_place,
            costs.places_within(min(1 / rate_hz, FIX_MAX_AGE_S) - encode.wall_s, usable_cores / rate_hz - encode.cpu_s),
        )
        if most_places >= 1:
            remedies.append(f"with up to {int(most_places)} places")
        if process_ram_mb <= board.memory_max_mb and query.wall_s <= FIX_MAX_AGE_S:
            if map_ram_mb <= budget_mb and reachable_hz >= LOWEST_RATE_HZ:
                remedies.append(f"at up to {_rounded_down(reachable_hz):g} Hz")
            elif reachable_hz >= rate_hz:
                remedies.append(f"with a budget of {math.ceil(map_ram_mb)} MB")
    return Fit(
        t_query_s=query.wall_s,
        map_ram_mb=map_ram_mb,
        process_ram_mb=process_ram_mb,
        reachable_hz=reachable_hz,
        shortfalls=tuple(shortfalls),
        remedies=tuple(remedies),
    )


def too_late(t_query_s: float) -> str:
    """Say that no fix of such slow queries would be sent."""
    return f"a query takes {t_query_s:.1f} s, and no fix of a frame older than {FIX_MAX_AGE_S:g} s is ever sent"


def require_technique(board: Board) -> None:
    """Raise ConfigError for a board whose profile names a technique that does not exist."""
    if board.technique is not None and not techniques.is_known(board.technique):
        raise ConfigError(
            f"The profile of {board.title} names the technique `{board.technique}`, which is not there: use one of "
            f"{', '.join(techniques.names())}."
        )


def preferred(board: Board, camera: str | None = None) -> tuple[str, ...]:
    """List the techniques to try for a board where none is named, best first: its own, then those offered to any board.

    For a `camera` that looks down ("nadir") only techniques with a camera setting are listed. Raises ConfigError where
    the board's own technique does not exist.
    """
    require_technique(board)
    own = () if board.technique is None else (board.technique,)
    names = (*own, *(name for name in techniques.AUTOMATIC if name not in own))
    return tuple(name for name in names if camera != "nadir" or "camera" in techniques.parameters(name))


def choose(board: Board, costs: Mapping[str, TechniqueCosts], places: int, rate_hz: float, budget_mb: float) -> Choice:
    """Take the first technique that fits. `costs` are those on `board`, best technique first.

    Raises UsageError where none fits; it says what would make one fit.
    """
    passed_over, remedies = [], []
    for name, each in costs.items():
        found = fit(board, each, places, rate_hz, budget_mb)
        if not found.shortfalls:
            reason = f"{name}: {described(board, found, places, rate_hz, budget_mb)}"
            return Choice(name, "; ".join([reason, *passed_over]))
        passed_over.append(f"{name} does not fit, {' and '.join(found.shortfalls)}")
        remedies += [f"{name} {' or '.join(found.remedies)}"] if found.remedies else []
    raise UsageError(
        f"No technique fits {board.title} with {places} places at {rate_hz:g} Hz ({'; '.join(passed_over)}): "
        + (f"what would fit is {', or '.join(remedies)}." if remedies else "use a larger board.")
    )


def described(board: Board, found: Fit, places: int, rate_hz: float, budget_mb: float) -> str:
    """Describe a fit in one line of figures; where the technique does not fit, add why and what would make it fit."""
    figures = (
        f"{places} places take {found.map_ram_mb:.1f} of {budget_mb:.1f} MB, the process {found.process_ram_mb:.0f} of "
        f"{board.memory_max_mb:.0f} MB, and {_rounded_down(found.reachable_hz):g} Hz of {rate_hz:g} are reached with "
        f"{board.cores * board.cpu_share:.2g} of {board.cores} cores"
    )
    if not found.shortfalls:
        return figures
    remedies = f", it would fit {' or '.join(found.remedies)}" if found.remedies else ""
    return f"{figures}; it does not fit ({' and '.join(found.shortfalls)}{remedies})"


def _rounded_down(value: float) -> float:
    """Round down to two digits, so that a rate said to be reached is really reached."""
    step = 10.0 ** (math.floor(math.log10(value)) - 1)
    return math.floor(value / step) * step
