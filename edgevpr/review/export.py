"""The points of a flight for other programs, as GeoJSON (RFC 7946), CSV and KML 2.2."""

import csv
import json
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, TextIO
from xml.etree import ElementTree

from edgevpr.core.text import printable
from edgevpr.review.flight import Flight, Query
from edgevpr.review.values import Point

_KML = "http://www.opengis.net/kml/2.2"


@dataclass(frozen=True, slots=True)
class Feature:
    """A point: its kind ("match", "fix", "place", "learnt", "autopilot" or "gps"), where it is, and what is known of
    it."""

    kind: str
    at: Point
    properties: dict[str, Any]


def features_of(flight: Flight) -> list[Feature]:
    """Return the points of a flight: of every query the accepted match, the fix that was made of it, and where
    autopilot and receiver were; then the places that were found, each once, and those that were learnt."""
    features = [each for query in flight.queries for each in _of_query(query)]
    found = Counter(each.place for each in flight.queries if each.place_at)
    places = {each.place: each for each in flight.queries if each.place_at}
    for number, query in places.items():
        known = {"place": number, "reference_image": query.reference_image, "times_found": found[number]}
        features.append(Feature("place", query.place_at, known))
    return features + [Feature("learnt", at, {}) for at in flight.learnt]


def write_geojson(features: Sequence[Feature], out: TextIO) -> None:
    """Write a FeatureCollection, one feature a line."""
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
    """Write a table with a heading, one point a line; a property that a point lacks is empty."""
    names = list(dict.fromkeys(name for each in features for name in each.properties))
    table = csv.writer(out, lineterminator="\n")
    table.writerow(("kind", "lat_deg", "lon_deg", *names))
    for each in features:
        lat_deg, lon_deg = each.at
        table.writerow((each.kind, f"{lat_deg:.8f}", f"{lon_deg:.8f}", *(each.properties.get(name) for name in names)))


def write_kml(features: Sequence[Feature], out: TextIO) -> None:
    """Write a document with a folder for each kind of points."""
    root = ElementTree.Element("kml", xmlns=_KML)
    document = ElementTree.SubElement(root, "Document")
    for kind in dict.fromkeys(each.kind for each in features):
        folder = ElementTree.SubElement(document, "Folder")
        ElementTree.SubElement(folder, "name").text = kind
        for each in features:
            if each.kind != kind:
                continue
            mark = ElementTree.SubElement(folder, "Placemark")
            name = each.properties.get("query") or each.properties.get("place") or kind
            ElementTree.SubElement(mark, "name").text = printable(str(name))
            if when := each.properties.get("time"):
                ElementTree.SubElement(ElementTree.SubElement(mark, "TimeStamp"), "when").text = printable(when)
            extended = ElementTree.SubElement(mark, "ExtendedData")
            for key, known in each.properties.items():
                if known is not None:
                    data = ElementTree.SubElement(extended, "Data", name=key)
                    ElementTree.SubElement(data, "value").text = printable(str(known))
            lat_deg, lon_deg = each.at
            point = ElementTree.SubElement(mark, "Point")
            ElementTree.SubElement(point, "coordinates").text = f"{lon_deg:.8f},{lat_deg:.8f}"
    ElementTree.indent(root, " ")
    out.write('<?xml version="1.0" encoding="UTF-8"?>\n' + ElementTree.tostring(root, encoding="unicode") + "\n")


WRITERS: dict[str, Callable[[Sequence[Feature], TextIO], None]] = {
    "geojson": write_geojson,
    "csv": write_csv,
    "kml": write_kml,
}


def _of_query(query: Query) -> list[Feature]:
    named = {"time": query.time, "t_s": round(query.t_s, 3), "query": query.name}
    features = []
    if query.at:
        known = {
            "place": query.place,
            "reference_image": query.reference_image,
            "score": query.score,
            "confidence": query.confidence,
            "accuracy_m": query.accuracy_m,
            "from_gps_m": None if query.off_m is None else round(query.off_m, 2),
        }
        features.append(Feature("match", query.at, named | known))
    if query.fix and query.fix.at:
        fix = query.fix
        known = {
            "outcome": fix.outcome.value,
            "why": fix.why,
            "accuracy_m": fix.accuracy_m,
            "latency_ms": fix.latency_ms,
        }
        features.append(Feature("fix", fix.at, named | known))
    if query.autopilot_at:
        features.append(Feature("autopilot", query.autopilot_at, dict(named)))
    if query.gps_at:
        features.append(Feature("gps", query.gps_at, dict(named)))
    return features
