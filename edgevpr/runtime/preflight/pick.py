"""What the technique that flies costs the board."""

from dataclasses import replace

from edgevpr import techniques
from edgevpr.core.contract import Technique, TechniqueSpec
from edgevpr.power.boards import Board
from edgevpr.runtime.preflight.choose import (
    Demand,
    describe_option,
    find_accuracy,
    list_fewer_candidates,
    make_option,
)
from edgevpr.runtime.preflight.probe import TechniqueCosts, compute_ram_bytes, measure_costs
from edgevpr.runtime.preflight.scale import compare_speed, count_work, scale_to_board
from edgevpr.runtime.recognise.recogniser import Recogniser
from edgevpr.techniques.card import describe_weights


def explain_technique(recogniser: Recogniser, is_named: bool) -> str:
    """Return the technique that a flight uses, and why, in one line for the log. `is_named`: the configuration names
    it."""
    spec = recogniser.technique.spec
    parts = ["configured" if is_named else "the map was built with it"]
    if weights := describe_weights(spec):
        parts.append(f"weights of {weights}")
    if left_out := len(recogniser.place_map) - len(recogniser.index):
        parts.append(f"{left_out} places of the map are not loaded")
    return f"technique {_make_label(spec)}: {'; '.join(parts)}"


def measure_flight(recogniser: Recogniser) -> tuple[float, str]:
    """Measure what a flight costs its board. Returns the seconds that a query takes, and accuracy and cost as text.
    Raises EdgevprError, and OSError if there is no room for a small temporary map."""
    board, spec = recogniser.meter.board, recogniser.technique.spec
    costs = _measure_costs(recogniser.technique, board)
    costs = replace(
        costs,
        ram_bytes_per_place=compute_ram_bytes(spec, recogniser.sequence),
        candidates=recogniser.candidates if spec.fine else costs.candidates,
    )
    demand = Demand(
        places=len(recogniser.index),
        rate_hz=board.rate_hz,
        budget_mb=board.budget_mb,
        camera=_read_camera(spec),
    )
    option = make_option(board, _make_label(spec), spec.name, costs, demand)
    return option.fit.t_query_s, describe_option(board, option, demand)


def list_safe_candidates(technique: Technique) -> tuple[int, ...]:
    """Return the numbers of candidates, below the technique's default, with which it accepted no query as a place far
    from the right one on the image sets, largest first."""
    label, camera = _make_label(technique.spec), _read_camera(technique.spec)
    measured = ((count, find_accuracy(label, camera, count)) for count in list_fewer_candidates(label, camera))
    return tuple(count for count, accuracy in measured if accuracy and not accuracy.accepted_elsewhere)


def make_camera_setting(name: str, camera: str | None) -> dict[str, str]:
    """Return the setting that tells the technique `name` the direction of the camera; empty if the direction is unknown
    (None) or the technique has no such parameter."""
    return {"camera": camera} if camera and "camera" in techniques.read_parameters(name) else {}


def _make_label(spec: TechniqueSpec) -> str:
    """Return the name and form of a technique. If it matches in a way that was not measured, the label says so too."""
    return techniques.format_name(spec.name, spec.form) + (
        "" if spec.name != "cohog" or _uses_vote(spec) else ", thesis"
    )


def _uses_vote(spec: TechniqueSpec) -> bool:
    """Return True if a technique is `cohog` with the vote, whose costs and accuracy were measured: only then it scores
    quickly, looking ahead, or has several heights, looking down."""
    return bool(spec.in_full or spec.height_ratios)


def _read_camera(spec: TechniqueSpec) -> str | None:
    """Return the camera direction that a technique is set to, "nadir" or "forward"; None if it has no such setting."""
    camera = spec.parameters.get("camera")
    return None if camera is None else str(camera)


def _measure_costs(technique: Technique, board: Board) -> TechniqueCosts:
    """Measure the costs of a technique here, and convert them to `board`."""
    spec = technique.spec
    work = count_work(spec.name, spec.parameters) if _uses_vote(spec) else None
    return scale_to_board(measure_costs(technique), board, compare_speed(board), work)
