"""The walk of one frame: encode, retrieve, accept or not, what it cost. `Pipeline.step` reads from top to bottom."""

from dataclasses import dataclass, replace
from pathlib import Path

from edgevpr import techniques
from edgevpr.config import Config
from edgevpr.errors import MapError, UsageError
from edgevpr.places.index import PlaceIndex, load_index
from edgevpr.places.mapfile import PlaceMap
from edgevpr.places.retrieve import named, rank
from edgevpr.power.boards import Board, load_board
from edgevpr.power.equations import Pack, parse_pack
from edgevpr.power.meter import query_cost, stage
from edgevpr.runtime.accept import AcceptRule, accept_rule, accepted
from edgevpr.runtime.choose import described, fit, on_board, probe
from edgevpr.types import Frame, PlaceMatch, Technique


@dataclass(frozen=True, slots=True)
class Pipeline:
    """Everything that one query needs. `accuracy_m` is the 1-sigma that a fix claims; `reason` says in one line why
    this technique flies, and whether the board can afford it; `rate_hz` is how often it is asked."""

    technique: Technique
    place_map: PlaceMap
    index: PlaceIndex
    rule: AcceptRule
    candidates: int
    board: Board
    pack: Pack
    regulator_efficiency: float
    accuracy_m: float
    rate_hz: float
    reason: str

    def step(self, frame: Frame) -> PlaceMatch:
        """Recognise one frame. The position is the place's, and only there when the match is accepted."""
        with stage() as encoding:
            query = self.technique.encode(frame.image)
        with stage() as matching:
            ranking = rank(self.technique, query, self.place_map, self.index, self.candidates, self.rule.neighbour_m)
            is_accepted, reason = accepted(ranking, self.index, self.rule)
            (best,) = named(ranking, self.index, self.place_map, first=1)
        cost = query_cost(encoding.cost, matching.cost, self.board, self.pack, self.regulator_efficiency)
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
        )


def open_pipeline(config: Config, settings: dict[str, str] | None = None) -> Pipeline:
    """Open the map, make its technique, load the index. Raises a sentence for anything that does not go together, and
    for `settings` of the technique that the map was not built with."""
    if config.map is None:
        raise UsageError("There is no map to recognise places in: name one with --map, or `map:` in the configuration.")
    board = load_board(config.board)
    pack = parse_pack(config.battery.pack)
    place_map = PlaceMap.open(Path(config.map))
    wanted = {"camera": config.source.camera, "matching": config.match.matching}
    wanted = {key: value for key, value in wanted.items() if value} | (settings or {})
    technique = technique_of(place_map, config.technique, wanted)
    rate_hz = config.source.rate_hz or board.rate_hz
    budget_mb = config.memory.budget_mb or board.budget_mb
    index = load_index(place_map, technique, int(budget_mb * 1e6))
    candidates = config.match.candidates or technique.candidates
    why = "the map was built with it" if config.technique is None else "it was named"
    left_out = len(place_map) - len(index)
    thinned = f"{left_out} places are left to the map file; " if left_out else ""
    return Pipeline(
        technique,
        place_map,
        index,
        accept_rule(technique, config.match),
        candidates,
        board,
        pack,
        config.battery.regulator_efficiency,
        max(config.mavlink.min_accuracy_m, index.spacing_m() or 0.0),
        rate_hz,
        f"technique {technique.spec.name}: {why}; {thinned}"
        f"{_affordable(technique, board, len(index), candidates, rate_hz, budget_mb)}",
    )


def _affordable(
    technique: Technique, board: Board, places: int, candidates: int, rate_hz: float, budget_mb: float
) -> str:
    """What the technique takes of the board, tried here and now, in a line: no reason not to fly."""
    try:
        costs = on_board(probe(technique), load_board("this"), board)
    except (MapError, OSError) as error:  # the trial map needs a little room for temporary files
        return f"what it takes could not be tried ({error})"
    if technique.spec.fine:
        costs = replace(costs, candidates=candidates)
    return described(board, fit(board, costs, places, rate_hz, budget_mb), places, rate_hz, budget_mb)


def technique_of(place_map: PlaceMap, name: str | None = None, settings: dict[str, str] | None = None) -> Technique:
    """The technique that a map was built with. Raises MapError where `name` or `settings` ask for another, and
    UsageError for a setting that it does not have."""
    built_with = place_map.spec
    if built_with.name not in techniques.names():
        raise MapError(
            f"{place_map.path} was built with `{built_with.name}`, which this edgevpr does not have: update "
            f"edgevpr, or build the map with one of {', '.join(techniques.names())}."
        )
    if name in (None, built_with.name):
        technique = techniques.create(built_with.name, {**built_with.parameters, **(settings or {})})
    else:
        technique = techniques.create(name, settings)
    place_map.require(technique.spec)
    return technique
