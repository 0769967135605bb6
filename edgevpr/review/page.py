"""The report of a flight (`edgevpr report`): one HTML page that contains its pictures and needs no network."""

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from itertools import pairwise
from statistics import median
from typing import Any

from edgevpr.core.text import format_probability
from edgevpr.core.types import Place
from edgevpr.frames.level import Lens, Mount
from edgevpr.review import logged
from edgevpr.review.album import Album
from edgevpr.review.webpage import (
    UNKNOWN,
    Chart,
    Layer,
    Section,
    Series,
    Step,
    format_duration,
    format_number,
    make_layer,
    make_page,
    to_point,
)

_MAX_REMARKS = 200
_MAX_GPS_ERROR_M = 15.0  # smaller distances are within the receiver's error, and not dangerous
_FIX_COLOURS = {
    logged.FixOutcome.ACCEPTED: "taken",
    logged.FixOutcome.UNANSWERED: "unanswered",
    logged.FixOutcome.REFUSED: "refused",
    logged.FixOutcome.CONTINUOUS: "taken",
    logged.FixOutcome.NOT_SENT: "places",
}
_HEAD_FIELDS = (("map", "map"), ("technique", "technique"), ("board", "board"), ("edgevpr", "version"))


def make_flight_page(
    flight: logged.LoggedFlight, places: Sequence[Place], frames: Album, references: Album, no_places: str = ""
) -> str:
    """Return the page. `places`: the map's places. `frames`: album of the flight's pictures; `references`: album
    of the map's. `no_places`: a sentence on why `places` is empty."""
    queries = flight.queries
    time = logged.get_text(flight.start, "time") or next(
        (logged.get_text(query.line, "time") for query in queries), None
    )
    start = [f"{name} {value}" for name, key in _HEAD_FIELDS if (value := logged.get_text(flight.start, key))]
    head = {
        "title": f"Flight of {time[:16].replace('T', ' ')} UTC" if time else "Flight at an unknown time",
        "known": [f"{format_duration(flight.span_s)} long", *start, str(flight.path)],
        "figures": _compute_figures(flight),
        "warnings": _list_warnings(flight, bool(places), no_places),
        "span_s": flight.span_s,
    }
    steps = _make_steps(places, flight)
    return make_page(
        head,
        steps,
        places,
        _make_layers(places, flight, steps),
        {"seen": frames, "place": references},
        lens=_read_lens(flight.start),
        charts=_make_charts(flight),
        sections=[*_make_remarks(flight), *_make_settings(flight)],
    )


def _make_layers(places: Sequence[Place], flight: logged.LoggedFlight, steps: Sequence[Step]) -> list[Layer]:
    """Return the layers of the drawing, bottom layer first."""
    return [
        Layer("places of the map", "places", [[to_point(place.position) for place in places]]),
        make_layer(steps, "places found", "found"),
        Layer("fixes between matches", "between", [list(filter(None, map(logged.get_point, flight.between)))]),
        make_layer(steps, "GPS", "gps", "line"),
        make_layer(steps, "autopilot", "autopilot", "line"),
        make_layer(steps, "positions of refused queries", "refused_at"),
        make_layer(steps, "matches", "accepted"),
        make_layer(steps, "fixes accepted", "taken"),
        make_layer(steps, "fixes not answered", "unanswered"),
        make_layer(steps, "fixes refused", "refused"),
    ]


def _make_steps(places: Sequence[Place], flight: logged.LoggedFlight) -> list[Step]:
    """Return a step for each query of a flight over the map places `places`."""
    by_id = {place.place_id: place for place in places}
    has_link = any(query.has_link for query in flight.queries)
    return [_make_step(query, by_id.get(query.place or 0), flight.span_s > 0, has_link) for query in flight.queries]


