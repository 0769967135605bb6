"""A map as GeoJSON (RFC 7946): the places without their descriptors, for any map viewer."""

import json
from collections.abc import Mapping
from typing import TextIO

from edgevpr.core.types import Place, Pose, Salience
from edgevpr.places import geopackage
from edgevpr.places.mapfile import PlaceMap

_LOW, _USUAL = "#e0b060", "#2060c0"
# From hardly recognisable to surely, in five equal steps; red and blue are told apart by every eye.
_RECOGNISABLE = ("#d73027", "#fc8d59", "#fee090", "#91bfdb", "#4575b4")


def write_geojson(place_map: PlaceMap, out: TextIO, recognisable: Mapping[int, float] | None = None) -> int:
    """Write all places as one FeatureCollection, one feature a line, and return their number. `recognisable` is how
    surely places are recognised, 0..1 by their numbers, as far as it is known; it gives them their colours."""
    recognisable = recognisable or {}
    count = 0
    out.write('{"type": "FeatureCollection", "features": [')
    for place in place_map.places():
        out.write(",\n" if count else "\n")
        out.write(json.dumps(_feature(place, recognisable.get(place.place_id))))
        count += 1
    out.write("\n]}\n")
    return count


def _feature(place: Place, recognisable: float | None) -> dict:
    position = place.position
    geometry = None
    if position:
        altitude = [] if position.alt_m is None else [position.alt_m]
        geometry = {"type": "Point", "coordinates": [position.lon_deg, position.lat_deg, *altitude]}
    return {
        "type": "Feature",
        "id": place.place_id,
        "geometry": geometry,
        "properties": {
            "time": geopackage.utc_text(place.t_utc_s),
            "heading_deg": place.heading_deg,
            "source_image": place.source_image,
            "quality": round(place.quality, 4),
            **_salience(place.salience),
            **_recognisable(recognisable),
            **_pose(place.pose),
        },
    }


def _pose(pose: Pose | None) -> dict:
    """Return what is known of how a place's picture lies on the ground."""
    if pose is None:
        return {}
    var_east, cov, var_north = pose.covariance_m2
    recorded = pose.recorded
    return {
        "up_deg": round(pose.up_deg, 1),
        "footprint_m": round(pose.footprint_m, 2),
        "covariance_m2": [round(var_east, 3), round(cov, 3), round(var_north, 3)],
        "recorded": [recorded.lon_deg, recorded.lat_deg] if recorded else None,
    }


def _recognisable(share: float | None) -> dict:
    """Return how surely a place is recognised, and the colour of that."""
    if share is None:
        return {}
    step = min(int(share * len(_RECOGNISABLE)), len(_RECOGNISABLE) - 1)
    return {"recognisable": round(share, 3), "marker-color": _RECOGNISABLE[step]}


def _salience(salience: Salience | None) -> dict:
    """Return what is known of a place's salience. Viewers that know the simplestyle keys (geojson.io, GitHub, QGIS by a
    rule on `low_quality`) draw a place of low quality small and pale."""
    if salience is None:
        return {}
    return {
        **salience.rounded(),
        "low_quality": salience.is_low,
        "marker-color": _LOW if salience.is_low else _USUAL,
        "marker-size": "small" if salience.is_low else "medium",
    }
