"""One query as a record: the same in the flight log (kind "query") and in `edgevpr match --json`."""

from dataclasses import asdict
from typing import Any

from edgevpr.types import PlaceMatch


def record(event: PlaceMatch) -> dict[str, Any]:
    """query, place (id), reference_image, score, accepted, reason, position (of the place), accuracy_m, the match's
    step, its covariance and the rotation, costs."""
    place, match = event.candidate.place, event.candidate.match
    return {
        "query": event.query,
        "place": place.place_id,
        "reference_image": place.source_image,
        "score": round(match.score, 5),
        "accepted": event.accepted,
        "reason": event.reason,
        "position": asdict(place.position) if place.position else None,
        "accuracy_m": event.accuracy_m,
        "shift_cells": match.shift_cells,
        "covariance_cells2": match.covariance_cells2,
        "rotation_deg": match.rotation_deg,
        "costs": {key: float(f"{value:.6g}") for key, value in asdict(event.cost).items()},
    }
