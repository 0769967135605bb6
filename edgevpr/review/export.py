"""Writes the points of a flight for other programs, as GeoJSON (RFC 7946): `edgevpr export`."""

import json
from collections.abc import Sequence
from typing import Any, TextIO

from edgevpr.review.logged import LoggedFlight, LoggedQuery, Point, number, point, text

# A point to export: its `kind` ("match", "fix", "between", "autopilot" or "gps"), position and properties.
Feature = dict[str, Any]


def make_features(flight: LoggedFlight) -> list[Feature]:
    """Return the points of a flight: for every query the accepted match, the fix made from it, and the positions by
    autopilot and GPS receiver; and the fixes sent between matches."""
    features = [feature for query in flight.queries for feature in _of_query(query)]
    for line in flight.between:
        known = {"time": text(line, "time") or "", "accuracy_m": number(line, "accuracy_m")}
        features += _feature("between", point(line), known)
    return features


def _of_query(query: LoggedQuery) -> list[Feature]:
    named = {"time": text(query.line, "time") or "", "t_s": round(query.t_s, 3), "query": query.name}
    match = {
        "place": query.place,
        "reference_image": query.reference_image,
        "score": number(query.line, "score"),
        "confidence": query.confidence,
        "accuracy_m": query.accuracy_m,
        "from_gps_m": None if query.off_m is None else round(query.off_m, 2),
    }
    features = _feature("match", query.at, named | match)
    if fix := query.fix:
        outcome = {"outcome": fix.outcome.value, "why": fix.why and fix.why.code.name, "accuracy_m": fix.accuracy_m}
        features += _feature("fix", fix.at, named | outcome)
    return [*features, *_feature("autopilot", query.autopilot_at, named), *_feature("gps", query.gps_at, named)]


def _feature(kind: str, at: Point | None, properties: dict[str, Any]) -> list[Feature]:
    """Return the feature of a position; nothing if it is unknown."""
    return [{"kind": kind, "lat_deg": at[0], "lon_deg": at[1]} | properties] if at else []


def write_geojson(features: Sequence[Feature], out: TextIO) -> None:
    """Write a GeoJSON FeatureCollection, one feature a line."""
    lines = []
    for each in features:
        point = {"type": "Point", "coordinates": [round(each["lon_deg"], 8), round(each["lat_deg"], 8)]}
        properties = {name: value for name, value in each.items() if name not in ("lat_deg", "lon_deg")}
        lines.append(json.dumps({"type": "Feature", "geometry": point, "properties": properties}))
    out.write('{"type": "FeatureCollection", "features": [\n' + ",\n".join(lines) + "\n]}\n")
