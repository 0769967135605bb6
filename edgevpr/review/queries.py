"""The queries of a flight, or of `match`, as steps and layers over the ground, and as lanes over time."""

import re
from collections.abc import Iterable, Mapping, Sequence
from itertools import groupby
from typing import Any

from edgevpr.core.geodesy import distance_m
from edgevpr.core.text import nines
from edgevpr.core.types import Place
from edgevpr.review.html import clock, figure
from edgevpr.review.logged import FixOutcome, LoggedFlight, LoggedQuery, Point, number, point, value
from edgevpr.review.overhead import Layer, at_of
from edgevpr.review.steps import NUMBER, ByConfidence, Step

# So the judge begins its reasons where the confidence alone decided.
_BY_CONFIDENCE = re.compile(r"(?:([01]\.\d+) sure by the flight so far; )?confidence ([01]\.\d+), [01]\.\d+ needed: ")
_FIXES = (
    (FixOutcome.TAKEN, "fixes taken", "taken"),
    (FixOutcome.UNANSWERED, "fixes not answered", "unanswered"),
    (FixOutcome.REFUSED, "fixes refused", "refused"),
)
_LANES = {
    "match accepted": "accepted",
    "match refused": "refused",
    "frame not usable": "unusable",
    FixOutcome.TAKEN.value: "taken",
    FixOutcome.REFUSED.value: "refused",
    FixOutcome.UNANSWERED.value: "unanswered",
    FixOutcome.CONTINUOUS.value: "taken",
    FixOutcome.KEPT.value: "places",
    "autopilot silent": "refused",
}

Lane = tuple[str, str, Sequence[float]]  # name, colour, times


def lanes_of(flight: LoggedFlight) -> list[Lane]:
    """Return a lane for everything that became of a query, or of a frame that never was one, if it happened."""
    times: dict[str, list[float]] = {name: [] for name in _LANES}
    times["frame not usable"] += flight.unusable
    for query, names in zip(flight.queries, _became(flight), strict=True):
        for name in names:
            times[name].append(query.t_s)
    return [(name, _LANES[name], times_s) for name, times_s in times.items() if times_s]


def _became(flight: LoggedFlight) -> list[list[str]]:
    """Return the names of the lanes of each query."""
    is_heard = any(query.has_link for query in flight.queries)
    return [
        [
            "match accepted" if query.accepted else "match refused",
            *([query.fix.outcome.value] if query.fix else []),
            *(["autopilot silent"] if is_heard and query.has_link is False else []),
        ]
        for query in flight.queries
    ]


def layers_of(ground: Sequence[Place], flight: LoggedFlight) -> list[Layer]:
    """Return the layers of the drawing, from the bottom to the top. Those without points are left out."""
    queries = flight.queries
    layers = [
        Layer("places of the map", "places", [[at_of(place) for place in ground]]),
        Layer("places found", "found", [list(dict.fromkeys(query.place_at for query in queries if query.place_at))]),
        Layer("places learnt", "learnt", [flight.learnt]),
        Layer("fixes between matches", "between", [list(filter(None, map(point, flight.between)))]),
        Layer(flight.truth, "gps", _known_ways(query.gps_at for query in queries), "line"),
        Layer("autopilot", "autopilot", _known_ways(query.autopilot_at for query in queries), "line"),
        Layer("refused there", "missed", [[at for query in queries if (at := _missed_at(query))]]),
        Layer("matches", "accepted", [[query.at for query in queries if query.at]]),
    ]
    for outcome, name, colour in _FIXES:
        fixes = (query.fix for query in queries if query.fix and query.fix.outcome is outcome)
        layers.append(Layer(name, colour, [[fix.at for fix in fixes if fix.at]]))
    return [layer for layer in layers if any(layer.ways)]


def _known_ways(points: Iterable[Point | None]) -> list[list[Point]]:
    """Return the runs of successive known points: None, an unknown point, ends a run."""
    return [[point for point in several if point] for are_known, several in groupby(points, bool) if are_known]


