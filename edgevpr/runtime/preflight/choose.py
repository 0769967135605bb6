"""Choice of a technique for a board, by accuracy and cost.

An option is a technique in one form with one number of candidates. The front is the list of all options that fit the
board, can be trusted, and are not both less accurate and dearer (in CPU time) than another. If a least accuracy is
asked for, the cheapest of the front that reaches it is chosen, else the most accurate. A technique that accepted a
wrong place on the image sets is never chosen automatically: its fixes would be sent.
"""

import math
from bisect import bisect_left
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

from edgevpr import techniques
from edgevpr.core.config import LOWEST_RATE_HZ
from edgevpr.core.errors import ConfigError
from edgevpr.core.types import FIX_MAX_AGE_S
from edgevpr.power.boards import Board
from edgevpr.runtime.preflight import accuracy
from edgevpr.runtime.preflight.accuracy import Accuracy
from edgevpr.runtime.preflight.probe import TechniqueCosts

_NAMED = 3  # options whose objections are told where nothing can be chosen


@dataclass(frozen=True, slots=True, kw_only=True)
class Demand:
    """Requirements of a flight: places in the map, queries per second, MB of RAM for the map's index, and the direction
    of the camera ("nadir" or "forward"; None: forward)."""

    places: int
    rate_hz: float
    budget_mb: float
    camera: str | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Fit:
    """Says if a technique fits on a board, and what it takes there. `t_query_s`: wall seconds of a query. `cpu_s`: its
    CPU-seconds of all cores together. `map_ram_mb`, `map_disk_mb`: size of the map's index in RAM, and of the map file.
    `process_ram_mb`: RAM of the process with the index. `reachable_hz`: most queries per second. `shortfalls`: why it
    does not fit (empty: it fits). `remedies`: changes that would make it fit, such as "at up to 2 Hz"."""

    t_query_s: float
    cpu_s: float
    map_ram_mb: float
    map_disk_mb: float
    process_ram_mb: float
    reachable_hz: float
    shortfalls: tuple[str, ...]
    remedies: tuple[str, ...] = ()

    @property
    def misfit(self) -> str | None:
        """Reason why it does not fit, and what would make it fit, as words that follow a name; None if it fits."""
        would = f"; it would fit {' or '.join(self.remedies)}" if self.remedies else ""
        return f"does not fit: {' and '.join(self.shortfalls)}{would}" if self.shortfalls else None


@dataclass(frozen=True, slots=True, kw_only=True)
class Option:
    """An option to choose (see the module), with its costs on the board and its `fit`. `label` is its unique name,
    `name` that of the technique. `candidates` is set if they are fewer than the technique's default (None: the
    default). `accuracy` is None if it was not measured."""

    label: str
    name: str
    candidates: int | None
    costs: TechniqueCosts
    fit: Fit
    accuracy: Accuracy | None

    @property
    def recall(self) -> float:
        """Recall@1, 0..1, or 0 if it was not measured."""
        return self.accuracy.recall_at_1 if self.accuracy else 0.0

    @property
    def objection(self) -> str | None:
        """Reason not to choose the option automatically, as words that follow its label; None if there is none."""
        if self.fit.misfit:
            return self.fit.misfit
        if self.accuracy is None:
            return "was never measured: name it to use it"
        if self.accuracy.accepted_elsewhere:
            return f"accepted {self.accuracy.accepted_elsewhere} wrong places: name it to use it"
        if self.costs.sequence > 1:
            return "needs a flight along the mapped way: name it to use it"
        return None


def options(board: Board, label: str, name: str, costs: TechniqueCosts, demand: Demand) -> Iterator[Option]:
    """Yield the options of the technique `name`: with its default number of candidates, then with each smaller number
    whose accuracy was measured. `label` is technique and form; `costs` are those on `board`."""
    measured = accuracy.fewer_candidates(label, demand.camera)
    for candidates in (None, *(count for count in measured if count < (costs.candidates or 0))):
        fewer = replace(costs, candidates=candidates or costs.candidates)
        yield Option(
            label=accuracy.labelled(label, candidates),
            name=name,
            candidates=candidates,
            costs=fewer,
            fit=fit(board, fewer, demand),
            accuracy=accuracy.of(label, demand.camera, candidates),
        )


def front(wanted: Iterable[Option]) -> list[Option]:
    """Return those of the `wanted` options that are on the front (see the module), the cheapest first. An option is
    trusted if it has no `objection`."""
    best_so_far: list[Option] = []
    sound = [option for option in wanted if option.objection is None]
    for option in sorted(sound, key=lambda option: (option.fit.cpu_s, -option.recall)):
        if not best_so_far or option.recall > best_so_far[-1].recall:
            best_so_far.append(option)
    return best_so_far


def best(wanted: Sequence[Option], board: Board, min_recall: float | None = None) -> Option | None:
    """Choose an option of the front: the cheapest with a recall@1 of at least `min_recall` (None: the most accurate).
    Options of the board's own technique (`board.technique`) go before all others. Returns None if none is suitable.

    Without `min_recall`, the board's own technique is chosen even if it was not measured, since the profile names it.
    """
    own = [option for option in wanted if option.name == board.technique]
    unmeasured = [option for option in own if option.accuracy is None and not option.fit.misfit]
    for among in (own, wanted):
        reaching = [option for option in front(among) if option.recall >= (min_recall or 0.0)]
        if reaching:
            return reaching[0] if min_recall is not None else reaching[-1]
        if unmeasured and min_recall is None:
            return unmeasured[0]
    return None


