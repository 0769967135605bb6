"""The event of one frame: everything that happened to it, in one value."""

from dataclasses import asdict, dataclass
from typing import Any

from edgevpr.contract import Descriptor
from edgevpr.frames.level import UNKNOWN_VIEW, View
from edgevpr.places.retrieve import Ranking
from edgevpr.runtime.recognise.hints import Hints
from edgevpr.salience.gate import Worth
from edgevpr.types import Candidate, FixReport, Frame, Position, QueryCost, Steps, Vehicle

_OF_THE_BEST = ("place", "reference_image", "score", "position", "shift_cells", "covariance_cells2", "rotation_deg")


@dataclass(frozen=True, slots=True, kw_only=True)
class Recognition:
    """Result of one frame.

    The inputs are `frame` and `vehicle`, the autopilot's report when the frame was taken (None: no report). `view` is
    how the picture that was encoded lies on the ground, `worth` what the gate says of the frame (None: no gate looks),
    `descriptor` the encoded frame, `hints` what narrowed the search, `ranking` the places found and `best` the first of
    them; each is None where its step was not reached. `accepted` tells whether `best` is taken for the place, and
    `reason` why (not), in a few words. `position` is the place's, and `accuracy_m` its 1-sigma; both are set for an
    accepted match only: any other carries no position. `says_nothing` tells whether the picture holds too little to be
    recognised; a place was then searched for only to go on with a sequence.

    `failed` tells whether the frame, a place or the technique could not be used, and `map_lost` whether that is because
    the map as a whole cannot be read. `left_out` are the places that have been left out since the last event because
    they cannot be read: the number of each, and what is wrong with it.

    `steps` and `cost` are what the frame took. `fix` tells what became of the position, and `last_fix` the same of the
    one sent before it. The channel to the autopilot fills them in; they are None where there was nothing to send.
    """

    frame: Frame | None
    vehicle: Vehicle | None = None
    view: View = UNKNOWN_VIEW
    worth: Worth | None = None
    descriptor: Descriptor | None = None
    hints: Hints | None = None
    ranking: Ranking | None = None
    best: Candidate | None = None
    accepted: bool = False
    reason: str
    says_nothing: bool = False
    failed: bool = False
    map_lost: bool = False
    left_out: tuple[tuple[int, str], ...] = ()
    position: Position | None = None
    accuracy_m: float | None = None
    steps: Steps
    cost: QueryCost
    fix: FixReport | None = None
    last_fix: FixReport | None = None

    @property
    def is_query(self) -> bool:
        """True where the frame became a query: it could be read and encoded."""
        return self.descriptor is not None


def fields_of(event: Recognition) -> dict[str, Any]:
    """Return the event as the flight log (kind "query") and `edgevpr match --json` have it.

    The fields are: query, place (id), reference_image, score, position (of the place), the match's step, its covariance
    and the rotation (all null where no place was found), accepted, reason, accuracy_m, costs; where a gate looks,
    salience; and, where anything is known of how the picture lies on the ground, view.
    """
    return {
        "query": event.frame.name,
        **_best(event.best),
        **({"view": event.view.fields()} if event.view != UNKNOWN_VIEW else {}),
        **({"salience": event.worth.salience.rounded()} if event.worth else {}),
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
