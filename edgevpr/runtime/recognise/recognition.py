"""The event of one frame: everything that happened to it, in one value."""

from dataclasses import asdict, dataclass
from typing import Any

from edgevpr.contract import Descriptor
from edgevpr.places.retrieve import Ranking
from edgevpr.runtime.recognise.hints import Hints
from edgevpr.types import Candidate, FixReport, Frame, Position, QueryCost, Steps, Vehicle

_OF_THE_BEST = ("place", "reference_image", "score", "position", "shift_cells", "covariance_cells2", "rotation_deg")


@dataclass(frozen=True, slots=True, kw_only=True)
class Recognition:
    """What became of a frame.

    `frame` and what the autopilot said of the `vehicle` when it was taken (None: nothing) went in; `descriptor` is what
    the frame was encoded as, `hints` what narrowed the search, `ranking` the places that were found and `best` the
    first of them, each None where it did not come to that. `accepted` is whether `best` is taken for the place,
    `reason` why (not), in a few words; `failed` whether the frame, a place or the technique could not be used.
    `position` is the place's and `accuracy_m` its 1-sigma, both only there when the match is accepted: what is not
    accepted moves nothing.

    `steps` and `cost` are what it took. `fix` says what became of the position, and `last_fix` of the one sent before
    it; the channel to the autopilot fills them in, and they are None where there was nothing to send.
    """

    frame: Frame | None
    vehicle: Vehicle | None = None
    descriptor: Descriptor | None = None
    hints: Hints | None = None
    ranking: Ranking | None = None
    best: Candidate | None = None
    accepted: bool = False
    reason: str
    failed: bool = False
    position: Position | None = None
    accuracy_m: float | None = None
    steps: Steps
    cost: QueryCost
    fix: FixReport | None = None
    last_fix: FixReport | None = None

    @property
    def is_query(self) -> bool:
        """Say whether the frame became a query: it could be read and encoded."""
        return self.descriptor is not None


def fields_of(event: Recognition) -> dict[str, Any]:
    """Give the event as the flight log (kind "query") and `edgevpr match --json` have it: query, place (id),
    reference_image, score, position (of the place), the match's step, its covariance and the rotation (all null where
    no place was found), accepted, reason, accuracy_m, costs."""
    return {
        "query": event.frame.name,
        **_best(event.best),
        "accepted": event.accepted,
        "reason": event.reason,
        "accuracy_m": event.accuracy_m,
        "costs": {key: value and float(f"{value:.6g}") for key, value in asdict(event.cost).items()},
    }


def _best(candidate: Candidate | None) -> dict[str, Any]:
    if candidate is None:
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
