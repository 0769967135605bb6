"""The event of one frame: the results of all stages in one value, made by the recogniser and written to the log."""

from dataclasses import asdict, dataclass, field
from typing import Any

from edgevpr.core.contract import Descriptor
from edgevpr.core.reasons import NOT_SEARCHED, Reason
from edgevpr.core.types import Candidate, FixReport, Frame, Position, QueryCost, StepCosts, Vehicle
from edgevpr.frames.level import UNKNOWN_VIEW, LevelledImage, View
from edgevpr.places.ranking import Ranking
from edgevpr.runtime.recognise.agreement import Agreement
from edgevpr.runtime.recognise.evidence import Evidence
from edgevpr.runtime.recognise.hints import Hints
from edgevpr.runtime.recognise.locate import Located
from edgevpr.runtime.recognise.odometry import OdometryStep
from edgevpr.runtime.recognise.place_filter import TrackEstimate
from edgevpr.runtime.recognise.salience_gate import SalienceVerdict

_BEST_FIELDS = ("place", "reference_image", "score", "position", "shift_cells", "covariance_cells2", "rotation_deg")


@dataclass(frozen=True, slots=True, kw_only=True)
class Recognition:
    """Result of one frame. A field is None if its stage was not reached.
    `fix` reports how the position was sent (None: the event was not yet passed to the channel to the autopilot)."""

    frame: Frame | None
    vehicle: Vehicle | None = None  # the autopilot's report when the frame was taken
    picture: LevelledImage | None = None  # as encoded, with its view of the ground
    salience: SalienceVerdict | None = None  # judgement of the salience gate
    descriptor: Descriptor | None = None
    odometry: OdometryStep | None = None  # since the previous frame
    hints: Hints | None = None  # used to narrow the search
    ranking: Ranking | None = None
    best: Candidate | None = None  # the first place of the ranking
    agreement: Agreement | None = None  # of the landmarks
    evidence: Evidence | None = None
    confidence: float | None = None  # that the match is correct, from the evidence (None: judged by limits)
    track: TrackEstimate | None = None  # result of the place filter
    accepted: bool = False  # `best` is accepted as the place
    reason: Reason = NOT_SEARCHED  # of the acceptance or refusal
    lacks_texture: bool = False  # too little to recognise a place; searched only to continue a sequence
    failed: bool = False  # the frame, a place or the technique was unusable
    map_lost: bool = False  # the whole map cannot be read
    left_out: tuple[tuple[int, str], ...] = ()  # places that became unreadable since the last event: number and problem
    located: Located | None = None  # position of the aircraft, only if the match is accepted and the place has one
    accuracy_m: float | None = None  # 1-sigma accuracy to send with it
    steps: StepCosts = field(default_factory=StepCosts)
    cost: QueryCost = field(default_factory=QueryCost)
    fix: FixReport | None = None

    @property
    def view(self) -> View:
        """The picture's view of the ground; `UNKNOWN_VIEW` without a picture."""
        return self.picture.view if self.picture else UNKNOWN_VIEW

    @property
    def position(self) -> Position | None:
        """Position of the aircraft; None unless the match was accepted and the place has a position."""
        return self.located.position if self.located else None

    @property
    def name(self) -> str:
        """Name of the frame; "" without a frame."""
        return self.frame.name if self.frame else ""

    @property
    def is_query(self) -> bool:
        """True if the frame was read and encoded, so that it is a query."""
        return self.descriptor is not None


def to_fields(event: Recognition, *, exact: bool = False) -> dict[str, Any]:
    """Return the event as a dict for the flight log (kind "query"), `edgevpr match` and the status of a flight.
    `exact`: do not round the confidence (rounded to six digits, a nearly certain one would become 1).

    Always present: query, place (number), reference_image, score, position (of the place), shift, covariance, rotation
    of the match (all null if no place was found), accepted, reason, accuracy_m, located (the aircraft's position; null
    if nothing was accepted), costs. Present if known: view (how the picture maps to the ground), salience, odometry,
    landmarks, confidence, evidence, track (of the place filter)."""
    optional: dict[str, Any] = {
        "view": event.view.fields() if event.view != UNKNOWN_VIEW else None,
        "salience": event.salience and event.salience.scores.rounded(),
        "odometry": event.odometry and event.odometry.fields(),
        "landmarks": event.agreement and _landmark_fields(event.agreement),
        "confidence": event.confidence if exact else _round(event.confidence, 6),
        "evidence": event.evidence and {key: round(value, 3) for key, value in event.evidence.figures().items()},
        "track": event.track and _track_fields(event.track),
    }
    return {
        "query": event.frame and event.frame.name,
        **_best_fields(event.best),
        **{key: value for key, value in optional.items() if value is not None and value != {}},
        "accepted": event.accepted,
        "reason": event.reason.fields(),
        "accuracy_m": event.accuracy_m,
        "located": event.located and _located_fields(event.located),
        "costs": {key: value and float(f"{value:.6g}") for key, value in asdict(event.cost).items()},
    }


def _best_fields(candidate: Candidate | None) -> dict[str, Any]:
    if candidate is None:
        return dict.fromkeys(_BEST_FIELDS)
    place, match = candidate.place, candidate.match
    position = asdict(place.position) if place.position else None
    identity = (place.place_id, place.source_image, round(match.score, 5), position)
    alignment = (match.shift_cells, match.covariance_cells2, match.rotation_deg)
    return dict(zip(_BEST_FIELDS, (*identity, *alignment), strict=True))


def _landmark_fields(agreement: Agreement) -> dict[str, Any]:
    fields: dict[str, Any] = {"inliers": agreement.inliers, "matched": agreement.matched}
    if agreement.shift_share is not None:
        fields["shift_share"] = [round(fraction, 4) for fraction in agreement.shift_share]
        fields |= {"rotation_deg": _round(agreement.rotation_deg, 1), "scale": _round(agreement.scale, 3)}
    return fields


def _track_fields(track: TrackEstimate) -> dict[str, Any]:
    fields = {"confidence": round(track.confidence, 6), "lost": round(track.lost, 6)}
    return fields | (_pose_fields(track.estimate) if track.estimate else {})


def _located_fields(located: Located) -> dict[str, Any]:
    fields = _pose_fields(located)
    fields |= {"height_ratio": _round(located.height_ratio, 3), "places": list(located.places)}
    if located.height_m is not None:
        fields["height_m"] = round(located.height_m, 1)
    if error := located.attitude_error:
        fields["attitude_error"] = [round(value, 4) for value in (*error.nadir_shift, error.sd)]
    return fields


def _pose_fields(located: Located) -> dict[str, Any]:
    return {
        "lat_deg": round(located.position.lat_deg, 8),
        "lon_deg": round(located.position.lon_deg, 8),
        "covariance_m2": [round(value, 3) for value in located.covariance_m2],
        "heading_deg": _round(located.heading_deg, 1),
    }


def _round(value: float | None, digits: int) -> float | None:
    return None if value is None else round(value, digits)
