"""Chooses a technique for a board, by accuracy and cost.

The accuracy of each technique, for a downward or forward camera, was measured on image sets by `make results`. These
figures (accuracy.json) are installed with the program, so that every cost can be shown with its accuracy.

An option is a technique in one form. The most accurate option that fits the board is recommended. A technique that
accepted a wrong place on the image sets is never recommended, because its fixes would be sent."""

import json
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from edgevpr.core.types import MAX_FIX_AGE_S
from edgevpr.power.boards import Board
from edgevpr.power.equations import Pack
from edgevpr.runtime.preflight.probe import TechniqueCosts

ACCURACY_PATH = Path(__file__).with_name("accuracy.json")


@dataclass(frozen=True, slots=True, kw_only=True)
class Accuracy:
    """Accuracy of a technique in one form. `recall_at_1`: fraction of queries whose best place is correct, averaged
    over the `sets` image sets not used for tuning, with `queries` queries in total.

    The other fields are numbers of queries. `asked`: all queries of all image sets, including those used for tuning.
    `accepted`: the best place was accepted. `accepted_wrong`: it was accepted, but wrong. `accepted_elsewhere`: it was
    accepted, but wrong and not even a neighbour of the correct place."""

    recall_at_1: float
    sets: int
    queries: int
    asked: int
    accepted: int
    accepted_wrong: int
    accepted_elsewhere: int

    @property
    def neighbours(self) -> str:
        """Number of accepted wrong places adjacent to the correct one, such as " (+3 adjacent)" ("": none)."""
        count = self.accepted_wrong - self.accepted_elsewhere
        return f" (+{count} adjacent)" if count else ""

    def __str__(self) -> str:
        return (
            f"recall@1 {self.recall_at_1:.2f} on {self.sets} image sets, {self.accepted} of {self.asked} accepted, "
            f"{self.accepted_elsewhere} wrong{self.neighbours}"
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class FlightPlan:
    """Plan of a flight: number of places in RAM, queries per second, MB of RAM for the map's index, camera direction
    ("nadir" or "forward"; None: forward), flight time in minutes, the aircraft's battery, and the fraction of its
    energy that reaches the board, 0..1."""

    places: int
    rate_hz: float
    budget_mb: float
    camera: str | None = None
    flight_min: float
    pack: Pack
    regulator_efficiency: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Option:
    """A technique in one form, its cost on a board, and whether it fits the board. `label`: unique name of the option.
    `name`: name of the technique. `accuracy`: None if it was not measured.

    `t_query_s`: wall seconds per query. `cpu_s`: CPU-seconds per query, summed over all cores. `map_ram_mb`,
    `map_disk_mb`: size of the map's index in RAM, and of the map file. `process_ram_mb`: RAM of the process with the
    index. `reachable_hz`: maximum queries per second. `misfit`: reason why it does not fit, to follow a name
    (None: it fits)."""

    label: str
    name: str
    costs: TechniqueCosts
    accuracy: Accuracy | None
    t_query_s: float
    cpu_s: float
    map_ram_mb: float
    map_disk_mb: float
    process_ram_mb: float
    reachable_hz: float
    misfit: str | None

    @property
    def objection(self) -> str | None:
        """Reason not to recommend the option, to follow its label; None if there is none."""
        if self.misfit:
            return self.misfit
        if self.accuracy is None:
            return "was never measured: set it explicitly to use it"
        if self.accuracy.accepted_elsewhere:
            return f"accepted {self.accuracy.accepted_elsewhere} wrong places: set it explicitly to use it"
        if self.costs.sequence > 1:
            return "needs a flight along the mapped route: set it explicitly to use it"
        return None


def make_option(board: Board, label: str, name: str, costs: TechniqueCosts, plan: FlightPlan) -> Option:
    """Make the option of the technique `name` and check whether it fits the board: its index within the RAM budget of
    the map, its process within the board's memory, and its queries within the CPU time. `label`: technique and form.
    `costs`: costs on `board`.

    A query must end before the next one begins, and before its fix is too old to send. Queries may use the
    fraction `cpu_share` of all cores."""
    map_ram_mb = costs.ram_bytes_per_place * plan.places / 1e6
    process_ram_mb = costs.process_mb + map_ram_mb
    query = costs.encode + costs.match(plan.places)
    reachable_hz = min(1 / query.wall_s, board.cores * board.cpu_share / query.cpu_s)
    shortfalls = []
    if map_ram_mb > plan.budget_mb:
        shortfalls.append(f"its map needs {map_ram_mb:.1f} MB of RAM ({plan.budget_mb:.1f} MB allowed)")
    if process_ram_mb > board.memory_max_mb:
        shortfalls.append(f"the process needs {process_ram_mb:.0f} MB ({board.memory_max_mb:.0f} MB allowed)")
    if reachable_hz < plan.rate_hz:
        shortfalls.append(f"it reaches {_round_down(reachable_hz):g} Hz ({plan.rate_hz:g} Hz needed)")
    if query.wall_s > MAX_FIX_AGE_S:
        limit = f"fixes from frames older than {MAX_FIX_AGE_S:g} s are never sent"
        shortfalls.append(f"a query takes {query.wall_s:.1f} s, but {limit}")
    return Option(
        label=label,
        name=name,
        costs=costs,
        accuracy=find_accuracy(label, plan.camera),
        t_query_s=query.wall_s,
        cpu_s=query.cpu_s,
        map_ram_mb=map_ram_mb,
        map_disk_mb=costs.disk_bytes_per_place * plan.places / 1e6,
        process_ram_mb=process_ram_mb,
        reachable_hz=reachable_hz,
        misfit=f"does not fit: {' and '.join(shortfalls)}" if shortfalls else None,
    )


def find_accuracy(label: str, camera: str | None, candidates: int | None = None) -> Accuracy | None:
    """Return the accuracy of `label` (technique and form, see `techniques.format_name`); None if it was not measured.

    `camera`: "nadir" or "forward" (None: forward). `candidates`: number of places compared with a query, if fewer than
    the technique's default (None: the default)."""
    name = label if candidates is None else f"{label}, {candidates} candidates"
    figures = _read_accuracies()[camera or "forward"].get(name)
    return Accuracy(**figures) if figures else None


def list_fewer_candidates(label: str, camera: str | None) -> tuple[int, ...]:
    """Return the numbers of candidates below the default with which a technique was measured, largest first."""
    names = _read_accuracies()[camera or "forward"]
    measured_labels = (re.fullmatch(rf"{re.escape(label)}, (\d+) candidates", name) for name in names)
    return tuple(sorted((int(match[1]) for match in measured_labels if match), reverse=True))


def choose_best(options: Sequence[Option]) -> Option | None:
    """Choose the most accurate option without an objection; of equally accurate ones, that with the least CPU time.
    Returns None if no option is suitable."""
    suitable = [(option.accuracy, option) for option in options if option.accuracy and option.objection is None]
    _, best = min(suitable, key=lambda pair: (-pair[0].recall_at_1, pair[1].cpu_s), default=(None, None))
    return best


@cache
def _read_accuracies() -> dict[str, dict[str, dict[str, Any]]]:
    content: dict[str, dict[str, dict[str, Any]]] = json.loads(ACCURACY_PATH.read_text("utf-8"))
    return content


def _round_down(value: float) -> float:
    """Round down to two significant digits, so that a reported rate is never above the actual one."""
    step = 10.0 ** (math.floor(math.log10(value)) - 1)
    return math.floor(value / step) * step
