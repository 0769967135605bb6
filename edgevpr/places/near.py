"""Search of the map file by position, through the R-tree of the GeoPackage standard: fast for any size of map."""

import math
import sqlite3

from edgevpr.core.geodesy import EARTH_RADIUS_M, distance_m
from edgevpr.core.types import Position
from edgevpr.places import geopackage
from edgevpr.places.mapfile import PlaceMap
from edgevpr.places.sqlite import sentences

_IN_BOX = """
SELECT place_id, geom FROM rtree_places_geom JOIN places ON place_id = id
WHERE maxy >= ? AND miny <= ? AND maxx >= ? AND minx <= ?
"""


def index_positions(place_map: PlaceMap) -> None:
    """Add the R-tree, unless the map has it. A damaged position is not in it. Raises MapError."""
    db = place_map.db
    with sentences(place_map.path):
        if not db.execute("SELECT 1 FROM sqlite_master WHERE name = 'rtree_places_geom'").fetchone():
            try:
                db.executescript("BEGIN IMMEDIATE;" + geopackage.SPATIAL_INDEX + "COMMIT;")
            except sqlite3.Error:
                if db.in_transaction:
                    db.execute("ROLLBACK")
                raise


def nearest_m(place_map: PlaceMap, position: Position, within_m: float) -> float | None:
    """Return the metres to the nearest place of the file that can be read; None where none lies within `within_m`
    metres.

    Call `index_positions` before. Raises MapError where the file cannot be read.
    """
    lat_deg, lon_deg = position.lat_deg, position.lon_deg
    north_deg = math.degrees(within_m / EARTH_RADIUS_M)
    east_deg = min(180.0, north_deg / max(math.cos(math.radians(min(abs(lat_deg) + north_deg, 90.0))), 1e-9))
    nearest = math.inf
    with sentences(place_map.path):
        for turn_deg in (-360.0, 0.0, 360.0):  # places on the other side of the date line
            box = (lat_deg - north_deg, lat_deg + north_deg, lon_deg + turn_deg - east_deg)
            for place_id, geom in place_map.db.execute(_IN_BOX, (*box, lon_deg + turn_deg + east_deg)):
                if place_id not in place_map.left_out and (point := geopackage.point_or_none(geom)):
                    nearest = min(nearest, float(distance_m(lat_deg, lon_deg, *point)))
    return nearest if nearest <= within_m else None
