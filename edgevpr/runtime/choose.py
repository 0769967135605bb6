"""Which technique a board can afford: each is tried for a moment, and the best one that fits is taken."""

import math
import sys
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from edgevpr.errors import UsageError
from edgevpr.places.index import PlaceIndex, bytes_per_place, load_index
from edgevpr.places.mapfile import PlaceMap
from edgevpr.power.boards import Board
from edgevpr.power.machine import rss_mb
from edgevpr.power.meter import stage
from edgevpr.types import Descriptor, Frame, StageCost, Technique

_ROUNDS = 3
_PLACES = 6
_SCANNED = 4096
_LOWEST_RATE_HZ = 0.01  # what the configuration allows
_NOTHING = StageCost(0.0, 0.0)
_LINK_MB = 13.0  # what importing pymavlink adds to the resident memory (measured on x86-64)


@dataclass(frozen=True, slots=True)
class TechniqueCosts:
    """What a technique costs on one machine: to encode a frame, to compare it in full with one place (read from the map
    file), bytes of a place in RAM and on disk, and the resident memory of the process without a map.

    Where there are more than `candidates` places, all are scanned in RAM and only so many compared in full (None: the
    technique has one stage, and compares all of them).
    """

    encode: StageCost
    match_per_place: StageCost
    ram_bytes_per_place: int
    disk_bytes_per_place: int
    process_mb: float
    candidates: int | None = None
    scan_per_place: StageCost = _NOTHING

    def match(self, places: int) -> StageCost:
        """Cost of finding one query in a map of `places` places."""
        if self.candidates is None or places <= self.candidates:
            return _times(self.match_per_place, places)
        in_full, scanned = _times(self.match_per_place, self.candidates), _times(self.scan_per_place, places)
        return StageCost(in_full.wall_s + scanned.wall_s, in_full.cpu_s + scanned.cpu_s)

    def places_within(self, wall_s: float, cpu_s: float) -> float:
        """How many places a map may have for a query to be found in it within both times."""
        full = self.match_per_place
        in_full = min(wall_s / full.wall_s, cpu_s / full.cpu_s)
        if self.candidates is None or in_full < self.candidates:
            return in_full
        scan = self.scan_per_place
        rest_wall_s, rest_cpu_s = wall_s - self.candidates * full.wall_s, cpu_s - self.candidates * full.cpu_s
        return min(rest_wall_s / scan.wall_s, rest_cpu_s / scan.cpu_s) if scan.wall_s else math.inf


@dataclass(frozen=True, slots=True)
class Fit:
    """How a technique would sit on a board. It fits where there are no `shortfalls`; `remedies` would make it fit."""

    map_ram_mb: float
    process_ram_mb: float
    reachable_hz: float
    shortfalls: tuple[str, ...]
    remedies: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Choice:
    """The technique taken, and why, in one line."""

    technique: str
    reason: str


def probe(technique: Technique) -> TechniqueCosts:
    """Try a technique here and now: encode a few generated 640x480 frames, and match them in a small map on disk.

    The frames are noise, in which every region says something, so that matching costs the most it can. The quickest
    of a few rounds counts: what other programs take away at the moment is no cost of the technique.
    """
    rng = np.random.default_rng(0)
    frames = [Frame(rng.integers(0, 256, (480, 640), np.uint8), f"noise {i}", t_mono_s=0.0) for i in range(_ROUNDS)]
    technique.encode(frames[0].image)  # the first time also starts threads and imports what is imported late
    queries, encodings, matchings = [], [], []
    for frame in frames:
        with stage() as encoding:
            queries.append(technique.encode(frame.image))
        encodings.append(encoding.cost)
    with TemporaryDirectory() as folder, PlaceMap.create(Path(folder) / "trial.gpkg", technique.spec) as trial_map:
        for i in range(_PLACES):
            trial_map.add(frames[i % _ROUNDS], queries[i % _ROUNDS])
        index = load_index(trial_map, technique, _PLACES * bytes_per_place(technique.spec))
        for query in queries:
            with stage() as matching:
                _, hypotheses = technique.coarse_scores(query, index.rows, index.mean)
                if technique.spec.fine:
                    for slot, place_id in enumerate(index.place_ids):
                        hypothesis = None if hypotheses is None else int(hypotheses[slot])
                        technique.match(query, trial_map.fine_part(place_id), hypothesis)
            matchings.append(matching.cost)
    fine = technique.spec.fine
    return TechniqueCosts(
        encode=_quickest(encodings),
        match_per_place=_times(_quickest(matchings), 1 / _PLACES),
        ram_bytes_per_place=bytes_per_place(technique.spec),
        disk_bytes_per_place=technique.spec.coarse.nbytes + (fine.nbytes if fine else 0),
        process_mb=rss_mb() + (0.0 if "pymavlink" in sys.modules else _LINK_MB),
        candidates=technique.candidates if fine else None,
        scan_per_place=_probe_scan(technique, queries, index) if fine else _NOTHING,
    )


