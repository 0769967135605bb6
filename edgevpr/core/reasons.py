"""Reasons why a match was accepted or refused, or a fix was or was not sent: codes, parameters and sentences.

Programs, tests and statistics use the code and its parameters. The sentence is for people and may change at any time.
The findings of `edgevpr check` and `doctor` have their own table, `runtime/service/findingcodes.py`."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from string import Formatter
from typing import Any

from edgevpr.core.text import format_probability

Parameters = Mapping[str, float | str | None]
_FIGURES = (
    "track filter {track_confidence:probability}; ",
    "confidence {confidence:probability}, {min_confidence:probability} needed: ",
    "{regions_ratio:.1f} times as many regions agree as for the runner-up ({regions_share:.0%})",
    ", {landmarks:.0f} landmarks agree",
    ", against {rival_landmarks:.0f} for another place",
    ", {landmarks_ratio:.2f} times as many landmarks as for the runner-up",
    ", {coverage_share:.1%} of the place agrees",
    ", its surroundings agree {surroundings_ratio:.2f} times as much as its middle",
)


class Code(Enum):
    """A code with a `summary` of a few words, and the `parts` of its sentence: templates with parameters in braces (if
    none are given, the summary is the sentence). A part is omitted if any of its parameters is unknown."""

    def __init__(self, summary: str, *parts: str) -> None:
        self.summary, self.parts = summary, parts or (summary,)

    @property
    def parameters(self) -> frozenset[str]:
        """Names of the parameters that the sentence uses."""
        return frozenset(name for part in self.parts for name in _list_names(part))


class ReasonCode(Code):
    """Codes for matches, fixes, notes of a flight, the channel to the autopilot, and changes by the governor."""

    # Match accepted
    ACCEPTED_BY_CONFIDENCE = "accepted", *_FIGURES
    ACCEPTED_BY_SCORE = "accepted", "score {score:.3f}, {margin:.3f} ahead of the best place elsewhere"
    ACCEPTED_WITHOUT_RIVAL = "accepted", "score {score:.3f}; there is no other place to compare with"

    # Image not searched
    NOT_SEARCHED = "not searched"
    IMAGES_UNCHANGED = "camera frozen: images do not change"
    IMAGES_REPEATED = "camera frozen: images repeat"
    AGE_UNKNOWN = "age of images unknown", "{summary}: they do not match the aircraft's motion, so none are used"
    LOW_TEXTURE = "too little texture in the image", "{summary}: {usable_share:.0%} usable, {min_share:.0%} needed"
    TILTED = "the image is not levelled", "{summary}: it is tilted {tilt_deg:.0f} degrees"
    TILTED_WITHOUT_HEADING = "the image is not levelled", "{summary}: tilted {tilt_deg:.0f} degrees, heading unknown"
    TILTED_OFF_GROUND = (
        "the image is not levelled",
        "{summary}: tilted {tilt_deg:.0f} degrees, so it shows {visible_share:.0%} of the ground below the camera",
    )
    NOT_MEMORABLE = "not memorable", "{summary}: {measure} {score:.2f}, {min_score:.2f} needed"
    UNUSABLE = "unusable", "{problem}"
    MAP_UNREADABLE = "the map cannot be read", "{problem}"
    PLACE_UNREADABLE = "a place cannot be read", "{problem}"
    UNEXPECTED_ERROR = "unexpected error", "unexpected {error} ({problem}): report it with the output of --debug"

    # Match refused
    LOW_SCORE = "not similar enough to any place", "{summary}: score {score:.3f}, {min_score:.3f} needed"
    LOW_MARGIN = "margin over the best place elsewhere too small", "{summary}: {margin:.3f}, {min_margin:.3f} needed"
    NO_RIVAL = "no other place to compare with", "{summary}: the score alone is not enough"
    PLACE_UNREAD = "an unreadable place may be the correct one"
    NOT_CALIBRATED = "map is not calibrated", "{summary}: no confidence available"
    LOW_CONFIDENCE = "confidence too low", "{summary}: ", *_FIGURES
    LOOKS_ALIKE = "another place may look the same", "{summary}: ", *_FIGURES
    LANDMARKS_NEEDED = "too few landmarks to exclude a similar place", "{summary}: ", *_FIGURES
    ELSEWHERE_AGREES_BETTER = "another place matches better", "{summary}: ", *_FIGURES
    TRACK_CONTRADICTS = "the track filter contradicts the match", "{summary}: ", *_FIGURES
    ROTATION_AMBIGUOUS = "the same place matches nearly as well at another rotation", "{summary}: ", *_FIGURES
    ELSEWHERE_AT_REST = (
        "other places also match without any shift",
        "{summary}, as an overlay in the image would make them: mask the overlay (`source.mask`)",
    )
    LANDMARKS_DISAGREE = "landmarks and regions disagree on the offset", "{summary}: {landmarks:.0f} support another"
    FEW_LANDMARKS = "too few landmarks agree", "{summary}: {landmarks:.0f}, {min_landmarks:.0f} needed at this score"
    TILT_SHOWN = (
        "no tilt was reported, but the image looks tilted",
        "{summary} by about {tilt_deg:.0f} degrees: set `source.mount_ahead_deg`, or record roll and pitch",
    )
    POSITIONS_DISAGREE = "places that show the same ground disagree on the position", "{summary} by {distance_m:.0f} m"
    SEQUENCE_INCOMPLETE = "the sequence is not complete yet", "{summary}: {queries:.0f} queries of {min_queries:.0f}"
    NEWEST_DISAGREES = "the newest query resembles other places more"
    NEWEST_ELSEWHERE = "the newest queries show different ground from the earlier ones"
    LOW_MARGIN_AT_OTHER_SPEED = (
        "margin over the best match at another assumed speed too small",
        "{summary}: {margin:.3f}, {min_margin:.3f} needed",
    )

    # Fix not sent
    DRY_RUN = "dry run: no fix is sent"
    NO_LINK = "there is no link to the autopilot"
    PLACE_WITHOUT_POSITION = "the place has no position"
    INVALID_POSITION = "its position is invalid", "{problem}"
    NOT_BELOW_AIRCRAFT = "not sent: the image is not levelled, so it does not show the ground below the aircraft"
    NO_TELEMETRY = "not sent: no telemetry from the autopilot yet"
    CONTINUOUS = "included in the continuous position"
    HAS_GPS = "not needed: the autopilot has GPS"
    HAS_WRONG_GPS = "not sent: the map contradicts GPS, but the autopilot accepts no fixes while it has GPS"
    MAP_CONTRADICTS_GPS = "not sent: the map has contradicted GPS since the first match"
    NOT_BETTER = (
        "not needed: the autopilot's position is as good",
        "not needed: the autopilot is {distance_m:.1f} m from our position, which is accurate to {accuracy_m:.1f} m",
    )
    HELD_ROTATED = "held back: contradicts compass", "held back: {rotation_deg:.0f} degrees off the compass heading"
    HELD_OFF_GPS = (
        "held back: far from GPS",
        "held back: {distance_m:.0f} m from the position by GPS and earlier fixes",
    )
    HELD_OFF_PATH = (
        "held back: far from the predicted position",
        "held back: {distance_m:.0f} m from the predicted position (+-{accuracy_m:.0f} m): another fix must agree",
    )
    HELD_UNCONFIRMED = "held back: nothing confirms it yet", "held back: the first for a long time: another must agree"
    PAUSED = "not sent: paused by the ground station"
    PARAMETER_DANGEROUS = "not sent: a parameter is dangerous", "not sent: set {changes}. {why}"
    PARAMETERS_UNANSWERED = "not sent: parameters not reported", "not sent: the autopilot has not reported {names}"
    FIXES_UNANSWERED = "not sent: the autopilot has not answered five fixes in a row"
    ANSWERS_RESUMED = "not sent: the autopilot has only just resumed answering"
    FRAME_TOO_OLD = "its frame is too old", "its frame is {age_s:.1f} s old, and the limit is {limit_s:g} s"
    SUPERSEDED = "replaced by a newer fix"
    NO_AUTOPILOT = "no autopilot to receive it", "{summary} within {limit_s:g} s"
    CLOCK_UNKNOWN = "the autopilot's time was not received", "{summary} within {limit_s:g} s"
    NOT_ENCODABLE = "it cannot be encoded in its MAVLink message", "{summary} ({problem})"
    LINK_LOST = "the link was lost before it was sent"

    # Fix without an answer
    NO_ANSWER = "it got no answer", "{summary} within {limit_s:g} s"
    LINK_LOST_BEFORE_ANSWER = "the link was lost before its answer arrived"
    ENDED_BEFORE_ANSWER = "the flight ended before its answer arrived"
    AUTOPILOT_REPLACED = "another autopilot has taken its place"
    AUTOPILOT_RESTARTED = "the autopilot has restarted"

    # The autopilot's answer to fixes, or its silence: "it" is the autopilot, and a summary has at most 26 bytes
    FIX_ACCEPTED = "accepted", "the autopilot accepts fixes"
    GPS_IN_USE = "GPS in use", "one of its GPS receivers has a fix, and with GPS it accepts no other position"
    NOT_STARTED = "filter not started", "its position filter has not started: on a plane it starts only with GPS"
    NO_ORIGIN = "no origin", "it has no origin, so it accepts no position: it needs GPS once, or an origin sent to it"
    NOT_ARMED = "not armed", "it is not armed: on the ground it has no dead-reckoned position to correct"
    NO_ESTIMATE = "no position source", "it has no position estimate: it has no GPS, airspeed, optical flow or vision"
    OTHER_AID = "not dead reckoning", "it accepts a fix only while it dead-reckons without any other aiding"
    NOT_PLAUSIBLE = "fix not plausible", "it is dead-reckoning, but the fix is not plausible or it has no origin"
    NO_CAUSE = "see its log", "it gives no reason: perhaps it just regained GPS, or has no origin or position source"
    OTHER_ANSWER = "see its log", "it answers {result}"
    WRONG_FORM = "wrong format", "it rejects their format"
    NO_COMMAND = (
        "43003 not supported",
        "its firmware has no command 43003, or was built without it, as for boards with 1 MB of flash",
    )
    NO_COMMAND_ANSWERED = (
        "signing? system id?",
        "it answers none of our commands: does its port accept only signed messages, does another vehicle have its ",
        "system id, or does the line carry no data towards it?",
    )
    FIXES_NOT_ANSWERED = (
        "no command 43003?",
        "it answers other commands: is its firmware built without 43003, or does another program use our ",
        "component id?",
    )

    # Notes of a flight. The ground station gets the summary if the sentence is too long for a STATUSTEXT.
    FRAMES_FAILING = "frames keep failing", "{frames:.0f} frames in a row have failed"
    FRAMES_RECOVERED = "frames are being processed again"
    IMAGE_BLANK = "camera image is blank"
    GROUND_VISIBLE = "camera sees the ground again"
    MAP_LEFT = "aircraft has left the map"
    MAP_FOUND = "aircraft is back on the map"
    TILT_TOO_LARGE = "tilt too large"
    TILT_FINE = "tilt is acceptable again"
    MAP_LOST = "map cannot be read, see the log"
    MAP_BACK = "map can be read again"
    IMAGES_CHANGE_AGAIN = "camera works again: images change"
    AGE_KNOWN = "age of images known again"
    DELAY_FOUND = "images are late: corrected", "images are {delay_s:.1f} s older than their timestamps: corrected"
    DELAY_GONE = "image timestamps are correct again"
    IMAGES_ROTATED = (
        "images are rotated",
        "images are rotated {rotation_deg:.0f} degrees from the heading: if the compass is right, ",
        "set source.up_deg: {up_deg:.0f}",
    )
    IMAGES_MIRRORED = "images are mirrored", "{summary}, so none can match: switch off mirror or flip in the camera"
    STRIP_FOUND = "part of the image never changes", "{width_px:.0f} px at the {edge} never change: crop"
    HEIGHT_DIFFERS = "height differs", "height: autopilot {autopilot_height_m:.0f} m, images {image_height_m:.0f} m"
    HEIGHT_AGREES = "height agrees with images again"
    GPS_DIFFERS = "GPS is far from the map", "GPS is {distance_m:.0f} m from the map's position"
    GPS_AGREES = "GPS agrees with the map again"
    SURVEY_WITHDRAWN = "map offset unknown again", "{summary}: GPS contradicts the reported one"
    PAUSED_BY_COMMAND = "paused by command"
    RESUMED_BY_COMMAND = "resumed by command"
    UNDER_VOLTAGE = "companion under-voltage: check 5 V supply"
    SUPPLY_FINE = "companion supply is back to normal"
    THROTTLED = "companion throttled", "{summary}", " at {temperature_c:.0f} C", ": runs slower"
    FULL_SPEED = "companion runs at full speed again"
    HOT = "companion hot", "{summary}", " at {temperature_c:.0f} C", ": improve its cooling"
    COOL = "companion is cool again", "{summary}", " at {temperature_c:.0f} C"

    # Channel to the autopilot: "its" parameters are the autopilot's
    BY_GPS_INPUT = "GPS_INPUT", "GPS_INPUT, because its {parameter} is 14"
    BY_ODOMETRY = "ODOMETRY", "ODOMETRY, because its {parameter} is 1", "; source set {source_set:.0f} without GPS"
    BY_MESSAGE_296 = "message 296", "GLOBAL_POSITION_SENSOR (296), because its {parameter} enables position fusion"
    COMMAND_TO_PLANE = "command 43003, which a dead-reckoning plane accepts at any time"
    COMMAND_NEEDS_FLOW = (
        "command 43003",
        "command 43003, which a {vehicle} accepts only with optical flow; without it, set {change}",
    )
    COMMAND_WITHOUT_296 = "command 43003", "command 43003, because it has no {parameter} for message 296 (PX4 1.18 has)"
    COMMAND_FOR_296 = (
        "command 43003",
        "command 43003, because its {parameter} does not enable message 296: change it, and reboot the autopilot",
    )
    COMMAND_TO_ANY = "command 43003, the only channel used with unknown firmware"
    PARAMETER_WEAK = "a parameter should be changed", "set {changes}. {why}"

    # Change by the governor
    BOARD_HOT = "the board is too hot", "{temperature_c:.0f} °C, and the limit is {limit_c:.0f} °C"
    BOARD_THROTTLED = "the board throttles itself"
    CPU_OVER_LIMIT = "too much CPU used", "{cpu_share:.0%} of all cores used, {max_share:.0%} allowed"
    QUERIES_LATE = "queries are late: other programs or the disk delay them"
    MEMORY_OVER_LIMIT = "too much memory used", "{used_mb:.0f} MB of memory used, {max_mb:.0f} MB allowed"
    RESOURCES_FREE = "resource use is back to normal"


@dataclass(frozen=True, slots=True)
class Reason:
    """A code and its parameters in this case, numbers or text (None or missing: unknown). `str` gives the sentence."""

    code: Code
    parameters: Parameters = field(default_factory=dict)

    def __str__(self) -> str:
        return "".join(self._fill(part) for part in self.code.parts) or self.code.summary

    def fields(self) -> dict[str, Any]:
        """Return the reason as fields for the flight log and JSON, without unknown parameters."""
        values = {name: value for name, value in self.parameters.items() if value is not None}
        return {"code": self.code.name, "parameters": values}

    def _fill(self, part: str) -> str:
        if any(self.parameters.get(name) is None for name in _list_names(part)):
            return ""
        try:
            return _SentenceFormatter().vformat(part, (), {"summary": self.code.summary, **self.parameters})
        except (ValueError, TypeError):  # parameters from a damaged log
            return ""


NOT_SEARCHED = Reason(ReasonCode.NOT_SEARCHED)


class _SentenceFormatter(Formatter):
    """Formats parameters; the format `probability` calls `format_probability`."""

    def format_field(self, value: Any, format_spec: str) -> str:
        if format_spec == "probability":
            return format_probability(value)
        return str(super().format_field(value, format_spec))


def read_reason(fields: object) -> Reason | None:
    """Return the reason written as `fields`; None if this version has no such reason."""
    match fields:
        case {"code": str() as name, "parameters": dict() as parameters} if name in ReasonCode.__members__:
            plain = {key: value for key, value in parameters.items() if type(value) in (int, float, str)}
            return Reason(ReasonCode[name], plain)
    return None


def _list_names(part: str) -> list[str]:
    return [name for _, name, _, _ in Formatter().parse(part) if name and name != "summary"]
