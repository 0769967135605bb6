"""The walk of one frame: encode, retrieve, accept or not, what it cost. `Pipeline.step` reads from top to bottom."""

import logging
import time
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

from edgevpr import techniques
from edgevpr.config import Config
from edgevpr.errors import MapError, ModelError, UsageError
from edgevpr.places.growing import GrowingIndex
from edgevpr.places.index import PlaceIndex, bytes_per_place, empty_index, load_index
from edgevpr.places.mapfile import PlaceMap
from edgevpr.places.retrieve import named, rank
from edgevpr.places.sequence import Sequence, bytes_beside_place, length_of, sequence_of
from edgevpr.power.boards import Board, load_board
from edgevpr.power.equations import Pack, parse_pack
from edgevpr.power.meter import PssMeter, query_cost, stage
from edgevpr.runtime.preflight.choose import choose, described, fit, preferred
from edgevpr.runtime.preflight.probe import probe, probe_each
from edgevpr.runtime.preflight.scale import on_board
from edgevpr.runtime.recognise.hints import Hints, allowed, turned_deg
from edgevpr.runtime.recognise.judge import AcceptRule, accept_rule, accepted
from edgevpr.techniques.networks.card import weights_of
from edgevpr.types import Frame, PlaceMatch, Technique

_log = logging.getLogger(__name__)
_ROOM = 20_000  # places to learn in a flight: two hundred kilometres at the usual spacing; beyond, RAM keeps the best
_RELOAD_S = 10.0  # a map that takes longer to load is not loaded again in flight: nothing is recognised meanwhile
_NEW_MAP_PLACES = 1000  # what a technique must be able to fly with, to be picked for a map that is still empty


@dataclass(frozen=True, slots=True)
class Pipeline:
    """Everything that one query needs. `accuracy_m` is the 1-sigma that a fix claims; `reason` says in one line why
    this technique flies, and whether the board can afford it; `rate_hz` is how often it is asked. `smaller_forms` of
    the index may be taken in flight (see `in_form`)."""

    technique: Technique
    place_map: PlaceMap
    index: PlaceIndex
    rule: AcceptRule
    candidates: int
    sequence: Sequence | None
    board: Board
    pack: Pack
    regulator_efficiency: float
    accuracy_m: float
    rate_hz: float
    reason: str
    smaller_forms: tuple[str, ...] = ()
    pss: PssMeter = field(default_factory=PssMeter)

    @property
    def looks_down(self) -> bool:
        """Whether a query is tried in several rotations, so that its heading says something."""
        return self.technique.spec.parameters.get("camera") == "nadir"

    def step(self, frame: Frame, hints: Hints | None = None) -> PlaceMatch:
        """Recognise one frame. The position is the place's, and only there when the match is accepted."""
        with stage() as encoding:
            query = self.technique.encode(frame.image)
        best, is_accepted, reason = None, False, "the map has no place yet"
        with stage() as matching:
            if len(self.index):
                ranking = rank(
                    self.technique,
                    query,
                    self.place_map,
                    self.index,
                    self.candidates,
                    self.rule.neighbour_m,
                    allowed(hints, self.index),
                    turned_deg(hints, self.index),
                )
                if self.sequence:
                    ranking = self.sequence.follow(ranking, self.index, frame.t_mono_s)
                is_accepted, reason = accepted(ranking, self.index, self.rule, self.sequence)
                (best,) = named(ranking, self.index, self.place_map, first=1)
        pss_mb = self.pss.look()
        cost = query_cost(encoding.cost, matching.cost, self.board, self.pack, self.regulator_efficiency, pss_mb)
        position = best.place.position if is_accepted else None
        return PlaceMatch(
            frame.name,
            frame.t_mono_s,
            best,
            is_accepted,
            reason,
            position,
            self.accuracy_m if position else None,
            cost,
            query,
        )