def _probe_scan(technique: Technique, queries: list[Descriptor], index: PlaceIndex) -> StageCost:
    """Cost of scanning one place: each query over some thousand rows, which are those of the index again and again."""
    rows = np.resize(index.rows, (_SCANNED, *index.rows.shape[1:]))
    scans = []
    for query in queries:
        with stage() as scanning:
            technique.coarse_scores(query, rows, index.mean)
        scans.append(scanning.cost)
    return _times(_quickest(scans), 1 / _SCANNED)


def probe_each(techniques: Iterable[Technique]) -> Iterator[tuple[str, TechniqueCosts]]:
    """(name, costs) of each technique in turn, so that the caller can say how far it is."""
    for technique in techniques:
        yield technique.spec.name, probe(technique)


def speed_ratio(here: Board, board: Board) -> float | None:
    """How fast one thread of `board` is beside one of `here`, the machine that probed; None where nobody knows."""
    if here.name == board.name:
        return 1.0
    if here.relative_speed is None or board.relative_speed is None:
        return None
    return board.relative_speed / here.relative_speed


def on_board(costs: TechniqueCosts, here: Board, board: Board) -> TechniqueCosts:
    """The costs probed `here` as they would be on `board`; its times are left as they are where no ratio is known."""
    ratio = speed_ratio(here, board) or 1.0

    def scaled(cost: StageCost) -> StageCost:
        busy_cores = cost.cpu_s / cost.wall_s if cost.wall_s else 0.0
        return StageCost(cost.wall_s / ratio * max(1.0, busy_cores / board.cores), cost.cpu_s / ratio)

    return replace(
        costs,
        encode=scaled(costs.encode),
        match_per_place=scaled(costs.match_per_place),
        scan_per_place=scaled(costs.scan_per_place),
    )


def fit(board: Board, costs: TechniqueCosts, places: int, rate_hz: float, budget_mb: float) -> Fit:
    """Whether a technique fits: the map in `budget_mb`, the process in its memory, the queries in the CPU's time.

    A query is over before the next one begins, and all of them together take `cpu_share` of the cores at most.
    """
    encode, match = costs.encode, costs.match(places)
    usable_cores = board.cores * board.cpu_share
    map_ram_mb = costs.ram_bytes_per_place * places / 1e6
    process_ram_mb = costs.process_mb + map_ram_mb
    reachable_hz = min(1 / (encode.wall_s + match.wall_s), usable_cores / (encode.cpu_s + match.cpu_s))

    shortfalls, remedies = [], []
    if map_ram_mb > budget_mb:
        shortfalls.append(f"its map takes {map_ram_mb:.1f} MB of RAM and {budget_mb:.1f} are allowed")
    if process_ram_mb > board.memory_max_mb:
        shortfalls.append(f"the process takes {process_ram_mb:.0f} MB and {board.memory_max_mb:.0f} are allowed")
    if reachable_hz < rate_hz:
        shortfalls.append(f"it reaches {_rounded_down(reachable_hz):g} Hz of {rate_hz:g}")
    if shortfalls:
        most_places = min(
            min(budget_mb, board.memory_max_mb - costs.process_mb) * 1e6 / costs.ram_bytes_per_place,
            costs.places_within(1 / rate_hz - encode.wall_s, usable_cores / rate_hz - encode.cpu_s),
        )
        if most_places >= 1:
            remedies.append(f"with up to {int(most_places)} places")
        if process_ram_mb <= board.memory_max_mb:
            if map_ram_mb <= budget_mb and reachable_hz >= _LOWEST_RATE_HZ:
                remedies.append(f"at up to {_rounded_down(reachable_hz):g} Hz")
            elif reachable_hz >= rate_hz:
                remedies.append(f"with a budget of {math.ceil(map_ram_mb)} MB")
    return Fit(map_ram_mb, process_ram_mb, reachable_hz, tuple(shortfalls), tuple(remedies))


def choose(board: Board, costs: Mapping[str, TechniqueCosts], places: int, rate_hz: float, budget_mb: float) -> Choice:
    """Take the first technique that fits: `costs`, as they are on `board`, come best technique first.

    Raises UsageError, saying what would make one fit, where none does.
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
    """A fit in one line of figures, with what is wrong and what would mend it where it does not fit."""
    figures = (
        f"{places} places take {found.map_ram_mb:.1f} of {budget_mb:.1f} MB, the process {found.process_ram_mb:.0f} of "
        f"{board.memory_max_mb:.0f} MB, and {_rounded_down(found.reachable_hz):g} Hz of {rate_hz:g} are reached with "
        f"{board.cores * board.cpu_share:.2g} of {board.cores} cores"
    )
    if not found.shortfalls:
        return figures
    remedies = f", it would fit {' or '.join(found.remedies)}" if found.remedies else ""
    return f"{figures}; it does not fit ({' and '.join(found.shortfalls)}{remedies})"


def _quickest(costs: list[StageCost]) -> StageCost:
    return min(costs, key=lambda cost: cost.wall_s)


def _times(cost: StageCost, count: float) -> StageCost:
    return StageCost(cost.wall_s * count, cost.cpu_s * count)


def _rounded_down(value: float) -> float:
    """To two digits, and never up: what is said to be reached is reached."""
    step = 10.0 ** (math.floor(math.log10(value)) - 1)
    return math.floor(value / step) * step
