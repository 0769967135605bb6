"""Writes the points of a flight for other programs, as GeoJSON (RFC 7946), CSV or KML 2.2: `edgevpr export`."""

import csv
import json
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, TextIO
from xml.sax.saxutils import escape

from edgevpr.core.text import printable
from edgevpr.review.logged import LoggedFlight, LoggedQuery, Point

_KML = "http://www.opengis.net/kml/2.2"
_OF_MATCH = ("place", "reference_image", "score", "confidence", "accuracy_m")
_OF_FIX = ("why", "accuracy_m", "latency_ms")


@dataclass(frozen=True, slots=True)
class Feature:
    """A point to export: its kind ("match", "fix", "place", "learnt", "autopilot" or "gps"), its position `at`, and its
    properties by name."""

    kind: str
    at: Point
    properties: dict[str, Any]


def features_of(flight: LoggedFlight) -> list[Feature]:
    """Return the points of a flight: for every query the accepted match, the fix made from it, and the positions by
    autopilot and GPS receiver; then the places that were found, each once, and those learnt in flight."""
    features = [feature for query in flight.queries for feature in _of_query(query)]
    at_place = [(query.place, query.place_at, query.reference_image) for query in flight.queries if query.place_at]
    times_found = Counter(number for number, _, _ in at_place)
    for number, (at, image) in {number: (at, image) for number, at, image in at_place}.items():
        known = {"place": number, "reference_image": image, "times_found": times_found[number]}
        features.append(Feature("place", at, known))
    return features + [Feature("learnt", at, {}) for at in flight.learnt]


def _of_query(query: LoggedQuery) -> Iterator[Feature]:
    named = {"time": query.time, "t_s": round(query.t_s, 3), "query": query.name}
    if query.at:
        match = {name: getattr(query, name) for name in _OF_MATCH}
        from_gps_m = None if query.off_m is None else round(query.off_m, 2)
        yield Feature("match", query.at, {**named, **match, "from_gps_m": from_gps_m})
    if query.fix and query.fix.at:
        fix = {"outcome": query.fix.outcome.value} | {name: getattr(query.fix, name) for name in _OF_FIX}
        yield Feature("fix", query.fix.at, named | fix)
    if query.autopilot_at:
        yield Feature("autopilot", query.autopilot_at, named)
    if query.gps_at:
        yield Feature("gps", query.gps_at, named)


def write_geojson(features: Sequence[Feature], out: TextIO) -> None:
    """Write a GeoJSON FeatureCollection, one feature a line."""
    lines = [
        json.dumps(
            {
                "type": "Feature",
                "geometry": {"type": "Point", "coordinates": [round(degrees, 8) for degrees in reversed(each.at)]},
                "properties": {"kind": each.kind, **each.properties},
            }
        )
        for each in features
    ]
    out.write('{"type": "FeatureCollection", "features": [\n' + ",\n".join(lines) + "\n]}\n")


def write_csv(features: Sequence[Feature], out: TextIO) -> None:
    """Write a CSV table with a heading, one point a line; the cell of a property that a point lacks is empty."""
    names = dict.fromkeys(name for each in features for name in each.properties)
    table = csv.DictWriter(out, ("kind", "lat_deg", "lon_deg", *names), lineterminator="\n")
    table.writeheader()
    for each in features:
        lat_deg, lon_deg = (f"{degrees:.8f}" for degrees in each.at)
        table.writerow({"kind": each.kind, "lat_deg": lat_deg, "lon_deg": lon_deg, **each.properties})


def write_kml(features: Sequence[Feature], out: TextIO) -> None:
    """Write a KML document with a folder for each kind of point."""
    out.write(f'<?xml version="1.0" encoding="UTF-8"?>\n<kml xmlns="{_KML}"><Document>\n')
    for kind in dict.fromkeys(each.kind for each in features):
        marks = "".join(_placemark(each) for each in features if each.kind == kind)
        out.write(f"<Folder>{_tag('name', kind)}\n{marks}</Folder>\n")
    out.write("</Document></kml>\n")


def _placemark(feature: Feature) -> str:
    properties, (lat_deg, lon_deg) = feature.properties, feature.at
    known = {name: value for name, value in properties.items() if value is not None}
    data = "".join(f'<Data name="{name}">{_tag("value", value)}</Data>' for name, value in known.items())
    time = f"<TimeStamp>{_tag('when', properties['time'])}</TimeStamp>" if properties.get("time") else ""
    name = _tag("name", properties.get("query") or properties.get("place") or feature.kind)
    point = _tag("coordinates", f"{lon_deg:.8f},{lat_deg:.8f}")
    return f"<Placemark>{name}{time}<ExtendedData>{data}</ExtendedData><Point>{point}</Point></Placemark>\n"


def _tag(tag: str, text: object) -> str:
    return f"<{tag}>{escape(printable(str(text)))}</{tag}>"


WRITERS: dict[str, Callable[[Sequence[Feature], TextIO], None]] = {
    "geojson": write_geojson,
    "csv": write_csv,
    "kml": write_kml,
}
