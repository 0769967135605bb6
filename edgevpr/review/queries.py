"""The queries of a flight, or of `match`, as steps and layers over the ground, and as lanes over time."""

import re
from collections.abc import Sequence

from edgevpr.core.text import nines
from edgevpr.core.types import Place
from edgevpr.review.html import clock, figure
from edgevpr.review.logged import FixOutcome, LoggedFlight, LoggedQuery, number, point, without_numbers
from edgevpr.review.overhead import Layer, at_of
from edgevpr.review.steps import Step, layer_of

FAR_M = 15.0  # from GPS: less is the error of a receiver, and no danger
_UNUSABLE = "frame not usable"
_SILENT = "autopilot silent"
_LANES = {
    "match accepted": "accepted",
    "match refused": "refused",
    _UNUSABLE: "unusable",
    FixOutcome.TAKEN.value: "taken",
    FixOutcome.REFUSED.value: "refused",
    FixOutcome.UNANSWERED.value: "unanswered",
    FixOutcome.CONTINUOUS.value: "taken",
    FixOutcome.KEPT.value: "places",
    _SILENT: "refused",
}
_FIX_LAYERS = {
    FixOutcome.TAKEN: ("fixes taken", "taken"),
    FixOutcome.UNANSWERED: ("fixes not answered", "unanswered"),
    FixOutcome.REFUSED: ("fixes refused", "refused"),
}

Lane = tuple[str, str, Sequence[float]]  # name, colour, times


def list_lanes(flight: LoggedFlight) -> list[Lane]:
    """Return a lane for everything that became of a query, or of a frame that never was one, if it happened."""
    times_s: dict[str, list[float]] = {name: [] for name in _LANES}
    times_s[_UNUSABLE] += flight.unusable
    for query in flight.queries:
        for name in _lanes_of(query):
            times_s[name].append(query.t_s)
    if not any(query.has_link for query in flight.queries):
        del times_s[_SILENT]  # there was none
    return [(name, _LANES[name], several_s) for name, several_s in times_s.items() if several_s]


def _lanes_of(query: LoggedQuery) -> list[str]:
    names = ["match accepted" if query.accepted else "match refused"]
    if query.fix:
        names.append(query.fix.outcome.value)
    if query.has_link is False:
        names.append(_SILENT)
    return names


def list_layers(ground: Sequence[Place], flight: LoggedFlight, steps: Sequence[Step]) -> list[Layer]:
    """Return the layers of the drawing, from the bottom to the top."""
    return [
        Layer("places of the map", "places", [[at_of(place) for place in ground]]),
        layer_of(steps, "places found", "found"),
        Layer("places learnt", "learnt", [flight.learnt]),
        Layer("fixes between matches", "between", [list(filter(None, map(point, flight.between)))]),
        layer_of(steps, flight.truth, "gps", "line"),
        layer_of(steps, "autopilot", "autopilot", "line"),
        layer_of(steps, "refused there", "missed"),
        layer_of(steps, "matches", "accepted"),
        *(layer_of(steps, name, colour) for name, colour in _FIX_LAYERS.values()),
    ]


def list_steps(ground: Sequence[Place], flight: LoggedFlight, lanes: Sequence[Lane]) -> list[Step]:
    """Return a step for each query of a flight over the places of `ground`. Without `lanes` the steps have no time."""
    places = {place.place_id: place for place in ground}
    numbers = {name: row for row, (name, *_) in enumerate(lanes)}
    return [
        _step(
            query,
            places.get(query.place or 0),
            [numbers[name] for name in _lanes_of(query) if name in numbers],
            flight.truth,
        )
        for query in flight.queries
    ]


def _step(query: LoggedQuery, place: Place | None, lanes: Sequence[int], truth: str) -> Step:
    fix, verdict = query.fix, "accepted" if query.accepted else "refused"
    points = {
        "found": query.place_at,
        "missed": None if query.accepted else query.true_at or query.autopilot_at,
        "gps": query.gps_at,
        "autopilot": query.autopilot_at,
    }
    if fix and fix.outcome in _FIX_LAYERS:
        points[_FIX_LAYERS[fix.outcome][1]] = fix.at
    points["accepted"] = query.at  # the last: its circle is drawn
    fixed = f"{fix.outcome.value}{f': {fix.why}' if fix.why else ''}" if fix else ""
    groups = [verdict if query.accepted else f"refused: {_brief(query.reason)}", without_numbers(fixed)]
    if (query.off_m or 0.0) > FAR_M:
        groups.append(f"match over {FAR_M:.0f} m from {truth}")
    pictures = [("seen", query.name, f"seen: {query.name}")]
    pictures.append(("place", query.reference_image or "", f"place found: {query.reference_image}"))
    return Step(
        title=f"{f'{clock(query.t_s)} – ' if lanes else ''}{query.name}: {verdict}",
        said=[_place_found(query), _position(query, truth), query.reason, fixed],
        groups=[group for group in groups if group],
        at={name: at for name, at in points.items() if at},
        circle_m=query.accuracy_m if query.at else None,
        place=place,
        t_s=query.t_s if lanes else None,
        lanes=lanes,
        pictures=[picture for picture in pictures if picture[1]],
    )


def _place_found(query: LoggedQuery) -> str:
    if query.place is None:
        return "no place was found"
    score = figure(number(query.line, "score"))
    confidence = "" if query.confidence is None else f", confidence {nines(query.confidence)}"
    return f"place {query.place} ({query.reference_image or 'without a name'}), score {score}{confidence}"


def _position(query: LoggedQuery, truth: str) -> str:
    if not query.at:
        return ""
    accuracy = "" if query.accuracy_m is None else f", accurate to {figure(query.accuracy_m, 'm')}"
    off = "" if query.off_m is None else f", {figure(query.off_m, 'm')} from {truth}"
    return f"position {query.at[0]:.6f}, {query.at[1]:.6f}{accuracy}{off}"


def _brief(reason: str) -> str:
    """Return the first words of a reason, without its numbers, so that reasons can be counted."""
    return without_numbers(re.split(r"[:;,] ", reason)[0])