def _missed_at(query: LoggedQuery) -> Point | None:
    """Return where the aircraft was when a query was refused; None if it was accepted, or that is unknown."""
    return None if query.accepted else query.true_at or query.autopilot_at


def steps_of(ground: Sequence[Place], flight: LoggedFlight) -> list[Step]:
    """Return a step for each query of a flight over the places of `ground`."""
    places = {place.place_id: place for place in ground}
    lane_of = {name: at for at, (name, *_) in enumerate(lanes_of(flight))}
    return [
        _step(query, places.get(query.place or 0), [lane_of[name] for name in names], flight.truth)
        for query, names in zip(flight.queries, _became(flight), strict=True)
    ]


def _step(query: LoggedQuery, place: Place | None, lanes: Sequence[int], truth: str) -> Step:
    fix = query.fix
    known = {
        "found": query.place_at,
        "missed": _missed_at(query),
        "gps": query.gps_at,
        "autopilot": query.autopilot_at,
        **{colour: fix.at for outcome, _, colour in _FIXES if fix and fix.outcome is outcome},
        "accepted": query.at,
    }
    verdict = "accepted" if query.accepted else f"refused: {few(query.reason)}"
    fixed = fix and f"{fix.outcome.value}{f': {fix.why}' if fix.why else ''}"
    pictures = [("seen", query.name, f"seen: {query.name}")]
    if image := query.reference_image:
        pictures.append(("place", image, f"place found: {image}"))
    return Step(
        title=f"{clock(query.t_s)} – {query.name}: {'accepted' if query.accepted else 'refused'}",
        said=[found(query), _where(query, truth), query.reason, fixed or ""],
        groups=[verdict, *([NUMBER.sub("…", fixed)] if fixed else [])],
        at={name: at for name, at in known.items() if at},
        circle_m=query.accuracy_m if query.at else None,
        place=place,
        t_s=query.t_s,
        lanes=lanes,
        pictures=[each for each in pictures if each[1]],
        judged=_judged(query),
    )


def found(query: LoggedQuery) -> str:
    """Say which place was found, and how sure that is."""
    if query.place is None:
        return "no place was found"
    score = figure(number(query.line, "score"))
    sure = "" if query.confidence is None else f", confidence {nines(query.confidence)}"
    return f"place {query.place} ({query.reference_image or 'without a name'}), score {score}{sure}"


def _where(query: LoggedQuery, truth: str) -> str:
    good = "" if query.accuracy_m is None else f", good to {figure(query.accuracy_m, 'm')}"
    off = "" if query.off_m is None else f", {figure(query.off_m, 'm')} from {truth}"
    return f"position {query.at[0]:.6f}, {query.at[1]:.6f}{good}{off}" if query.at else ""


def few(reason: str) -> str:
    """Return a reason in a few words, without its figures."""
    return "not sure enough" if _BY_CONFIDENCE.match(reason) else NUMBER.sub("…", re.split(r"[:;,] ", reason)[0])


def _kind_of(evidence: Mapping[str, Any]) -> str:
    """Return the kind of evidence, as the models are named, by the figures that the log has."""
    if "likeness" in evidence:
        return "ahead_proven" if evidence.get("proof") else "ahead"
    return "down" if "landmarks" in evidence else "down_bare"


def _judged(query: LoggedQuery) -> ByConfidence | None:
    """Return how the confidence of a query was judged; None if something else decided, or the log does not say."""
    said, evidence = _BY_CONFIDENCE.match(query.reason), value(query.line, "evidence")
    if not said or not isinstance(evidence, dict):
        return None
    at = query.at or query.place_at
    return ByConfidence(
        confidence=float(said[2]),
        kind=_kind_of(evidence),
        followed=None if said[1] is None else float(said[1]),
        accepted=query.accepted,
        off_m=float(distance_m(*query.true_at, *at)) if query.true_at and at else None,
    )