def open_pipeline(config: Config, settings: dict[str, str] | None = None) -> Pipeline:
    """Open the map, make its technique, load the index. Raises a sentence for anything that does not go together, and
    for `settings` of the technique that the map was not built with."""
    if config.map is None:
        raise UsageError("There is no map to recognise places in: name one with --map, or `map:` in the configuration.")
    board = load_board(config.board)
    place_map = PlaceMap.open(Path(config.map))
    technique = technique_of(place_map, config.technique, _wanted(config) | (settings or {}), board)
    begin_s = time.monotonic()
    index = _loaded(config, board, technique, place_map)
    whole = len(index) == len(place_map)  # of a part, a smaller form would fill the budget with more places
    forms = _smaller_forms(config, technique) if whole and time.monotonic() - begin_s <= _RELOAD_S else ()
    return replace(_pipeline(config, board, technique, place_map, index), smaller_forms=forms)


def in_form(pipeline: Pipeline, config: Config, form: str) -> Pipeline:
    """The pipeline with its index loaded from the map in another form, and what is accepted of it. Give it one whose
    index is `without_index`, so that the two are not in memory together. Raises MapError where the map is gone."""
    wanted = _wanted(config) | {"form": form}
    technique = technique_of(pipeline.place_map, config.technique, wanted, pipeline.board)
    index = _loaded(config, pipeline.board, technique, pipeline.place_map)
    length = length_of(technique, config.match.sequence)
    return replace(
        pipeline,
        technique=technique,
        index=index,
        rule=accept_rule(technique, config.match, length),
        sequence=sequence_of(length),
        accuracy_m=claimed_accuracy_m(config, index),
    )


def without_index(pipeline: Pipeline) -> Pipeline:
    """The pipeline with no place in memory: it recognises nothing until another index is there."""
    return replace(pipeline, index=empty_index(pipeline.technique.spec, 0, None))


def _loaded(config: Config, board: Board, technique: Technique, place_map: PlaceMap) -> PlaceIndex:
    beside_bytes = bytes_beside_place(length_of(technique, config.match.sequence))
    return load_index(place_map, technique, int(_budget_mb(config, board) * 1e6), beside_bytes=beside_bytes)


def _smaller_forms(config: Config, technique: Technique) -> tuple[str, ...]:
    """Forms of the same vectors that cost less. Their scores are others, so that where the user has said from which
    score on a match is accepted, that holds for one form only."""
    form = getattr(technique, "form", None)
    if form is None or config.match.min_score is not None or config.match.min_margin is not None:
        return ()
    from edgevpr.techniques.vectors import FORMS  # here it is in memory already

    return FORMS[FORMS.index(form) + 1 :]


def open_learning(config: Config) -> tuple[Pipeline, GrowingIndex]:
    """As `open_pipeline`, with a map that places can be added to, made new where there is none, and the index that
    takes them: what the budget leaves is their room."""
    if config.map is None:
        raise UsageError("There is no map to learn places into: name one with --map, or `map:` in the configuration.")
    board, path = load_board(config.board), Path(config.map)
    if path.exists() and path.stat().st_size:
        place_map = PlaceMap.open_for_adding(path)
        technique = technique_of(place_map, config.technique, _wanted(config), board)
    else:
        name = config.technique or picked_technique(config.board, _NEW_MAP_PLACES)
        technique = made_for(board, name, _wanted(config))
        place_map = _new_map(path, technique)
    place_map.index_positions()
    beside_bytes = bytes_beside_place(length_of(technique, config.match.sequence))
    growing = GrowingIndex(
        place_map=place_map,
        technique=technique,
        budget_bytes=int(_budget_mb(config, board) * 1e6),
        room=_ROOM,
        beside_bytes=beside_bytes,
    )
    return _pipeline(config, board, technique, place_map, growing.index), growing


def _new_map(path: Path, technique: Technique) -> PlaceMap:
    """An empty map that is there as a whole or not at all: a service that is killed at power-on must start again."""
    unfinished = path.with_name(path.name + ".new")
    for left in ("", "-wal", "-shm", "-journal"):
        unfinished.with_name(unfinished.name + left).unlink(missing_ok=True)
    PlaceMap.create(unfinished, technique.spec).close()
    unfinished.replace(path)
    return PlaceMap.open_for_adding(path)


def claimed_accuracy_m(config: Config, index: PlaceIndex) -> float:
    """The 1-sigma accuracy of a fix: between two places nobody knows better."""
    return max(config.mavlink.min_accuracy_m, index.spacing_m() or 0.0)


def _wanted(config: Config) -> dict[str, str]:
    wanted = {"camera": config.source.camera, "matching": config.match.matching, "form": config.match.form}
    return {key: value for key, value in wanted.items() if value}


