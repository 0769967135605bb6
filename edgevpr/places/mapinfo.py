"""Summary of a map, from what SQLite can say of it quickly."""

import math
from dataclasses import dataclass

from edgevpr.core.contract import TechniqueSpec
from edgevpr.places.mapfile import PlaceMap
from edgevpr.places.sqlite import sentences

Extent = tuple[float, float, float, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class MapInfo:
    """Summary of a map; `extent` is (lat_min, lon_min, lat_max, lon_max) in degrees, None without positions or where
    the file does not say it. What the file has in another form than edgevpr writes is None too. `of_low_quality` counts
    the places that were kept only to bound a gap. Of `with_pose` places it is known how the picture lies on the ground:
    `footprint_m` is the mean length of its longest side there, and `position_sd_m` how exactly the positions are known,
    one axis, root mean square (None: of none)."""

    path: str
    spec: TechniqueSpec
    places: int
    with_position: int
    extent: Extent | None
    first_time: str | None
    last_time: str | None
    mean_quality: float | None
    of_low_quality: int
    with_pose: int
    footprint_m: float | None
    position_sd_m: float | None
    file_bytes: int
    made_by: str | None


def info_of(place_map: PlaceMap) -> MapInfo:
    """Summarise a map. Raises MapError where it cannot be read."""
    db = place_map.db
    with sentences(place_map.path):
        low = place_map.salience.split(", ")[-1]
        up, footprint, var_east, _, var_north, *_ = place_map.pose.split(", ")
        asked = f"count({up}), avg({footprint}), avg({var_east} + {var_north})"
        places, with_position, quality, of_low_quality, with_pose, footprint_m, var_m2, *times = db.execute(
            f"SELECT count(*), count(geom), avg(quality), total({low} = 1), {asked}, min(time), max(time) FROM places"
        ).fetchone()
        extent = db.execute(
            "SELECT min_y, min_x, max_y, max_x FROM gpkg_contents WHERE table_name = 'places'"
        ).fetchone()
    first, last = (time if isinstance(time, str) else None for time in times)
    return MapInfo(
        path=str(place_map.path),
        spec=place_map.spec,
        places=places,
        with_position=with_position,
        extent=_extent(extent) if with_position else None,
        first_time=first,
        last_time=last,
        mean_quality=quality,
        of_low_quality=int(of_low_quality),
        with_pose=with_pose,
        footprint_m=footprint_m,
        position_sd_m=math.sqrt(max(0.0, var_m2) / 2) if var_m2 is not None else None,
        file_bytes=place_map.path.stat().st_size,
        made_by=place_map.made_by,
    )


def _extent(stored: tuple | None) -> Extent | None:
    is_known = stored and all(isinstance(each, (int, float)) and math.isfinite(each) for each in stored)
    return stored if is_known else None
