"""Picking a technique where none is named, and telling whether the board can afford the one that flies."""

import logging
from collections.abc import Iterator
from dataclasses import dataclass, replace

from edgevpr import techniques
from edgevpr.config import Config
from edgevpr.contract import Technique
from edgevpr.errors import MapError, ModelError, UsageError
from edgevpr.places.index import bytes_per_place
from edgevpr.places.sequence import bytes_beside_place
from edgevpr.power.boards import Board, load_board
from edgevpr.runtime.preflight.choose import choose, described, fit, preferred
from edgevpr.runtime.preflight.probe import probe, probe_each
from edgevpr.runtime.preflight.scale import on_board
from edgevpr.runtime.recognise.opening import budget_mb, made_for
from edgevpr.runtime.recognise.recogniser import Recogniser
from edgevpr.techniques.networks.card import weights_of

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Outlook:
    """The technique that flies and why, in one line, and the seconds that a query will take (None: it could not be
    tried)."""

    reason: str
    t_query_s: float | None


def picked_technique(board_name: str, places: int, camera: str | None = None) -> str:
    """Pick the best technique that the board can afford, for a `camera` that looks down or ahead; log the reason in one
    line.

    Where the board can afford none, the best is picked all the same, and the log says what is lacking: a map is made
    once, and may be flown on a larger board. Raises ModelError where no technique can be used at all.
    """
    board, here = load_board(board_name), load_board("this")
    tried = _usable(board, preferred(board, camera), camera)
    costs = {name: on_board(cost, here, board) for name, cost in probe_each(tried)}
    if not costs:
        raise ModelError("No technique can be used here (see above): correct what it names, or name another one.")
    try:
        choice = choose(board, costs, places, board.rate_hz, board.budget_mb)
    except UsageError as error:
        best = next(iter(costs))
        _log.warning("technique %s is taken all the same: %s", best, error)
        return best
    _log.info("technique %s", choice.reason)
    return choice.technique


def outlook(recogniser: Recogniser, config: Config) -> Outlook:
    """Say which technique flies and why, and try here and now whether its board can afford it. Never a reason not to
    fly."""
    spec, board = recogniser.technique.spec, recogniser.meter.board
    weights = weights_of(spec)
    left_out = len(recogniser.place_map) - len(recogniser.index)
    afforded, t_query_s = _afforded(recogniser, config, board)
    parts = (
        "the map was built with it" if config.technique is None else "it was named",
        weights and f"weights of {weights}",
        left_out and f"{left_out} places are left to the map file",
        afforded,
    )
    name = techniques.labelled(spec.name, spec.form)
    return Outlook(f"technique {name}: {'; '.join(filter(None, parts))}", t_query_s)


def _afforded(recogniser: Recogniser, config: Config, board: Board) -> tuple[str, float | None]:
    technique, places = recogniser.technique, len(recogniser.index)
    rate_hz, limit_mb = config.source.rate_hz or board.rate_hz, budget_mb(config, board)
    try:
        costs = on_board(probe(technique), load_board("this"), board)
    except (MapError, ModelError, OSError) as error:  # the trial map needs a little room for temporary files
        return f"what it takes could not be tried ({error})", None
    beside_bytes = bytes_beside_place(recogniser.search.length)
    costs = replace(costs, ram_bytes_per_place=bytes_per_place(technique.spec) + beside_bytes)
    if technique.spec.fine:
        costs = replace(costs, candidates=recogniser.candidates)
    found = fit(board, costs, places, rate_hz, limit_mb)
    return described(board, found, places, rate_hz, limit_mb), found.t_query_s


def camera_setting(name: str, camera: str | None) -> dict[str, str]:
    """Return the setting that tells a technique which way the camera looks, if that is known and the technique has such
    a setting."""
    return {"camera": camera} if camera and "camera" in techniques.parameters(name) else {}


def _usable(board: Board, names: tuple[str, ...], camera: str | None) -> Iterator[Technique]:
    """Make each technique; one whose network cannot be used here is passed over and logged."""
    for name in names:
        try:
            yield made_for(board, name, camera_setting(name, camera))
        except ModelError as error:
            _log.warning("technique %s is passed over: %s", name, error)
