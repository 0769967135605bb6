"""The event of one frame: everything that happened to it, in one value. Made by the recogniser, written to the log."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

from edgevpr.core.contract import Descriptor
from edgevpr.core.types import Candidate, FixReport, Frame, Position, QueryCost, Steps, Vehicle
from edgevpr.frames.level import UNKNOWN_VIEW, Levelled, View
from edgevpr.places.retrieve import Ranking
from edgevpr.runtime.recognise.agreement import Agreement
from edgevpr.runtime.recognise.follow import Followed
from edgevpr.runtime.recognise.hints import Hints
from edgevpr.runtime.recognise.locate import Located
from edgevpr.runtime.recognise.salience_gate import Worth

_OF_THE_BEST = ("place", "reference_image", "score", "position", "shift_cells", "covariance_cells2", "rotation_deg")


@dataclass(slots=True, kw_only=True)
class Recognition:
    """Result of one frame, which the recogniser fills in on the way. A field is None if its step was not reached.

    * `frame`, and `vehicle`, the autopilot's report when the frame was taken (None: no report)
    * `picture`: the picture that was encoded, and how it lies on the ground; `descriptor`: the encoded picture
    * `worth`: the judgement of the salience gate (None: no gate)
    * `hints`, which narrowed the search; `ranking`, the places found; `best`, the first of them
    * `proof`: the agreement of the landmarks (None: not compared)
    * `evidence` of the match (see `evidence`), and `confidence`, the probability by that evidence that the match is
      right (None: the technique is judged by limits); `followed`: the result with the flight so far
    * `accepted`: is `best` taken for the place? `reason`: why or why not, in a few words
    * `says_nothing`: the picture shows too little to be recognised; a search was only made to continue a sequence
    * `failed`: the frame, a place or the technique was unusable; `map_lost`: the whole map cannot be read
    * `left_out`: unreadable places that are left out since the last event: number, and what is wrong
    * `located`: the position of the aircraft; `accuracy_m`: the 1-sigma to send with it. Both are set only if the match
      is accepted and the place has a position
    * `steps`: the time that each step took; `cost`: time, memory and battery charge of the whole query
    * `fix`: what became of the position; `last_fix`: what became of the one sent before. The channel to the autopilot
      sets both (None: nothing was sent)
    """

    frame: Frame | None
    vehicle: Vehicle | None = None
    picture: Levelled | None = None
    worth: Worth | None = None
    descriptor: Descriptor | None = None
    hints: Hints | None = None
    ranking: Ranking | None = None
    best: Candidate | None = None
    proof: Agreement | None = None
    evidence: Mapping[str, float] | None = None
    confidence: float | None = None
    followed: Followed | None = None
    accepted: bool = False
    reason: str = ""
    says_nothing: bool = False
    failed: bool = False
    map_lost: bool = False
    left_out: tuple[tuple[int, str], ...] = ()
    located: Located | None = None
    accuracy_m: float | None = None
    steps: Steps = field(default_factory=Steps)
    cost: QueryCost = field(default_factory=QueryCost)
    fix: FixReport | None = None
    last_fix: FixReport | None = None

    @property
    def view(self) -> View:
        """The way in which the picture lies on the ground; `UNKNOWN_VIEW` without a picture."""
        return self.picture.view if self.picture else UNKNOWN_VIEW

    @property
    def position(self) -> Position | None:
        """Position of the aircraft; None unless the match was accepted and the place has a position."""
        return self.located.position if self.located else None

    @property
    def name(self) -> str:
        """Name of the frame, "" if there is none."""
        return self.frame.name if self.frame else ""

    @property
    def is_query(self) -> bool:
        """True if the frame became a query: it could be read and encoded."""
        return self.descriptor is not None


def fields_of(event: Recognition) -> dict[str, Any]:
    """Return the event as a dict for the flight log (kind "query") and for `edgevpr match --json`.

    Always there: query, place (number), reference_image, score, position (of the place), shift, covariance and rotation
    of the match (all null if no place was found), accepted, reason, accuracy_m, located (the aircraft's position; null
    if nothing was accepted), costs. Only if known: view (how the picture lies on the ground), salience, landmarks,
    confidence, evidence, followed.
    """
    known: dict[str, Any] = {
        "view": event.view.fields() if event.view != UNKNOWN_VIEW else None,
        "salience": event.worth and event.worth.salience.rounded(),
        "landmarks": event.proof and _landmarks(event.proof),
        "confidence": _rounded(event.confidence, 6),
        "evidence": event.evidence and {key: round(value, 3) for key, value in event.evidence.items()},
        "followed": event.followed and _followed(event.followed),
    }
    return {
        "query": event.frame and event.frame.name,
        **_best(event.best),
        **{key: value for key, value in known.items() if value is not None and value != {}},
        "accepted": event.accepted,
        "reason": event.reason,
        "accuracy_m": event.accuracy_m,
        "located": event.located and _located(event.located),
        "costs": {key: value and float(f"{value:.6g}") for key, value in asdict(event.cost).items()},
    }


def _best(candidate: Candidate | None) -> dict[str, Any]:
    if candidate is None:
        return dict.fromkeys(_OF_THE_BEST)
    place, match = candidate.place, candidate.match
    position = asdict(place.position) if place.position else None
    named = (place.place_id, place.source_image, round(match.score, 5), position)
    step = (match.shift_cells, match.covariance_cells2, match.rotation_deg)
    return dict(zip(_OF_THE_BEST, (*named, *step), strict=True))


def _landmarks(proof: Agreement) -> dict[str, Any]:
    fields: dict[str, Any] = {"inliers": proof.inliers, "matched": proof.matched}
    if proof.shift_share is not None:
        fields["shift_share"] = [round(share, 4) for share in proof.shift_share]
        fields |= {"rotation_deg": _rounded(proof.rotation_deg, 1), "scale": _rounded(proof.scale, 3)}
    return fields


def _followed(followed: Followed) -> dict[str, Any]:
    fields = {"confidence": round(followed.confidence, 6), "lost": round(followed.lost, 6)}
    return fields | (_where(followed.estimate) if followed.estimate else {})


def _located(where: Located) -> dict[str, Any]:
    return _where(where) | {"height_ratio": _rounded(where.height_ratio, 3), "places": list(where.places)}


def _where(where: Located) -> dict[str, Any]:
    return {
        "lat_deg": round(where.position.lat_deg, 8),
        "lon_deg": round(where.position.lon_deg, 8),
        "covariance_m2": [round(value, 3) for value in where.covariance_m2],
        "heading_deg": _rounded(where.heading_deg, 1),
    }


def _rounded(value: float | None, digits: int) -> float | None:
    return None if value is None else round(value, digits)
