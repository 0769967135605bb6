"""Writes the points of a flight for other programs, as GeoJSON (RFC 7946), CSV or KML 2.2: `edgevpr export`."""

import csv
import json
from collections import Counter
from collections.abc import Iterator, Sequence
from typing import Any, TextIO
from xml.sax.saxutils import escape

from edgevpr.core.text import printable
from edgevpr.review.logged import LoggedFlight, LoggedQuery, Point

# A point to export: its `kind` ("match", "fix", "place", "learnt", "autopilot" or "gps"), position and properties.
Feature = dict[str, Any]

_KML = "http://www.opengis.net/kml/2.2"
_OF_MATCH = ("place", "reference_image", "score", "confidence", "accuracy_m")
_OF_FIX = ("why", "accuracy_m", "latency_ms")
_PLACED = ("kind", "lat_deg", "lon_deg")  # what every feature has; the others are its properties


def features_of(flight: LoggedFlight) -> list[Feature]:
    """Return the points of a flight: for every query the accepted match, the fix made from it, and the positions by
    autopilot and GPS receiver; then the places that were found, each once, and those learnt in flight."""
    features = [feature for query in flight.queries for feature in _of_query(query)]
    at_place = {query.place: query for query in flight.queries if query.place_at}
    times_found = Counter(query.place for query in flight.queries if query.place_at)
    for number, query in at_place.items():
        known = {"place": number, "reference_image": query.reference_image, "times_found": times_found[number]}
        features.append(_feature("place", query.place_at, known))
    return features + [_feature("learnt", at, {}) for at in flight.learnt]


def _of_query(query: LoggedQuery) -> Iterator[Feature]:
    named = {"time": query.time, "t_s": round(query.t_s, 3), "query": query.name}
    if query.at:
        match = {name: getattr(query, name) for name in _OF_MATCH}
        from_gps_m = None if query.off_m is None else round(query.off_m, 2)
        yield _feature("match", query.at, {**named, **match, "from_gps_m": from_gps_m})
    if query.fix and query.fix.at:
        fix = {"outcome": query.fix.outcome.value} | {name: getattr(query.fix, name) for name in _OF_FIX}
        yield _feature("fix", query.fix.at, named | fix)
    if query.autopilot_at:
        yield _feature("autopilot", query.autopilot_at, named)
    if query.gps_at:
        yield _feature("gps", query.gps_at, named)


def _feature(kind: str, at: Point | None, properties: dict[str, Any]) -> Feature:
    return dict(zip(_PLACED, (kind, *(at or ())), strict=True)) | properties


def write_geojson(features: Sequence[Feature], out: TextIO) -> None:
    """Write a GeoJSON FeatureCollection, one feature a line."""
    lines = []
    for each in features:
        point = {"type": "Point", "coordinates": [round(each["lon_deg"], 8), round(each["lat_deg"], 8)]}
        properties = {name: value for name, value in each.items() if name not in ("lat_deg", "lon_deg")}
        lines.append(json.dumps({"type": "Feature", "geometry": point, "properties": properties}))
    out.write('{"type": "FeatureCollection", "features": [\n' + ",\n".join(lines) + "\n]}\n")


def write_csv(features: Sequence[Feature], out: TextIO) -> None:
    """Write a CSV table with a heading, one point a line; the cell of a property that a point lacks is empty."""
    names = dict.fromkeys([*_PLACED, *(name for each in features for name in each)])
    table = csv.DictWriter(out, names, lineterminator="\n")
    table.writeheader()
    table.writerows({**each, **{name: f"{each[name]:.8f}" for name in _PLACED[1:]}} for each in features)


def write_kml(features: Sequence[Feature], out: TextIO) -> None:
    """Write a KML document with a folder for each kind of point."""
    out.write(f'<?xml version="1.0" encoding="UTF-8"?>\n<kml xmlns="{_KML}"><Document>\n')
    for kind in dict.fromkeys(each["kind"] for each in features):
        marks = "".join(_placemark(each) for each in features if each["kind"] == kind)
        out.write(f"<Folder>{_tag('name', kind)}\n{marks}</Folder>\n")
    out.write("</Document></kml>\n")


def _placemark(feature: Feature) -> str:
    known = {name: value for name, value in feature.items() if name not in _PLACED and value is not None}
    data = "".join(f'<Data name="{name}">{_tag("value", value)}</Data>' for name, value in known.items())
    time = f"<TimeStamp>{_tag('when', known['time'])}</TimeStamp>" if known.get("time") else ""
    name = _tag("name", known.get("query") or known.get("place") or feature["kind"])
    point = _tag("coordinates", f"{feature['lon_deg']:.8f},{feature['lat_deg']:.8f}")
    return f"<Placemark>{name}{time}<ExtendedData>{data}</ExtendedData><Point>{point}</Point></Placemark>\n"


def _tag(tag: str, text: object) -> str:
    return f"<{tag}>{escape(printable(str(text)))}</{tag}>"


WRITERS = {"geojson": write_geojson, "csv": write_csv, "kml": write_kml}
