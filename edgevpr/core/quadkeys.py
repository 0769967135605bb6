"""The grid in which large ground is mapped tile by tile: map tiles of the Web Mercator projection, named by quad keys.
A key has a digit for each zoom, which says in which quarter of the tile before it lies: 0 and 1 north, 0 and 2 west."""

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from edgevpr.core.arrays import Bools, Doubles, Ints, LatLon
from edgevpr.core.errors import UsageError
from edgevpr.core.geodesy import moved

MOST_LAT_DEG = 85.05  # farther from the equator there are no map tiles
# At the equator a tile has a side of 10 km, or of 10 m. What comes into a folder later is divided as the first was: the
# few photographs of a first flight must not make one tile of a country.
LEAST_ZOOM, MOST_ZOOM = 12, 22
_EQUATOR_M = 40_075_016.7
_MORE = 0.01  # of an extent: its edges are curves in other projections

Extent = tuple[float, float, float, float]


def tile_keys(lat_deg: Doubles, lon_deg: Doubles, zoom: int) -> NDArray[np.str_]:
    """Return the keys, of `zoom` digits, of the tiles in which positions in degrees (N,) lie: str (N,). Raises
    UsageError for a position near a pole."""
    if len(lat_deg) and np.abs(lat_deg).max() > MOST_LAT_DEG:
        raise UsageError(
            f"A place is at {lat_deg[np.abs(lat_deg).argmax()]:.2f} degrees north, and tiles end at {MOST_LAT_DEG} "
            "degrees north and south: make a single map with `edgevpr map build`."
        )
    column, row = _numbers(lat_deg, lon_deg, zoom)
    return _spelt(column % 2**zoom, row, zoom)


def _spelt(column: Ints, row: Ints, zoom: int) -> NDArray[np.str_]:
    """Return the keys of tiles by their columns and rows, int (N,) each."""
    keys = np.full(len(column), "", f"<U{zoom}")
    for level in reversed(range(zoom)):
        keys = np.char.add(keys, ((column >> level & 1) + 2 * (row >> level & 1)).astype(str))
    return keys


def tile_extent(key: str) -> Extent:
    """Return the bounding box of a tile: (south, west, north, east) in degrees."""
    column = sum((int(digit) & 1) << level for level, digit in enumerate(reversed(key)))
    row = sum((int(digit) >> 1) << level for level, digit in enumerate(reversed(key)))
    across = 2 ** len(key)
    west, east = (360 * (column + each) / across - 180 for each in (0, 1))
    north, south = (math.degrees(math.atan(math.sinh(math.pi * (1 - 2 * (row + each) / across)))) for each in (0, 1))
    return south, west, north, east


def extent_around(key: str, margin_m: float) -> Extent:
    """Return the bounding box of a tile and of the ground within `margin_m` metres of it, as `tile_extent` does; its
    east may be above 180."""
    south, west, north, east = tile_extent(key)
    (south, west), (north, east) = moved(south, west, -margin_m, -margin_m), moved(north, east, margin_m, margin_m)
    return south, west, north, west + (east - west) % 360


def in_extent(extent_deg: Extent, lat_deg: Doubles, lon_deg: Doubles) -> Bools:
    """Return bool (N,), True for the positions in degrees, (N,) each, that lie in a bounding box."""
    south, west, north, east = extent_deg
    return (lat_deg > south) & (lat_deg < north) & ((lon_deg - west) % 360 < (east - west) % 360)


def ring_around(extent_deg: Extent) -> list[LatLon]:
    """Return an outline that is a little larger than a bounding box: five points (lat, lon) in degrees."""
    south, west, north, east = extent_deg
    lat_deg, lon_deg = _MORE * (north - south), _MORE * (east - west)
    south, west, north, east = south - lat_deg, west - lon_deg, north + lat_deg, east + lon_deg
    return [(south, west), (south, east), (north, east), (north, west), (south, west)]


def keys_over(extent_deg: Extent, zoom: int) -> Iterator[str]:
    """Yield the keys of all tiles that a bounding box touches; its longitudes may go beyond the date line."""
    south, west, north, east = extent_deg
    (left, right), (bottom, top) = _numbers(np.array([south, north]), np.array([west, east]), zoom)
    row, column = np.mgrid[top : bottom + 1, left : right + 1].reshape(2, -1)
    yield from _spelt(column % 2**zoom, row, zoom).tolist()


def maps_in(folder: Path) -> dict[str, Path]:
    """Return the maps of tiles in a folder, KEY.gpkg, by their keys."""
    paths = sorted(folder.glob("[0-3]*.gpkg"))
    return {path.stem: path for path in paths if not path.stem.strip("0123")}


def zoom_of_spacing(lat_deg: float, spacing_m: float, most_places: float) -> int:
    """Return the lowest zoom, from LEAST_ZOOM on, whose tiles hold at most `most_places` of a grid of `spacing_m` at a
    latitude."""
    side_m = spacing_m * math.sqrt(most_places)
    around_m = _EQUATOR_M * math.cos(math.radians(lat_deg))
    return min(max(math.ceil(math.log2(around_m / side_m)), LEAST_ZOOM), MOST_ZOOM)


def zoom_of_places(lat_deg: Doubles, lon_deg: Doubles, most_places: int) -> int:
    """Return the lowest zoom, from LEAST_ZOOM on, of which no tile holds more than `most_places` of the positions in
    degrees, (N,)."""
    for zoom in range(LEAST_ZOOM, MOST_ZOOM):
        column, row = _numbers(lat_deg, lon_deg, zoom)
        if np.unique((row << zoom) + column % 2**zoom, return_counts=True)[1].max() <= most_places:
            return zoom
    return MOST_ZOOM


def _numbers(lat_deg: Doubles, lon_deg: Doubles, zoom: int) -> tuple[Ints, Ints]:
    """Return the columns and rows, int (N,), of the tiles in which positions (N,) lie. Beyond the date line columns go
    on counting."""
    across = 2**zoom
    column = np.floor((np.asarray(lon_deg) / 360 + 0.5) * across).astype(int)
    down = 0.5 - np.arcsinh(np.tan(np.radians(lat_deg))) / (2 * np.pi)
    row = np.clip(np.floor(down * across).astype(int), 0, across - 1)
    return column, row
