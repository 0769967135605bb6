"""Writes the points of a flight for other programs, as GeoJSON (RFC 7946), CSV or KML 2.2: `edgevpr export`."""

import csv
import json
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, TextIO
from xml.etree import ElementTree

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
    out.write('{"type": "FeatureCollection", "features": [')
    for count, each in enumerate(features):
        lat_deg, lon_deg = each.at
        feature = {
            "type": "Feature",
            "geometry": {"type": "Point", "coordinates": [round(lon_deg, 8), round(lat_deg, 8)]},
            "properties": {"kind": each.kind, **each.properties},
        }
        out.write((",\n" if count else "\n") + json.dumps(feature))
    out.write("\n]}\n")


def write_csv(features: Sequence[Feature], out: TextIO) -> None:
    """Write a CSV table with a heading, one point a line; the cell of a property that a point lacks is empty."""
    names = list(dict.fromkeys(name for each in features for name in each.properties))
    table = csv.writer(out, lineterminator="\n")
    table.writerow(("kind", "lat_deg", "lon_deg", *names))
    for each in features:
        lat_deg, lon_deg = each.at
        table.writerow((each.kind, f"{lat_deg:.8f}", f"{lon_deg:.8f}", *(each.properties.get(name) for name in names)))


def write_kml(features: Sequence[Feature], out: TextIO) -> None:
    """Write a KML document with a folder for each kind of point."""
    root = ElementTree.Element("kml", xmlns=_KML)
    document = ElementTree.SubElement(root, "Document")
    for kind in dict.fromkeys(each.kind for each in features):
        folder = ElementTree.SubElement(document, "Folder")
        _child(folder, "name", kind)
        for each in features:
            if each.kind == kind:
                _add_placemark(folder, each)
    ElementTree.indent(root, " ")
    out.write('<?xml version="1.0" encoding="UTF-8"?>\n' + ElementTree.tostring(root, encoding="unicode") + "\n")


def _add_placemark(folder: ElementTree.Element, feature: Feature) -> None:
    mark = ElementTree.SubElement(folder, "Placemark")
    properties, (lat_deg, lon_deg) = feature.properties, feature.at
    _child(mark, "name", properties.get("query") or properties.get("place") or feature.kind)
    if when := properties.get("time"):
        _child(ElementTree.SubElement(mark, "TimeStamp"), "when", when)
    extended = ElementTree.SubElement(mark, "ExtendedData")
    for key, known in properties.items():
        if known is not None:
            _child(ElementTree.SubElement(extended, "Data", name=key), "value", known)
    _child(ElementTree.SubElement(mark, "Point"), "coordinates", f"{lon_deg:.8f},{lat_deg:.8f}")


def _child(parent: ElementTree.Element, tag: str, text: object) -> None:
    ElementTree.SubElement(parent, tag).text = printable(str(text))


WRITERS: dict[str, Callable[[Sequence[Feature], TextIO], None]] = {
    "geojson": write_geojson,
    "csv": write_csv,
    "kml": write_kml,
}
