"""Queries about a whole map that read no descriptors: its summary and its identity."""

import hashlib
import math
from dataclasses import dataclass

from edgevpr.core.contract import TechniqueSpec
from edgevpr.core.geodesy import Extent
from edgevpr.places import rows
from edgevpr.places.layers import layers_of
from edgevpr.places.mapfile import PlaceMap
from edgevpr.places.mapfiles import sentences

_SUMMARY = """
SELECT count(*), count(geom), total(is_low_quality = 1), count(up_deg),
    avg(var_east_m2 + var_north_m2), min(CASE typeof(time) WHEN 'text' THEN time END),
    max(CASE typeof(time) WHEN 'text' THEN time END)
FROM places
"""
_EXTENT = "SELECT min_y, min_x, max_y, max_x FROM gpkg_contents WHERE table_name = 'places'"


@dataclass(frozen=True, slots=True, kw_only=True)
class MapInfo:
    """Summary of a map. `extent` is (lat_min, lon_min, lat_max, lon_max) in degrees. Any field is None if no place has
    the value, or if another program wrote it in another form. `with_position` and `with_pose` are numbers of places.
    `of_low_quality` is the number added only because there would have been too wide a gap. Of the places with a pose,
    `footprints_m` are the lengths on the ground of a picture's longest side (see `Layers`), and `position_sd_m` is the
    standard deviation of the positions along one axis, as root mean square. `attribution` names the owners of
    orthophotos."""

    path: str
    spec: TechniqueSpec
    places: int
    with_position: int
    extent: Extent | None
    first_time: str | None
    last_time: str | None
    of_low_quality: int
    with_pose: int
    footprints_m: tuple[float, ...]
    position_sd_m: float | None
    attribution: str | None
    file_bytes: int


@dataclass(frozen=True, slots=True)
class MapIdentity:
    """Identity of a map: equal for all copies of its file, different as soon as one place differs. `map_id` is the
    random id given at its creation (None: the file has none). `places` is their number. `sha256` covers all places
    (positions, poses, picture names, checksums of larger values) and the table edgevpr_map, with the calibration."""

    map_id: str | None
    places: int
    sha256: str


def describe_map(place_map: PlaceMap) -> MapInfo:
    """Return the summary of a map. Raises MapError if it cannot be read."""
    with sentences(place_map.path):
        summary = place_map.db.execute(_SUMMARY).fetchone()
    places, with_position, of_low_quality, with_pose, var_m2, first, last = summary
    return MapInfo(
        path=str(place_map.path),
        spec=place_map.spec,
        places=places,
        with_position=with_position,
        extent=read_extent(place_map) if with_position else None,
        first_time=first,
        last_time=last,
        of_low_quality=int(of_low_quality),
        with_pose=with_pose,
        footprints_m=layers_of(place_map).footprints_m,
        position_sd_m=None if var_m2 is None else math.sqrt(max(0.0, var_m2) / 2),
        attribution=place_map.attribution,
        file_bytes=place_map.path.stat().st_size,
    )


def read_extent(place_map: PlaceMap) -> Extent | None:
    """Return the bounding box that the file states for its places (None: it states none). Raises MapError."""
    with sentences(place_map.path):
        extent = place_map.db.execute(_EXTENT).fetchone()
    is_extent = extent and all(isinstance(side, (int, float)) and math.isfinite(side) for side in extent)
    return extent if is_extent else None


def read_identity(place_map: PlaceMap) -> MapIdentity:
    """Return the identity of an open map as it is now. Raises MapError if it cannot be read.

    Hashing the whole file at every start would take seconds on a small board. The checksums of the descriptors stand
    before them in the file, so they are read quickly, and change whenever a descriptor changes.
    """
    digest, places = hashlib.sha256(), 0
    with sentences(place_map.path):
        for row in place_map.db.execute("SELECT key, value FROM edgevpr_map ORDER BY key"):
            digest.update(repr(row).encode("utf-8", "backslashreplace"))
    for place in place_map.scan(f"{rows.VALUES}, {rows.SALIENCE}, {rows.POSE}, {rows.CHECKSUMS}"):
        digest.update(repr(place).encode("utf-8", "backslashreplace"))
        places += 1
    map_id = place_map.stored.get("map_id")
    return MapIdentity(map_id if isinstance(map_id, str) else None, places, digest.hexdigest())