def _budget_mb(config: Config, board: Board) -> float:
    return config.memory.budget_mb or board.budget_mb


def _pipeline(config: Config, board: Board, technique: Technique, place_map: PlaceMap, index: PlaceIndex) -> Pipeline:
    rate_hz = config.source.rate_hz or board.rate_hz
    budget_mb = _budget_mb(config, board)
    length = length_of(technique, config.match.sequence)
    candidates = config.match.candidates or technique.candidates
    why = "the map was built with it" if config.technique is None else "it was named"
    left_out = len(place_map) - len(index)
    thinned = f"{left_out} places are left to the map file; " if left_out else ""
    name = techniques.labelled(technique.spec.name, getattr(technique, "form", None))
    weights = weights_of(technique.spec)
    weights = f"weights of {weights}; " if weights else ""
    return Pipeline(
        technique,
        place_map,
        index,
        accept_rule(technique, config.match, length),
        candidates,
        sequence_of(length),
        board,
        parse_pack(config.battery.pack),
        config.battery.regulator_efficiency,
        claimed_accuracy_m(config, index),
        rate_hz,
        f"technique {name}: {why}; {weights}{thinned}"
        f"{_affordable(technique, board, len(index), candidates, length, rate_hz, budget_mb)}",
    )


def _affordable(
    technique: Technique, board: Board, places: int, candidates: int, length: int, rate_hz: float, budget_mb: float
) -> str:
    """What the technique takes of the board, tried here and now, in a line: no reason not to fly."""
    try:
        costs = on_board(probe(technique), load_board("this"), board)
    except (MapError, OSError) as error:  # the trial map needs a little room for temporary files
        return f"what it takes could not be tried ({error})"
    costs = replace(costs, ram_bytes_per_place=bytes_per_place(technique.spec) + bytes_beside_place(length))
    if technique.spec.fine:
        costs = replace(costs, candidates=candidates)
    return described(board, fit(board, costs, places, rate_hz, budget_mb), places, rate_hz, budget_mb)


def picked_technique(board_name: str, places: int) -> str:
    """The best technique that the board can afford; the reason is logged in one line."""
    board, here = load_board(board_name), load_board("this")
    tried = _usable(board, preferred(board))
    costs = {name: on_board(cost, here, board) for name, cost in probe_each(tried)}
    choice = choose(board, costs, places, board.rate_hz, board.budget_mb)
    _log.info("technique %s", choice.reason)
    return choice.technique


def _usable(board: Board, names: tuple[str, ...]) -> Iterator[Technique]:
    """Make each; a network that cannot be used here is passed over, and said."""
    for name in names:
        try:
            yield made_for(board, name)
        except ModelError as error:
            _log.warning("technique %s is passed over: %s", name, error)


def made_for(board: Board | None, name: str, settings: dict[str, str] | None = None) -> Technique:
    """The technique `name`; a network with as many threads as the board spares for it (None: one)."""
    return made_with(board.threads if board else None, name, settings)


def made_with(threads: int | None, name: str, settings: dict[str, str] | None = None) -> Technique:
    """The technique `name`; a network with `threads` (None: one), where `settings` do not say how many."""
    own = {"threads": threads} if threads and "threads" in techniques.parameters(name) else {}
    return techniques.create(name, {**own, **(settings or {})})


def technique_of(
    place_map: PlaceMap, name: str | None = None, settings: dict[str, str] | None = None, board: Board | None = None
) -> Technique:
    """The technique that a map was built with, made for `board`. Raises MapError where `name` or `settings` ask for
    another, UsageError for a setting that it does not have, and ModelError for a network that cannot be used."""
    built_with = place_map.spec
    if not techniques.is_known(built_with.name):
        raise MapError(
            f"{place_map.path} was built with `{built_with.name}`, which this edgevpr does not have: update edgevpr, "
            "add its network with `edgevpr models add`, or build the map with one of "
            f"{', '.join(techniques.names())}."
        )
    if name in (None, built_with.name):
        technique = made_for(board, built_with.name, {**built_with.parameters, **(settings or {})})
    else:
        technique = made_for(board, name, settings)
    place_map.require(technique.spec)
    return technique
