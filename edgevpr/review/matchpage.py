"""The page of `edgevpr match`: the queries and what was found, over the ground of the map; and what another precision
would ask for, computed by the models that judged the matches."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, replace
from itertools import chain
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Any

from edgevpr.core.types import Place
from edgevpr.review.album import Album
from edgevpr.review.html import figure, figures, heading, section
from edgevpr.review.logged import LoggedFlight, read_lines
from edgevpr.review.queries import few, layers_of, steps_of
from edgevpr.review.steps import Explored, Thresholds, counts, stepped
from edgevpr.runtime.recognise.confidence import model_of
from edgevpr.runtime.recognise.judge import Sureness
from edgevpr.runtime.recognise.recognition import Recognition, fields_of

if TYPE_CHECKING:
    from edgevpr.frames.level import Lens

_PRECISIONS = (0.9, 0.95, 0.98, 0.99, 0.995, 0.998, 0.999, 0.9995, 0.9998, 0.9999, 0.99999, 0.999999)


def line_of(event: Recognition, number: int) -> dict[str, Any]:
    """Return the event of a query as a line of a flight log, for `read_lines`. Queries are a second apart: `number` is
    its second. The GPS tag of its picture stands for a GPS receiver."""
    tag = event.frame and event.frame.position
    gps = {"lat_deg": tag.lat_deg, "lon_deg": tag.lon_deg, "t_s": float(number)} if tag else None
    times = {"kind": "query", "t_mono_s": float(number), "t_frame_s": float(number)}
    return fields_of(event, exact=True) | times | {"vehicle": {"gps": gps}}


def match_page_of(
    lines: Iterable[Mapping[str, Any]],
    ground: Sequence[Place],
    albums: Mapping[str, Album],
    name: str,
    sure: Sureness | None,
    lens: "Lens | None" = None,
) -> str:
    """Return the whole page. `lines` are those of the queries (see `line_of`), `albums` have the pictures of queries
    ("seen") and of the map ("place"), `name` is that of the map, `lens` that of the camera. `sure` judged the matches
    (None: they were judged by fixed limits)."""
    flight = read_lines(map(dict, lines), Path())
    flight.truth = "GPS tags"
    queries = flight.queries
    refused = (few(query.reason) for query in queries if not query.accepted)
    above = [heading(f"Matches in {name}", [f"{len(queries)} pictures"]), section("", _figures(flight))]
    explored = Explored(
        unit="query",
        ground=ground,
        layers=layers_of(ground, flight),
        steps=[
            replace(step, title=step.title.partition(" – ")[2], t_s=None, lanes=()) for step in steps_of(ground, flight)
        ],
        albums=albums,
        lens=lens,
        span_s=flight.span_s,
        thresholds=thresholds_of(asdict(sure)) if sure else None,
    )
    return stepped(f"Matches in {name}", above, explored, [section("Why matches were refused", counts(refused))])


def _figures(flight: LoggedFlight) -> str:
    queries, truth = flight.queries, flight.truth
    placed = [query for query in queries if query.at]
    off_m = [query.off_m for query in queries if query.off_m is not None]
    accuracies_m = [query.accuracy_m for query in placed if query.accuracy_m is not None]
    known = {
        "queries": str(len(queries)),
        "accepted": f"{sum(query.accepted for query in queries)}",
        "accuracy, median": figure(median(accuracies_m) if accuracies_m else None, "m"),
        f"from {truth}, median": figure(median(off_m) if off_m else None, "m"),
        f"from {truth}, most": figure(max(off_m, default=None), "m"),
    }
    return figures(known)


def thresholds_of(sure: Mapping[str, Any] | None) -> Thresholds | None:
    """Return the confidences that matches need at several precisions, and at their own. `sure` has the fields of a
    `Sureness`, as the first line of a flight log has it (`decided.rule.sure`). None if it is missing, damaged, or of
    another version."""
    try:
        asked = float(sure["precision"])  # type: ignore[index]  # None raises TypeError
        models = {kind: model_of(model) for kind, model in sure["models"].items()}  # type: ignore[index]
        precisions = sorted({*_PRECISIONS, asked})
        needed = {kind: [Sureness(models, each).needed(kind) for each in precisions] for kind in models}
        if not 0 < asked < 1 or not all(map(math.isfinite, chain(*needed.values()))):
            return None
    except (KeyError, TypeError, ValueError, AttributeError, ArithmeticError):
        return None
    return Thresholds(precisions, precisions.index(asked), needed)
