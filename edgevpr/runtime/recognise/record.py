"""One query as a record: the same in the flight log (kind "query") and in `edgevpr match --json`."""

from dataclasses import asdict
from typing import Any

from edgevpr.types import Candidate, PlaceMatch

_OF_THE_BEST = ("place", "reference_image", "score", "position", "shift_cells", "covariance_cells2", "rotation_deg")


def record(event: PlaceMatch) -> dict[str, Any]:
    """query, place (id), reference_image, score, accepted, reason, position (of the place), accuracy_m, the match's
    step, its covariance and the rotation (all null while the map has no place), costs."""
    return {
        "query": event.query,
        **_best(event.candidate),
        "accepted": event.accepted,
        "reason": event.reason,
        "accuracy_m": event.accuracy_m,
        "costs": {key: value and float(f"{value:.6g}") for key, value in asdict(event.cost).items()},
    }


def _best(candidate: Candidate | None) -> dict[str, Any]:
    if candidate is None:  # the map has no place yet
        return dict.fromkeys(_OF_THE_BEST)
    place, match = candidate.place, candidate.match
    values = (
        place.place_id,
        place.source_image,
        round(match.score, 5),
        asdict(place.position) if place.position else None,
        match.shift_cells,
        match.covariance_cells2,
        match.rotation_deg,
    )
    return dict(zip(_OF_THE_BEST, values, strict=True))
