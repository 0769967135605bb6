"""The index of a folder of maps: one GeoPackage, with an outline of every tile, which QGIS shows, and what it holds.

It is written anew as a whole. All that it says is in the tiles' own files too, so it can be lost."""

import os
from collections.abc import Iterable, Mapping
from dataclasses import astuple, dataclass, fields
from pathlib import Path

import numpy as np
import pyogrio
import shapely

from edgevpr.core.contract import TechniqueSpec
from edgevpr.core.quadkeys import tile_extent
from edgevpr.places.history import read_counts
from edgevpr.places.mapfile import PlaceMap
from edgevpr.places.mapinfo import describe_map
from edgevpr.places.tilemap import INDEX
from edgevpr.runtime.recognise.evidence import read_calibration_for

_LAYER = "tiles"
_KINDS: Mapping[str, type] = {str(int): np.int64, str(float | None): np.float64}  # of columns; others are texts


@dataclass(frozen=True, slots=True, kw_only=True)
class Tile:
    """A tile of the grid that is mapped. `key`: its quad key; its map is KEY.gpkg in the folder of the index. `places`:
    their number. `inputs_sha256`: hash of all that the map was made of. `first_time`, `last_time`: of its pictures, in
    UTC. `expected`: share (0..1) of changed pictures of places in it and around it that was accepted when it was
    calibrated, at the `precision` wanted. None: unknown. `technique`: its name and parameters. `file_bytes`: size of
    the map. `passes`: flights over the same ground that were compared; `merged`, `faded`: places that became part of
    another, or that no later flight found; `changed`: spots where one did not find earlier ground."""

    key: str
    places: int
    inputs_sha256: str
    first_time: str | None
    last_time: str | None
    expected: float | None
    precision: float | None
    technique: str
    file_bytes: int
    passes: int = 0
    merged: int = 0
    faded: int = 0
    changed: int = 0


def path_of(folder: Path, key: str) -> Path:
    """Return the path of a tile's map."""
    return folder / f"{key}.gpkg"


def find_tile(path: Path) -> Tile:
    """Read what the index says of a tile from its map. Raises MapError."""
    with PlaceMap.open(path) as place_map:
        info, calibration, inputs = describe_map(place_map), read_calibration_for(place_map), place_map.inputs_sha256
        counts = read_counts(place_map)
    return Tile(
        key=path.stem,
        places=info.places,
        inputs_sha256=inputs or "",
        first_time=info.first_time,
        last_time=info.last_time,
        expected=calibration.accepted if calibration else None,
        precision=calibration.precision if calibration else None,
        technique=technique_text(info.spec),
        file_bytes=info.file_bytes,
        **counts,
    )


def technique_text(spec: TechniqueSpec) -> str:
    """Return the name and parameters of a technique as text."""
    return " ".join([spec.name, *(f"{name}={value}" for name, value in sorted(spec.parameters.items()))])


def write(folder: Path, tiles: Iterable[Tile]) -> None:
    """Write the index of a folder. It is replaced as a whole."""
    tiles = list(tiles)
    extents = [tile_extent(tile.key) for tile in tiles]
    outlines = [shapely.to_wkb(shapely.box(west, south, east, north)) for south, west, north, east in extents]
    columns = list(zip(*map(astuple, tiles), strict=True)) or [() for _ in fields(Tile)]
    kinds = [_KINDS.get(str(field.type), object) for field in fields(Tile)]
    unfinished = folder / f".{os.getpid()}.{INDEX}"
    pyogrio.raw.write(
        unfinished,
        np.array(outlines, object),
        [np.array(column, kind) for column, kind in zip(columns, kinds, strict=True)],
        [field.name for field in fields(Tile)],
        layer=_LAYER,
        driver="GPKG",
        geometry_type="Polygon",
        crs="EPSG:4326",
    )
    unfinished.replace(folder / INDEX)
