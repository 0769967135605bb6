"""Describes the accuracy and cost of a flight's technique."""

from random import Random

import numpy as np

from edgevpr import techniques
from edgevpr.core.contract import Technique, TechniqueSpec
from edgevpr.core.errors import EdgevprError
from edgevpr.core.types import Frame
from edgevpr.runtime.preflight.choose import find_accuracy, list_fewer_candidates
from edgevpr.runtime.recognise.recogniser import Recogniser
from edgevpr.techniques.card import describe_weights


def explain_technique(recogniser: Recogniser, is_named: bool) -> str:
    """Return a line for the log: the technique that a flight uses, and why. `is_named`: the configuration sets it."""
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
    """Return the name and form of a technique, with ", thesis" for cohog without the vote, which was not measured.
    Only the vote has quick scores (forward camera) or several height ratios (downward camera)."""
    is_measured = spec.name != "cohog" or spec.max_matches or spec.height_ratios
    return techniques.format_name(spec.name, spec.form) + ("" if is_measured else ", thesis")


def _read_camera(spec: TechniqueSpec) -> str | None:
    """Return a technique's camera direction, "nadir" or "forward"; None if it has no such parameter."""
    camera = spec.parameters.get("camera")
    return None if camera is None else str(camera)
