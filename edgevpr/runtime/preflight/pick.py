"""Chooses a technique for a new map, and describes the accuracy and cost of a flight's technique."""

import logging
from random import Random

import numpy as np

from edgevpr import techniques
from edgevpr.core.contract import Technique, TechniqueSpec
from edgevpr.core.errors import EdgevprError, ModelError
from edgevpr.core.types import Frame
from edgevpr.power.boards import Board, load_board
from edgevpr.runtime.preflight.choose import (
    Demand,
    Option,
    choose_best,
    describe_option,
    explain_no_choice,
    find_accuracy,
    list_fewer_candidates,
    list_preferred,
    make_option,
)
from edgevpr.runtime.preflight.instructions import compute_costs, count_work, explain_unknown_costs
from edgevpr.runtime.preflight.probe import TechniqueCosts, measure_costs
from edgevpr.runtime.recognise.opening import make_technique
from edgevpr.runtime.recognise.recogniser import Recogniser
from edgevpr.techniques.card import describe_weights

_log = logging.getLogger(__name__)


def pick_technique(board_name: str, places: int, camera: str | None = None) -> str:
    """Choose a technique for a new map of `places` places by its accuracy and its cost on the board, and log the reason
    (see `choose`). `camera`: "nadir" or "forward" (None: forward).

    A technique of unknown cost on the board is chosen only if it is set in the board's profile, or if no cost is
    known. If none fits the board, choose the first usable technique of `list_preferred` and log why it does not fit: a
    map is built once, and may be flown on a larger board. Raises ModelError if no technique can be used at all.
    """
    board = load_board(board_name)
    demand = Demand(places=places, rate_hz=board.rate_hz, budget_mb=board.budget_mb, camera=camera)
    options: list[Option] = []
    unknown: list[str] = []
    for name in list_preferred(board, camera):
        try:
            technique = make_technique(board.threads, name, make_camera_setting(name, camera))
        except ModelError as error:
            _log.warning("technique %s is unusable: %s", name, error)
            continue
        if costs := _measure_costs(technique, board):
            options.append(make_option(board, _make_label(technique.spec), name, costs, demand))
        else:
            unknown.append(name)
    if unknown and (unknown[0] == board.technique or not options):
        _log.warning("technique %s: its cost is %s", unknown[0], explain_unknown_costs(board))
        return unknown[0]
    if not options:
        raise ModelError("No technique is usable: fix the problems listed above, or use another technique.")
    best = choose_best(options, board)
    if best is None:
        _log.warning("using technique %s anyway: %s", options[0].name, explain_no_choice(options, board))
        return options[0].name
    others = [f"{other.label} {other.objection}" for other in options if other.name != best.name and other.objection]
    _log.info("technique %s: %s", best.label, "; ".join([describe_option(board, best, demand), *others]))
    return best.name


def explain_technique(recogniser: Recogniser, is_named: bool) -> str:
    """Return one line for the log: the technique that a flight uses, and why. `is_named`: it is set in the
    configuration."""
    spec = recogniser.technique.spec
    parts = ["set in the configuration" if is_named else "the map was built with it"]
    if weights := describe_weights(spec):
        parts.append(f"weights of {weights}")
    if left_out := len(recogniser.place_map) - len(recogniser.index):
        parts.append(f"{left_out} places of the map are not loaded")
    return f"technique {_make_label(spec)}: {'; '.join(parts)}"


def describe_accuracy(technique: Technique) -> str:
    """Return the accuracy of a technique on the image sets as text."""
    return str(find_accuracy(_make_label(technique.spec), _read_camera(technique.spec)) or "never measured")


def measure_query(recogniser: Recogniser, size_px: tuple[int, int]) -> float | None:
    """Return the seconds that a query takes on this machine, with a noise image of `size_px` (width, height), which
    costs the most to match because every region has structure; None if the salience gate refuses it before the search.
    Raises EdgevprError if the query fails."""
    width_px, height_px = size_px
    image = np.frombuffer(Random(0).randbytes(height_px * width_px), np.uint8).reshape(height_px, width_px)
    for number in range(recogniser.sequence + 1):  # until the sequence is complete; the first query is a warm-up
        event = recogniser.step(Frame(image=image, name="noise", t_mono_s=float(number)))
    if event.failed:
        raise EdgevprError(f"The test query failed: {event.reason}.")
    return event.cost.whole.wall_s if event.ranking else None


def list_safe_candidates(technique: Technique) -> tuple[int, ...]:
    """Return the numbers of candidates below the technique's default with which it accepted no place far from the
    correct one on the image sets, largest first."""
    label, camera = _make_label(technique.spec), _read_camera(technique.spec)
    measured = ((count, find_accuracy(label, camera, count)) for count in list_fewer_candidates(label, camera))
    return tuple(count for count, accuracy in measured if accuracy and not accuracy.accepted_elsewhere)


def make_camera_setting(name: str, camera: str | None) -> dict[str, str]:
    """Return the camera-direction setting for the technique `name`; empty if the direction is unknown (None) or the
    technique has no such parameter."""
    return {"camera": camera} if camera and "camera" in techniques.read_parameters(name) else {}


def _make_label(spec: TechniqueSpec) -> str:
    """Return the name and form of a technique, with ", thesis" for cohog without the vote, which was not measured."""
    return techniques.format_name(spec.name, spec.form) + (
        "" if spec.name != "cohog" or _uses_vote(spec) else ", thesis"
    )


def _uses_vote(spec: TechniqueSpec) -> bool:
    """Return True if a technique is `cohog` with the vote, whose costs and accuracy were measured. Only the vote has
    quick scores (forward camera) or several height ratios (downward camera)."""
    return bool(spec.max_matches or spec.height_ratios)


def _read_camera(spec: TechniqueSpec) -> str | None:
    """Return a technique's camera direction, "nadir" or "forward"; None if it has no such parameter."""
    camera = spec.parameters.get("camera")
    return None if camera is None else str(camera)


def _measure_costs(technique: Technique, board: Board) -> TechniqueCosts | None:
    """Return the costs of a technique on `board`; None if they are unknown."""
    if board.is_this_machine():
        return measure_costs(technique)
    spec = technique.spec
    work = count_work(spec.name, spec.parameters) if _uses_vote(spec) else None
    if work is None or board.benchmark_score.arm64_mips is None:
        return None  # before the measurement, which takes seconds
    return compute_costs(measure_costs(technique), board, work)
