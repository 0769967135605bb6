"""The grid in which large ground is mapped tile by tile: squares of 360 / 2^zoom degrees."""

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from edgevpr.core.arrays import Doubles, Ints
from edgevpr.core.geodesy import Extent

# On the equator a tile has a side of 10 km, or of 10 m. What comes into a folder later is divided as the first was: the
# few photographs of a first flight must not make one tile of a country.
LEAST_ZOOM = 12
MAX_ZOOM = 22
_EQUATOR_M = 40_075_016.7


class Tile(NamedTuple):
    """A square of the grid: its `zoom`, its `row` from the equator to the north, and its `column` from Greenwich to the
    east."""

    zoom: int
    row: int
    column: int

    @property
    def name(self) -> str:
        """The name of its map, without the suffix."""
        return f"{self.zoom}_{self.row}_{self.column}"

    @property
    def extent_deg(self) -> Extent:
        """Its bounding box: (south, west, north, east) in degrees. Neighbours share an edge exactly."""
        side_deg = 360 / 2**self.zoom
        return (
            self.row * side_deg,
            self.column * side_deg,
            (self.row + 1) * side_deg,
            (self.column + 1) * side_deg,
        )


def parse_zoom(name: str) -> int | None:
    """Return the zoom of the tile whose map has this name; None if it is no tile's."""
    parts = name.split("_")
    zoom = parts[0]
    return int(zoom) if len(parts) == 3 and zoom.isdecimal() and LEAST_ZOOM <= int(zoom) <= MAX_ZOOM else None


def locate(lat_deg: Doubles, lon_deg: Doubles, zoom: int) -> Ints:
    """Return row and column, int (N, 2), of the tiles in which positions in degrees, (N,) each, lie."""
    side_deg = 360 / 2**zoom
    lon_deg = np.where(lon_deg >= 180, lon_deg - 360, lon_deg)
    return np.asarray(np.floor(np.column_stack((lat_deg, lon_deg)) / side_deg), int)


def list_tiles(extent_deg: Extent, zoom: int) -> Iterator[Tile]:
    """Yield all tiles that a bounding box touches; its longitudes may go beyond the antimeridian."""
    side_deg, half = 360 / 2**zoom, 2 ** (zoom - 1)
    bottom, left, top, right = (math.floor(side / side_deg) for side in extent_deg)
    for row in range(bottom, top + 1):
        for column in range(left, right + 1):
            yield Tile(zoom, row, (column + half) % (2 * half) - half)


def zoom_of_spacing(spacing_m: float, max_places: float) -> int:
    """Return the lowest zoom, from LEAST_ZOOM on, whose tiles hold at most `max_places` of a grid of `spacing_m`."""
    side_m = spacing_m * math.sqrt(max_places)
    return min(max(math.ceil(math.log2(_EQUATOR_M / side_m)), LEAST_ZOOM), MAX_ZOOM)


def zoom_of_places(lat_deg: Doubles, lon_deg: Doubles, max_places: int) -> int:
    """Return the lowest zoom, from LEAST_ZOOM on, of which no tile holds more than `max_places` of the positions in
    degrees, (N,)."""
    for zoom in range(LEAST_ZOOM, MAX_ZOOM):
        if np.unique(locate(lat_deg, lon_deg, zoom), axis=0, return_counts=True)[1].max() <= max_places:
            return zoom
    return MAX_ZOOM
