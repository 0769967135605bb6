"""Summary and identity of a map, from queries that read no descriptors."""

import hashlib
import math
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np

from edgevpr.core.arrays import Bools, Floats
from edgevpr.core.contract import TechniqueSpec
from edgevpr.core.errors import PlaceError
from edgevpr.core.geodesy import Extent, offset_m
from edgevpr.places import rows
from edgevpr.places.layers import read_layers
from edgevpr.places.mapfile import PlaceMap
from edgevpr.places.mapfiles import translate_errors

_SUMMARY = """
SELECT count(*), count(geom), total(is_low_quality = 1), count(up_deg),
    avg(var_east_m2 + var_north_m2), min(CASE typeof(time) WHEN 'text' THEN time END),
    max(CASE typeof(time) WHEN 'text' THEN time END)
FROM places
"""
_MIN_COURSES = 10
_MAX_PASS_STEPS = 3.0  # longest time or distance between successive places of one pass, as a multiple of the median
_MIN_COURSE_LENGTH = 0.9  # of the mean of the unit vectors along the courses, if all are in one direction
_MAX_SIGMA = 4.0  # standard deviations per axis between a tag and the true position of its picture
_RAYLEIGH_MEDIAN = 1.1774  # median length of a normally distributed 2D vector, in standard deviations per axis
_MIN_TAG_ERROR_M = 5.0  # smaller distances are normal receiver errors
_EXTENT = "SELECT min_y, min_x, max_y, max_x FROM gpkg_contents WHERE table_name = 'places'"


@dataclass(frozen=True, slots=True, kw_only=True)
class MapInfo:
    """Summary of a map. `extent` is (lat_min, lon_min, lat_max, lon_max) in degrees. Any field is None if no place has
    the value, or if another program wrote it in a different form. `with_position` and `with_pose` are numbers of
    places. `of_low_quality` is the number of places added only to close a gap. For the places with a pose,
    `footprints_m` are the lengths on the ground of a picture's longest side (see `Layers`), and `position_sd_m` is the
    standard deviation of the positions along one axis, as root mean square. `attribution` lists the owners of
    orthophotos. `one_way_deg` is the course of a nadir map that was flown in one direction: a camera that triggers late
    shifts such a map along its course, and nothing in the map reveals it."""

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
    one_way_deg: float | None
    file_bytes: int

    @property
    def one_way_warning(self) -> str:
        """A one-sentence warning about the error that a map flown in one direction cannot reveal."""
        return (
            f"all places seem to be mapped on a course of about {self.one_way_deg:.0f} degrees: if the camera triggers "
            "late, all positions are shifted by its delay times the speed; only lines flown the other way show this"
        )


def describe_map(place_map: PlaceMap) -> MapInfo:
    """Return the summary of a map. Raises MapError if it cannot be read."""
    with translate_errors(place_map.path):
        row = place_map.db.execute(_SUMMARY).fetchone()
        places, with_position, of_low_quality, with_pose, var_m2, first, last = row
        extent = place_map.db.execute(_EXTENT).fetchone() if with_position else None
    has_extent = extent and all(isinstance(side, (int, float)) and math.isfinite(side) for side in extent)
    return MapInfo(
        path=str(place_map.path),
        spec=place_map.spec,
        places=places,
        with_position=with_position,
        extent=extent if has_extent else None,
        first_time=first,
        last_time=last,
        of_low_quality=int(of_low_quality),
        with_pose=with_pose,
        footprints_m=read_layers(place_map).footprints_m,
        position_sd_m=None if var_m2 is None else math.sqrt(max(0.0, var_m2) / 2),
        attribution=place_map.attribution,
        one_way_deg=_find_one_way_deg(place_map) if place_map.spec.parameters.get("camera") == "nadir" else None,
        file_bytes=place_map.path.stat().st_size,
    )


def _find_one_way_deg(place_map: PlaceMap) -> float | None:
    """Return the course over ground, degrees, if all places were mapped in roughly one direction; None if not, or if
    they are cut from an orthophoto. If too few have times, the order of the map counts."""
    tags: list[tuple[float, float, float]] = []
    with suppress(PlaceError):  # the places before a damaged one are enough
        for place in place_map.read_places():
            if place.position and not (place.pose and place.pose.is_surveyed):
                t_s = math.nan if place.t_utc_s is None else place.t_utc_s
                tags.append((t_s, place.position.lat_deg, place.position.lon_deg))
    timed = sorted(tag for tag in tags if not math.isnan(tag[0]))
    has_times = len(timed) > _MIN_COURSES
    if len(tags) <= _MIN_COURSES:
        return None
    t_s, lat_deg, lon_deg = np.array(timed if has_times else tags).T
    east_m, north_m = offset_m(lat_deg[:-1], lon_deg[:-1], lat_deg[1:], lon_deg[1:])
    step_m = east_m + 1j * north_m
    step = np.diff(t_s) if has_times else abs(step_m)
    step, step_m = step[step_m != 0], step_m[step_m != 0]
    if len(step) < _MIN_COURSES:
        return None
    courses = step_m[step <= _MAX_PASS_STEPS * np.median(step)]
    if len(courses) < _MIN_COURSES:
        return None
    mean = np.mean(courses / np.abs(courses))
    return math.degrees(math.atan2(mean.real, mean.imag)) % 360 if abs(mean) >= _MIN_COURSE_LENGTH else None


def read_identity(place_map: PlaceMap) -> dict[str, Any]:
    """Return the identity of an open map: equal for all copies of its file, different as soon as one place differs.
    `map_id`: random id from its creation (None: the file has none). `places`: their number. `sha256` covers all places
    (positions, poses, picture names, checksums of larger values) and the table edgevpr_map with the calibration.
    Raises MapError if the map cannot be read.

    Hashing the whole file at every start would take seconds on a small board. The checksums of the descriptors precede
    them in the file, so they are read quickly, and change whenever a descriptor changes."""
    digest, places = hashlib.sha256(), 0
    with translate_errors(place_map.path):
        for row in place_map.db.execute("SELECT key, value FROM edgevpr_map ORDER BY key"):
            digest.update(repr(row).encode("utf-8", "backslashreplace"))
    for place in place_map.scan_rows(f"{rows.VALUES}, {rows.SALIENCE}, {rows.POSE}, {rows.CHECKSUMS}"):
        digest.update(repr(place).encode("utf-8", "backslashreplace"))
        places += 1
    map_id = place_map.stored.get("map_id")
    return {"map_id": map_id if isinstance(map_id, str) else None, "places": places, "sha256": digest.hexdigest()}


def find_inconsistent_tags(shift_m: Floats) -> Bools:
    """Return bool (N,), True for places whose recorded position is more than four standard deviations per axis from the
    refined one. `shift_m`, float (N,): metres between the two; their median sets the standard deviation."""
    limit_m = max(_MIN_TAG_ERROR_M, _MAX_SIGMA * float(np.median(shift_m)) / _RAYLEIGH_MEDIAN) if len(shift_m) else 0.0
    return shift_m > limit_m
