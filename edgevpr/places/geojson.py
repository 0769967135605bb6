"""Export of a map as GeoJSON (RFC 7946), the places without their descriptors, for any map viewer."""

import json
from collections.abc import Mapping
from typing import Any, TextIO

from edgevpr.core.types import Place
from edgevpr.places import geopackage
from edgevpr.places.mapfile import PlaceMap

_LOW, _USUAL = "#e0b060", "#2060c0"
# From hardly to surely recognisable, in five equal steps. Colour-blind people can tell red from blue too.
_RECOGNISABLE = ("#d73027", "#fc8d59", "#fee090", "#91bfdb", "#4575b4")


def write_geojson(place_map: PlaceMap, out: TextIO, recognisable: Mapping[int, float] | None = None) -> int:
    """Write all places to `out` as one FeatureCollection, one feature per line; return their number. `recognisable`
    maps place ids to the confidence with which a place is recognised, 0..1; where known, it sets the place's colour."""
    recognisable = recognisable or {}
    count = 0
    out.write('{"type": "FeatureCollection", "features": [')
    for place in place_map.places():
        out.write(",\n" if count else "\n")
        out.write(json.dumps(_feature(place, recognisable.get(place.place_id))))
        count += 1
    out.write("\n]}\n")
    return count


def _feature(place: Place, recognisable: float | None) -> dict[str, Any]:
    """Return a place as a GeoJSON feature. Its marker-color is a simplestyle key, which geojson.io and GitHub draw.
    `recognisable`: see `write_geojson` (None: unknown)."""
    position, pose, salience = place.position, place.pose, place.salience
    geometry, known = None, dict[str, Any]()
    if position:
        altitude = [] if position.alt_m is None else [position.alt_m]
        geometry = {"type": "Point", "coordinates": [position.lon_deg, position.lat_deg, *altitude]}
    if salience:
        colour = _LOW if salience.is_low else _USUAL
        colour = _LOW if salience.is_low else _USUAL
        known |= {**salience.rounded(), "low_quality": salience.is_low, "marker-color": colour}
    if recognisable is not None:
        step = min(int(recognisable * len(_RECOGNISABLE)), len(_RECOGNISABLE) - 1)
        known |= {"recognisable": round(recognisable, 3), "marker-color": _RECOGNISABLE[step]}
    if pose:
        recorded = pose.recorded
        known |= {
            "up_deg": round(pose.up_deg, 1),
            "footprint_m": round(pose.footprint_m, 2),
            "covariance_m2": [round(value, 3) for value in pose.covariance_m2],
            "recorded": [recorded.lon_deg, recorded.lat_deg] if recorded else None,
        }
    properties = {
        "time": geopackage.utc_text(place.t_utc_s),
        "heading_deg": place.heading_deg,
        "source_image": place.source_image,
        "quality": round(place.quality, 4),
    }
    return {"type": "Feature", "id": place.place_id, "geometry": geometry, "properties": properties | known}