def _make_step(query: logged.LoggedQuery, place: Place | None, has_times: bool, has_link: bool) -> Step:
    """Return the step of a query. `has_times`: the flight has times. `has_link`: it had a link to an autopilot."""
    fix, verdict = query.fix, "accepted" if query.accepted else "refused"
    points = {
        "found": query.place_position,
        "refused_at": None if query.accepted else query.true_position or query.autopilot_position,
        "gps": query.gps_position,
        "autopilot": query.autopilot_position,
    }
    refused = f"match refused: {query.reason.code.summary}" if query.reason else "match refused"
    groups = {"match accepted": "accepted"} if query.accepted else {refused: "refused"}
    outcome = f"{fix.outcome.value}{f': {fix.why}' if fix.why else ''}" if fix else ""
    if fix:
        summary = f": {fix.why.code.summary}" if fix.why else ""
        groups[f"{fix.outcome.value}{summary}"] = _FIX_COLOURS[fix.outcome]
        if fix.outcome in logged.SENT_OUTCOMES:
            points[_FIX_COLOURS[fix.outcome]] = fix.position
    if (query.off_m or 0.0) > _MAX_GPS_ERROR_M:
        groups[f"match over {_MAX_GPS_ERROR_M:.0f} m from GPS"] = "refused"
    if has_link and query.has_link is False:
        groups["autopilot silent"] = "refused"
    pictures = [("seen", query.name, f"query: {query.name}")]
    pictures.append(("place", query.reference_image or "", f"place found: {query.reference_image}"))
    return Step(
        title=f"{f'{format_duration(query.t_s)} – ' if has_times else ''}{query.name}: {verdict}",
        texts=[_format_place(query), _format_position(query), str(query.reason or ""), outcome],
        groups=groups,
        points={name: point for name, point in {**points, "accepted": query.position}.items() if point},  # circle last
        circle_m=query.accuracy_m if query.position else None,
        place=place,
        t_s=query.t_s,
        pictures=[picture for picture in pictures if picture[1]],
    )


def _format_place(query: logged.LoggedQuery) -> str:
    if query.place is None:
        return "no place found"
    score = format_number(logged.get_number(query.line, "score"))
    confidence = "" if query.confidence is None else f", confidence {format_probability(query.confidence)}"
    return f"place {query.place} ({query.reference_image or 'unnamed'}), score {score}{confidence}"


def _format_position(query: logged.LoggedQuery) -> str:
    if not query.position:
        return ""
    accuracy = "" if query.accuracy_m is None else f", accurate to {format_number(query.accuracy_m, 'm')}"
    distance = "" if query.off_m is None else f", {format_number(query.off_m, 'm')} from GPS"
    return f"position {query.position[0]:.6f}, {query.position[1]:.6f}{accuracy}{distance}"


def _read_lens(start: Mapping[str, Any]) -> Lens | None:
    """Return the lens of the flight's camera from the first line of its log; None if it is unknown."""
    names = ("fov_deg", "up_deg", "mount_ahead_deg", "mount_right_deg")
    fov_deg, up_deg, ahead_deg, right_deg = (logged.get_number(start, "config", "source", name) for name in names)
    if fov_deg is None or not 0 < fov_deg < 180:
        return None
    return Lens(fov_deg, up_deg or 0.0, mount=Mount(ahead_deg or 0.0, right_deg or 0.0))


def _compute_figures(flight: logged.LoggedFlight) -> dict[str, str]:
    """Return the figures of a flight by name."""
    queries, accepted = flight.queries, [query for query in flight.queries if query.accepted]
    percentage = f" ({len(accepted) / len(queries):.0%})" if queries else ""
    off_m = [query.off_m for query in accepted if query.off_m is not None]
    accuracies_m = [query.accuracy_m for query in accepted if query.accuracy_m is not None]
    outcomes = Counter(query.fix.outcome for query in queries if query.fix)
    between = f" and {len(flight.between)} between matches" if flight.between else ""
    match_times_s = [0.0, *(query.t_s for query in accepted), flight.span_s]
    return {
        "queries": str(len(queries)),
        "accepted": f"{len(accepted)}{percentage}",
        "accuracy, median": format_number(median(accuracies_m) if accuracies_m else None, "m"),
        "from GPS, median": format_number(median(off_m) if off_m else None, "m"),
        "from GPS, maximum": format_number(max(off_m, default=None), "m"),
        "unusable frames": str(flight.unusable) if flight.unusable else UNKNOWN,
        "longest time without a match": format_number(max(end - start for start, end in pairwise(match_times_s)), "s"),
        "fixes sent": f"{sum(outcomes[outcome] for outcome in logged.SENT_OUTCOMES)}{between}",
        "fixes accepted": str(outcomes[logged.FixOutcome.ACCEPTED]),
        "charge": format_number(_find_highest(flight, "totals", "used_mah"), "mAh"),
        "RAM, maximum": format_number(_find_highest(flight, "costs", "rss_mb"), "MB"),
        "temperature, maximum": format_number(_find_highest(flight, "board", "temperature_c"), "°C"),
    }


