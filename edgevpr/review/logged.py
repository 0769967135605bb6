"""Reads a flight log into checked values for the report. A missing, damaged or wrongly typed field becomes None."""

import logging
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path
from typing import Any

from edgevpr.core.geodesy import distance_m, offset_position
from edgevpr.core.reasons import Reason, ReasonCode, read_reason
from edgevpr.runtime.flight.flightlog import select_last_flight

_log = logging.getLogger(__name__)

Point = tuple[float, float]  # latitude and longitude, degrees
_MAX_REPORT_AGE_S = 1.0  # maximum time between a frame and the autopilot report used for it
_REASON_FIELDS = ("note", "why")  # fields that hold a reason: the first one present is shown
_TEXT_FIELDS = ("said", "state", "problem")  # fields that hold a text for people: shown if there is no reason
_MAX_NUMBER = 1e15  # larger numbers are damaged; comparing also excludes NaN and integers too large for a float


class FixOutcome(Enum):
    """Outcome of a fix, in the words of the report. CONTINUOUS: the fix was included in the position that is sent many
    times a second, which the autopilot does not answer. NOT_SENT: it was not sent, see `why`."""

    ACCEPTED = "fix accepted"
    REFUSED = "fix refused"
    UNANSWERED = "fix not answered"
    CONTINUOUS = "in continuous position"
    NOT_SENT = "fix not sent"


SENT_OUTCOMES = (FixOutcome.ACCEPTED, FixOutcome.REFUSED, FixOutcome.UNANSWERED)


@dataclass(slots=True, kw_only=True)
class LoggedFix:
    """The fix of a query. `why`: reason why it was not sent or not accepted (None: unknown). `position`: None if there
    was nothing to send."""

    outcome: FixOutcome
    why: Reason | None
    position: Point | None
    accuracy_m: float | None


@dataclass(frozen=True, slots=True, kw_only=True)
class LoggedQuery:
    """One query. None in any field: unknown. `t_s`: time of its frame, seconds since the start of the flight.

    `line`: its line in the log. `position`: position by the match, if accepted. `place_position`: position of the place
    found. `autopilot_position`, `gps_position`: positions of the aircraft at that time by autopilot and GPS receiver.
    `true_position`, against which a match is judged, is the autopilot's if it has GPS, else the receiver's.
    `has_link`: a report from the autopilot arrived within a second."""

    line: dict[str, Any]
    name: str
    t_s: float
    accepted: bool
    reason: Reason | None
    confidence: float | None
    place: int | None
    reference_image: str | None
    position: Point | None
    accuracy_m: float | None
    place_position: Point | None
    autopilot_position: Point | None
    gps_position: Point | None
    true_position: Point | None
    fix: LoggedFix | None
    has_link: bool | None

    @property
    def off_m(self) -> float | None:
        """Distance in metres from the match to `true_position`."""
        return float(distance_m(*self.true_position, *self.position)) if self.true_position and self.position else None


@dataclass(slots=True, kw_only=True)
class LoggedFlight:
    """One flight. `path`: its log. `start`, `end`: its first and last line ({}: missing). `remarks`: time, kind and
    text of the lines with a text for people. `unusable`: number of frames that never became queries. `between`: lines
    of fixes sent between matches. Times are seconds since its start; `span_s` is its duration."""

    path: Path
    start: dict[str, Any] = field(default_factory=dict)
    end: dict[str, Any] = field(default_factory=dict)
    queries: list[LoggedQuery] = field(default_factory=list)
    remarks: list[tuple[float, str, str]] = field(default_factory=list)
    unusable: int = 0
    between: list[dict[str, Any]] = field(default_factory=list)
    span_s: float = 0.0


def read_flight(path: str | Path) -> LoggedFlight:
    """Read the last flight in the log `path`, and warn if any of its files are missing. Its first timestamp is
    its start. Raises UsageError if the file does not exist, and EdgevprError if it has no line of a flight (see
    `flightlog.select_last_flight`)."""
    lines = select_last_flight(path)
    flight, queries, start_s = LoggedFlight(path=Path(path)), dict[str, LoggedQuery](), None
    for line in lines:
        t_mono_s, t_s = get_number(line, "t_mono_s"), flight.span_s
        if t_mono_s is not None:
            start_s = t_mono_s if start_s is None else start_s
            t_s = max(0.0, t_mono_s - start_s)
        flight.span_s = max(flight.span_s, t_s)
        match kind := line.get("kind"):
            case "start":
                flight.start = line
            case "end":
                flight.end = line
            case "query":
                t_frame_s = get_number(line, "t_frame_s")
                query = _read_query(line, t_s if t_frame_s is None else max(0.0, t_frame_s - (start_s or 0.0)))
                queries[query.name] = query
                flight.queries.append(query)
            case "answer":
                if (answered_query := queries.get(get_text(line, "query") or "")) and answered_query.fix:
                    answered_query.fix.outcome = _read_outcome(line, line.get("result"))
                    answered_query.fix.why = read_reason(line.get("why")) or answered_query.fix.why
            case "unusable":
                flight.unusable += 1
            case "between":
                flight.between += [line] if get_point(line) else []
            case _:
                flight.remarks.append((t_s, str(kind), _read_text(line)))
    if lines.missing:
        _log.warning("%s", lines.missing)
        flight.remarks.insert(0, (0.0, "missing", lines.missing))
    return flight


