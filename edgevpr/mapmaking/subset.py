"""Cuts out the part of a map, or of a folder of maps, that one flight needs: the places near its mission."""

import shutil
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from edgevpr.core.arrays import Doubles
from edgevpr.core.errors import MapError, UsageError
from edgevpr.core.geodesy import offset_m
from edgevpr.core.text import Progress
from edgevpr.mapmaking.missions import Area, shapely
from edgevpr.places import mapfiles
from edgevpr.places.examine import copy_places, merge_maps, shrink_map
from edgevpr.places.mapfile import PlaceMap


@dataclass(frozen=True, slots=True, kw_only=True)
class Subset:
    """A map made for one flight. `maps`: number of maps from which it was made. `near`: number of places near the
    mission; the best `places` of these are in the map. `file_bytes`: its size. `lost_calibration`: it was merged from
    several maps, at least one of which was calibrated, and is not calibrated itself."""

    maps: int
    near: int
    places: int
    file_bytes: int
    lost_calibration: bool


def make_subset(
    source: Path, area: Area, margin_m: float, out: Path, max_bytes: float | None, progress: Progress
) -> Subset:
    """Make the map `out` from the places of `source`, a map or a folder of maps, within `margin_m` metres of an area.
    If `max_bytes` (None: no limit) cannot hold all of them, the best are kept, spread over the ground. Raises
    UsageError if there are no such places or none fits, and MapError if a map cannot be read."""
    south, west, north, east = area.extent_deg

    def project(lat_deg: Doubles, lon_deg: Doubles) -> tuple[Doubles, Doubles]:
        return offset_m((south + north) / 2, (west + east) / 2, lat_deg, lon_deg)

    ground = area.project_ground(project, margin_m, margin_m)
    ids_by_path: dict[Path, list[int]] = {}
    for path in _list_maps(source):
        with PlaceMap.open(path) as place_map:
            place_ids, lat_deg, lon_deg, _ = np.array(list(place_map.read_outlines())).reshape(-1, 4).T
            if (is_near := shapely.contains_xy(ground, *project(lat_deg, lon_deg))).any():
                ids_by_path[path] = place_ids[is_near].astype(int).tolist()
    paths, lost_calibration = list(ids_by_path), False
    with mapfiles.write_atomically(out) as temp_path, tempfile.TemporaryDirectory(dir=out.parent) as scratch:
        all_near, best_near = Path(scratch) / "near.gpkg", Path(scratch) / "small.gpkg"
        if len(paths) == 1:
            near = copy_places(paths[0], all_near, ids_by_path[paths[0]])
        elif paths:
            counts, lost_calibration = merge_maps(paths, all_near, progress, list(ids_by_path.values()))
            near = sum(copied for copied, _ in counts)
        if not paths or not near:
            raise UsageError(
                f"No place of {source} is within {margin_m:g} m of the mission: check both, or raise --margin-m."
            )
        count, file_bytes = near, all_near.stat().st_size
        if max_bytes is not None and file_bytes > max_bytes:
            count = int(near * max_bytes / file_bytes)
            if not count:
                place_mb = file_bytes / near / 1e6
                raise UsageError(f"--mb {max_bytes / 1e6:g} is too small for even one place ({place_mb:.3f} MB each).")
            shrink_map(all_near, best_near, count, progress)
        shutil.move(best_near if count < near else all_near, temp_path)
        size = temp_path.stat().st_size
    return Subset(maps=len(paths), near=near, places=count, file_bytes=size, lost_calibration=lost_calibration)


def _list_maps(source: Path) -> list[Path]:
    """Return the paths of the maps in `source`: one map, or a folder of maps. Raises MapError if there is none."""
    if not source.is_dir():
        return [mapfiles.require_map_file(source)]
    if not (paths := sorted(source.glob("*.gpkg"))):
        raise MapError(f"{source} contains no map (*.gpkg): pass a map, or a folder of maps.")
    return paths