def _find_highest(flight: logged.LoggedFlight, *keys: str) -> float | None:
    values = (logged.get_number(query.line, *keys) for query in flight.queries)
    return max((value for value in values if value is not None), default=None)


def _list_warnings(flight: logged.LoggedFlight, has_map_places: bool, no_places: str) -> list[str]:
    queries = flight.queries
    has_places = has_map_places or any(query.place_position for query in queries)
    warnings = [
        (flight.start, "The log lacks the first line of this flight: its configuration is unknown."),
        (flight.end, "The log has no last line: it was cut off (power, full disk), or the flight is still running."),
        (queries, "This flight had no queries."),
        (not queries or has_places, "No place has a position, so there is no drawing and no fix was sent."),
        (
            not queries or any(query.has_link for query in queries),
            "The log has no autopilot position reports, so its track and the distance from GPS are unknown.",
        ),
        (not no_places, no_places),
    ]
    return [sentence for is_fine, sentence in warnings if not is_fine]


def _make_charts(flight: logged.LoggedFlight) -> list[Chart]:
    def make_line(name: str, colour: str, scale: float, *keys: str) -> Series:
        values = [(query.t_s, logged.get_number(query.line, *keys)) for query in flight.queries]
        return name, colour, "line", [(t_s, scale * value) for t_s, value in values if value is not None]

    def make_dots(name: str, colour: str, values: Sequence[float | None]) -> Series:
        pairs = zip(flight.queries, values, strict=True)
        return name, colour, "dots", [(query.t_s, value) for query, value in pairs if value is not None]

    queries = flight.queries
    return [
        Chart("Confidence", "", [
            make_dots("accepted", "accepted", [query.confidence if query.accepted else None for query in queries]),
            make_dots("refused", "refused", [None if query.accepted else query.confidence for query in queries]),
        ]),
        Chart("Position", "m", [
            make_dots("from GPS", "gps", [query.off_m for query in queries]),
            make_dots("accuracy, 1 sigma", "accepted", [query.accuracy_m for query in queries]),
        ]),
        Chart("Time per query", "ms", [
            make_line("encode", "gps", 1e3, "costs", "t_encode_s"),
            make_line("match", "accepted", 1e3, "costs", "t_match_s"),
            make_line("CPU", "taken", 1e3, "costs", "cpu_s"),
        ]),
        Chart("RAM", "MB", [make_line("", "accepted", 1, "costs", "rss_mb")]),
        Chart("Charge", "mAh", [make_line("", "accepted", 1, "totals", "used_mah")]),
        Chart("Temperature", "°C", [make_line("", "refused", 1, "board", "temperature_c")]),
        Chart("Age of the newest picture", "ms", [make_line("", "accepted", 1e3, "totals", "latency_s")]),
    ]  # fmt: skip


def _make_remarks(flight: logged.LoggedFlight) -> list[Section]:
    """Return the section of messages reported in flight; none if there were no messages."""
    rows = [(format_duration(t_s), kind, sentence) for t_s, kind, sentence in flight.remarks[:_MAX_REMARKS]]
    left_out = len(flight.remarks) - len(rows)
    lines = [f"{left_out} more lines are in the log."] if left_out else []
    return [Section("Messages", lines, [("time", "source", "message"), *rows])] if rows else []


def _make_settings(flight: logged.LoggedFlight) -> list[Section]:
    """Return the section with the configuration; none if the log has no configuration."""
    reason, config = logged.get_text(flight.start, "decided", "reason"), logged.get_value(flight.start, "config")
    if not isinstance(config, dict):
        return []
    return [Section("Configuration", [reason] if reason else [], folded=json.dumps(config, indent=1))]