def _read_query(line: dict[str, Any], t_s: float) -> LoggedQuery:
    """Read a log line of kind "query"."""
    t_frame_s = get_number(line, "t_frame_s")
    accepted = line.get("accepted") is True
    gps_position = _locate_gps(line, t_frame_s)
    has_link = _is_fresh(get_number(line, "vehicle", "t_received_s"), t_frame_s)
    autopilot_position = get_point(line, "vehicle") if has_link else None
    # The confidence that a match was judged by: its own or, if higher, that given the flight so far.
    confidences = get_number(line, "confidence"), get_number(line, "track", "confidence")
    place, fix = get_number(line, "place"), get_value(line, "fix")
    has_gps = get_value(line, "vehicle", "has_gps") is True
    return LoggedQuery(
        line=line,
        name=get_text(line, "query") or "",
        t_s=t_s,
        accepted=accepted,
        reason=read_reason(line.get("reason")),
        confidence=max((confidence for confidence in confidences if confidence is not None), default=None),
        place=None if place is None else int(place),
        reference_image=get_text(line, "reference_image"),
        position=get_point(line, "located") or get_point(line, "position") if accepted else None,
        accuracy_m=get_number(line, "accuracy_m"),
        place_position=get_point(line, "position"),
        autopilot_position=autopilot_position,
        gps_position=gps_position,
        # An autopilot with GPS compensates for the lag of its receiver, which is metres at 20 m/s.
        true_position=autopilot_position if gps_position and has_gps else gps_position,
        fix=_read_fix(fix) if isinstance(fix, dict) else None,
        has_link=has_link if "vehicle" in line else None,
    )


def _read_fix(fix: dict[str, Any]) -> LoggedFix:
    outcome, why = _read_outcome(fix, fix.get("answer")), read_reason(fix.get("why"))
    return LoggedFix(outcome=outcome, why=why, position=get_point(fix), accuracy_m=get_number(fix, "accuracy_m"))


def _read_outcome(fix: dict[str, Any], answer: object) -> FixOutcome:
    if fix.get("sent") is False:
        why = read_reason(fix.get("why"))
        return FixOutcome.CONTINUOUS if why and why.code is ReasonCode.CONTINUOUS else FixOutcome.NOT_SENT
    if answer is None:
        return FixOutcome.UNANSWERED
    return FixOutcome.ACCEPTED if answer == "ACCEPTED" else FixOutcome.REFUSED


def _is_fresh(t_s: float | None, t_frame_s: float | None) -> bool:
    return t_s is not None and t_frame_s is not None and abs(t_frame_s - t_s) <= _MAX_REPORT_AGE_S


def _locate_gps(line: dict[str, Any], t_frame_s: float | None) -> Point | None:
    """Return the position of the GPS receiver at the time of the frame: its newest position, extrapolated with the
    velocity. None if it is unknown or more than `_MAX_REPORT_AGE_S` away from the frame in time."""
    position, t_s = get_point(line, "vehicle", "gps"), get_number(line, "vehicle", "gps", "t_s")
    if position is None or t_s is None or t_frame_s is None or not _is_fresh(t_s, t_frame_s):
        return None
    match get_value(line, "vehicle", "velocity_m_s"):
        case [int() | float() as east_m_s, int() | float() as north_m_s]:
            return offset_position(*position, (t_frame_s - t_s) * east_m_s, (t_frame_s - t_s) * north_m_s)
    return position


def _read_text(line: dict[str, Any]) -> str:
    reasons = [str(reason) for key in _REASON_FIELDS if (reason := read_reason(line.get(key)))]
    text = next(iter([*reasons, *(value for key in _TEXT_FIELDS if (value := get_text(line, key)))]), None)
    match line:
        case {"from": dict() as old, "to": dict() as new}:  # a change by the governor
            changed = [f"{key} {old.get(key)} to {value}" for key, value in new.items() if old.get(key) != value]
            return f"{', '.join(changed)}: {text}"
    hidden = {"kind", "time", "t_mono_s"}
    return text or ", ".join(f"{key} {value}" for key, value in line.items() if key not in hidden)


def get_value(record: Any, *keys: str) -> Any:
    """Return the value at `keys` in the nested dictionaries of `record`; None if any key is missing."""
    for key in keys:
        record = record.get(key) if isinstance(record, dict) else None
    return record


def get_number(record: Any, *keys: str) -> float | None:
    """Return the number at `keys` (see `get_value`); None if it is missing or not a plausible number."""
    value = get_value(record, *keys)
    is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
    return float(value) if is_number and -_MAX_NUMBER < value < _MAX_NUMBER else None


def get_text(record: Any, *keys: str) -> str | None:
    """Return the text at `keys` (see `get_value`); None if it is missing, empty or not text."""
    value = get_value(record, *keys)
    return value if isinstance(value, str) and value else None


def get_point(record: Any, *keys: str) -> Point | None:
    """Return the position (lat_deg, lon_deg) of the object at `keys`; None if it is missing or out of range."""
    lat_deg, lon_deg = get_number(record, *keys, "lat_deg"), get_number(record, *keys, "lon_deg")
    if lat_deg is None or lon_deg is None or abs(lat_deg) > 90 or abs(lon_deg) > 180:
        return None
    return lat_deg, lon_deg