def nothing_to_choose(wanted: Sequence[Option], board: Board, min_recall: float | None = None) -> str:
    """Return the reason why `best` returned None."""
    if sound := front(wanted):
        return f"nothing that fits has a recall@1 of {min_recall:g}; the most is {sound[-1].recall:.2f}"
    against = (f"{option.label} {option.objection}" for option in wanted[:_NAMED])
    return f"nothing is chosen for {board.title} by itself: {', and '.join(against)}"


def fit(board: Board, costs: TechniqueCosts, demand: Demand) -> Fit:
    """Check whether a technique fits: its index into the budget of RAM for the map, its process into the board's
    memory, its queries into the CPU time. If one does not, look for changes of the demand that would make it fit.

    A query must end before the next one begins, and before its fix is too old to be sent. All queries together may use
    the share `cpu_share` of the cores.
    """
    found = _fit(board, costs, demand)
    if not found.shortfalls:
        return found

    def would_fit(**change: float) -> bool:
        return not _fit(board, costs, replace(demand, **change)).shortfalls  # type: ignore[arg-type]  # a field's type

    most_places = bisect_left(range(1, demand.places), True, key=lambda places: not would_fit(places=places))
    rate_hz, budget_mb = _rounded_down(found.reachable_hz), math.ceil(found.map_ram_mb)
    remedies = {
        f"with up to {most_places} places": most_places > 0,
        f"at up to {rate_hz:g} Hz": rate_hz >= LOWEST_RATE_HZ and would_fit(rate_hz=rate_hz),
        f"with a budget of {budget_mb} MB": would_fit(budget_mb=budget_mb),
    }
    return replace(found, remedies=tuple(remedy for remedy, helps in remedies.items() if helps))


def _fit(board: Board, costs: TechniqueCosts, demand: Demand) -> Fit:
    usable_cores = board.cores * board.cpu_share
    map_ram_mb = costs.ram_bytes_per_place * demand.places / 1e6
    process_ram_mb = costs.process_mb + map_ram_mb
    query = costs.encode + costs.match(demand.places)
    reachable_hz = min(1 / query.wall_s, usable_cores / query.cpu_s)
    shortfalls = []
    if map_ram_mb > demand.budget_mb:
        shortfalls.append(f"its map takes {map_ram_mb:.1f} MB of RAM and {demand.budget_mb:.1f} are allowed")
    if process_ram_mb > board.memory_max_mb:
        shortfalls.append(f"the process takes {process_ram_mb:.0f} MB and {board.memory_max_mb:.0f} are allowed")
    if reachable_hz < demand.rate_hz:
        shortfalls.append(f"it reaches {_rounded_down(reachable_hz):g} Hz of {demand.rate_hz:g}")
    if query.wall_s > FIX_MAX_AGE_S:
        shortfalls.append(too_late(query.wall_s))
    return Fit(
        t_query_s=query.wall_s,
        cpu_s=query.cpu_s,
        map_ram_mb=map_ram_mb,
        map_disk_mb=costs.disk_bytes_per_place * demand.places / 1e6,
        process_ram_mb=process_ram_mb,
        reachable_hz=reachable_hz,
        shortfalls=tuple(shortfalls),
    )


def too_late(t_query_s: float) -> str:
    """Return a text that says that queries of `t_query_s` seconds are too slow for their fixes to be sent."""
    return f"a query takes {t_query_s:.1f} s, and no fix of a frame older than {FIX_MAX_AGE_S:g} s is ever sent"


def preferred(board: Board, camera: str | None = None) -> tuple[str, ...]:
    """Return the techniques to try if the user names none, best first: the board's own, then those offered to any
    board.

    For a `camera` that looks down ("nadir"), only techniques with a parameter `camera` are listed. Raises ConfigError
    if the board's profile names a technique that does not exist.
    """
    own = board.technique
    if own is not None and not techniques.is_known(own):
        raise ConfigError(
            f"The profile of {board.title} names the technique `{own}`, which is not there: use one of "
            f"{', '.join(techniques.names())}."
        )
    names = dict.fromkeys((own, *techniques.AUTOMATIC) if own else techniques.AUTOMATIC)
    return tuple(name for name in names if camera != "nadir" or "camera" in techniques.parameters(name))


def described(board: Board, option: Option, demand: Demand) -> str:
    """Return the accuracy of an option, the figures of its fit and, if it does not fit, why not and what would help."""
    found = option.fit
    figures = (
        f"{option.accuracy or 'never measured'}; {demand.places} places take {found.map_ram_mb:.1f} of "
        f"{demand.budget_mb:.1f} MB, the process {found.process_ram_mb:.0f} of {board.memory_max_mb:.0f} MB, and "
        f"{_rounded_down(found.reachable_hz):g} Hz of {demand.rate_hz:g} are reached with "
        f"{board.cores * board.cpu_share:.2g} of {board.cores} cores"
    )
    return f"{figures}; it {found.misfit}" if found.misfit else figures


def _rounded_down(value: float) -> float:
    """Round down to two significant digits, so that a rate reported as reached is really reached."""
    step = 10.0 ** (math.floor(math.log10(value)) - 1)
    return math.floor(value / step) * step
