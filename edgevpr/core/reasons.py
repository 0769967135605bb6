"""Why a match was accepted or refused, and a fix sent or not: codes with parameters, and the one table of sentences.

Programs, tests and counts work on the code and its parameters; people read the sentence, which may change at any time.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from string import Formatter
from typing import Any

from edgevpr.core.text import format_probability

Parameters = Mapping[str, float | str | None]
_FIGURES = (
    "track filter {track:probability}; ",
    "confidence {confidence:probability}, {needed:probability} needed: ",
    "{regions_ratio:.1f} times as many regions agree as for the runner-up ({regions_share:.0%})",
    ", {landmarks:.0f} landmarks agree",
    ", and {rival_landmarks:.0f} with a place elsewhere",
    ", and {landmarks_ratio:.2f} times as many landmarks",
    ", {coverage_share:.1%} of the place agrees",
)


class ReasonCode(Enum):
    """The codes, each with its `summary` of a few words and the parts of its sentence (none: the summary), in which
    names in braces are parameters. A part is left out if a parameter of it is unknown."""

    # Of a match that was accepted
    ACCEPTED_BY_CONFIDENCE = "accepted", *_FIGURES
    ACCEPTED_BY_SCORE = "accepted", "score {score:.3f}, {lead:.3f} ahead of any place elsewhere"
    ACCEPTED_WITHOUT_RIVAL = "accepted", "score {score:.3f}; there is no place elsewhere to compare with"

    # Of a picture that was not searched for
    NOT_SEARCHED = "not searched for"
    PICTURES_STAY = "camera frozen: pictures stay the same"
    PICTURES_REPEAT = "camera frozen: pictures repeat"
    LOW_TEXTURE = "too little texture in the image", "{summary}: {usable:.0%} usable, {needed:.0%} needed"
    TILTED = "the image is not levelled", "{summary}: it is tilted {tilt_deg:.0f} degrees"
    TILTED_WITHOUT_HEADING = "the image is not levelled", "{summary}: tilted {tilt_deg:.0f} degrees, heading unknown"
    TILTED_OFF_GROUND = (
        "the image is not levelled",
        "{summary}: it shows {shown:.0%} of the ground under it at a tilt of {tilt_deg:.0f} degrees",
    )
    NOT_MEMORABLE = "not memorable", "{summary}: {measure} {score:.2f}, {needed:.2f} needed"
    EMPTY_MAP = "the map has no place yet"
    UNUSABLE = "unusable", "{problem}"
    MAP_UNREADABLE = "the map cannot be read", "{problem}"
    PLACE_UNREADABLE = "a place cannot be read", "{problem}"
    UNFORESEEN = "an unforeseen error", "an unforeseen {error} ({problem}): report it, with the output of --debug"

    # Of a match that was refused
    LOW_SCORE = "not similar enough to any place", "{summary}: score {score:.3f}, {needed:.3f} needed"
    LOW_LEAD = "too little ahead of a place elsewhere", "{summary}: {lead:.3f}, {needed:.3f} needed"
    NO_RIVAL = "no place elsewhere to compare with", "{summary}: the score alone does not decide"
    PLACE_UNREAD = "a place that cannot be read may be the right one"
    NOT_CALIBRATED = "map is not calibrated", "{summary}: no confidence available"
    LOW_CONFIDENCE = "confidence too low", "{summary}: ", *_FIGURES
    ELSEWHERE_AGREES_BETTER = "a place elsewhere agrees better", "{summary}: ", *_FIGURES
    TRACK_CONTRADICTS = "the track filter contradicts it", "{summary}: ", *_FIGURES
    TURNED_AGREES = "the same place agrees nearly as well if the picture is turned otherwise", "{summary}: ", *_FIGURES
    ELSEWHERE_AT_REST = "places elsewhere have not moved either", "{summary}: is it a display? mask it (`source.mask`)"
    LANDMARKS_DISAGREE = (
        "landmarks and regions disagree on the offset",
        "{summary}: {landmarks:.0f} landmarks support another one",
    )
    FEW_LANDMARKS = "too few landmarks agree", "{summary}: {landmarks:.0f}, {needed:.0f} needed at such a score"
    POSITIONS_DISAGREE = "places of the same ground disagree on the position", "{summary} by {apart_m:.0f} m"
    JUST_LEARNT = "place was learnt just now", "{summary}, within {limit_s:g} s: it repeats the autopilot's position"
    SEQUENCE_INCOMPLETE = "the sequence is not complete yet", "{summary}: {queries:.0f} queries of {needed:.0f}"
    NEWEST_DISAGREES = "other places resemble the newest query more than this one does"
    NEWEST_LEFT = "the newest queries no longer see what those before them saw"
    LOW_LEAD_AT_OTHER_SPEED = (
        "too little ahead of a place elsewhere that is passed at another speed",
        "{summary}: {lead:.3f}, {needed:.3f} needed",
    )

    def __init__(self, summary: str, *parts: str) -> None:
        self.summary, self.parts = summary, parts or (summary,)

    @property
    def parameters(self) -> frozenset[str]:
        """Names of the parameters of the sentence."""
        return frozenset(name for part in self.parts for name in _names(part))


@dataclass(frozen=True, slots=True)
class Reason:
    """A code with the parameters of this case, numbers or text (None or not there: unknown). As text it is the
    sentence."""

    code: ReasonCode
    parameters: Parameters = field(default_factory=dict)

    def __str__(self) -> str:
        return "".join(self._fill(part) for part in self.code.parts) or self.code.summary

    def fields(self) -> dict[str, Any]:
        """Return the reason as fields of the flight log and of JSON, without unknown parameters."""
        known = {name: value for name, value in self.parameters.items() if value is not None}
        return {"code": self.code.name, "parameters": known}

    def _fill(self, part: str) -> str:
        if any(self.parameters.get(name) is None for name in _names(part)):
            return ""
        try:
            return _Sentences().vformat(part, (), {"summary": self.code.summary, **self.parameters})
        except (ValueError, TypeError):  # of a log that is damaged
            return ""


NOT_SEARCHED = Reason(ReasonCode.NOT_SEARCHED)


class _Sentences(Formatter):
    """Formats parameters; the format `probability` is that of `format_probability`."""

    def format_field(self, value: Any, format_spec: str) -> str:
        if format_spec == "probability":
            return format_probability(value)
        return str(super().format_field(value, format_spec))


def read_reason(fields: object) -> Reason | None:
    """Return the reason that was written as `fields`; None if they are none of this version."""
    match fields:
        case {"code": str() as name, "parameters": dict() as parameters} if name in ReasonCode.__members__:
            return Reason(ReasonCode[name], {key: value for key, value in parameters.items() if _is_plain(value)})
    return None


def _is_plain(value: object) -> bool:
    return isinstance(value, (int, float, str)) and not isinstance(value, bool)


def _names(part: str) -> list[str]:
    return [name for _, name, _, _ in Formatter().parse(part) if name and name != "summary"]
