"""The places at which pictures are cut from an orthophoto: a regular grid over all of it, or over an area."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from edgevpr.core.errors import UsageError
from edgevpr.mapmaking.missions import Area
from edgevpr.mapmaking.orthophoto import WGS84, Orthophoto, local_crs
from edgevpr.mapmaking.rasters import CRS, geometry_mask, rasterio, transform

MOST_PLACES = 1_000_000
_MOST_POINTS = 20 * MOST_PLACES  # of the grid in the bounding box of an area, before points outside are dropped


@dataclass(frozen=True, slots=True, kw_only=True)
class Lattice:
    """N places of a grid, in arrays (N,): `rows`, int, counted from the north, and `columns`, from the west; `lat_deg`
    and `lon_deg` in degrees of WGS-84. `shape` is the number of (rows, columns) of the whole grid."""

    rows: np.ndarray
    columns: np.ndarray
    lat_deg: np.ndarray
    lon_deg: np.ndarray
    shape: tuple[int, int]

    def __len__(self) -> int:
        return len(self.rows)


def lattice_of(
    orthophoto: Orthophoto, footprint_m: float, spacing_m: float, area: Area | None = None, margin_m: float = 0.0
) -> Lattice:
    """Make a grid of places `spacing_m` apart over the orthophoto. A square with sides of `footprint_m` around each
    place is inside its bounding box. With an `area` (None: no limit), keep only the places of this grid that are in
    its polygons or within `margin_m` of its paths.

    Raises UsageError if footprint or spacing do not fit the orthophoto, the area is outside of it, or there are no
    places or more than `MOST_PLACES`.
    """
    plane = local_crs(orthophoto.middle)
    x_m, y_m = orthophoto.outline(plane)
    low, high = np.array([x_m.min(), y_m.min()]), np.array([x_m.max(), y_m.max()])
    _require_fitting(orthophoto, footprint_m, spacing_m, high - low)
    low, high = low + footprint_m / 2, high - footprint_m / 2
    count = ((high - low) / spacing_m).astype(int) + 1
    first = (low + high - (count - 1) * spacing_m) / 2  # the south-west place
    begin, end = np.zeros(2, int), count
    if area:
        _require_touching(orthophoto, area)
        area_low, area_high = _box(area, plane, margin_m)
        if (area_high < low).any() or (area_low > high).any():
            raise _elsewhere(orthophoto, area)
        begin = np.clip(np.ceil((area_low - first) / spacing_m), 0, count).astype(int)
        end = np.clip(np.floor((area_high - first) / spacing_m) + 1, begin, count).astype(int)
    _require_bounded((end - begin).prod(), _MOST_POINTS if area else MOST_PLACES, spacing_m)
    x_m, y_m = (first[axis] + spacing_m * np.arange(begin[axis], end[axis]) for axis in (0, 1))
    y_m = y_m[::-1]
    wanted = np.ones((len(y_m), len(x_m)), bool)
    if area and wanted.size:
        wanted = _inside(area, plane, margin_m, x_m, y_m, spacing_m)
    rows, columns = np.nonzero(wanted)
    _require_bounded(len(rows), MOST_PLACES, spacing_m)
    if not len(rows):
        raise UsageError(
            f"No place of a grid of {spacing_m:g} m lies in the area and in {orthophoto.path}: give a smaller spacing "
            "or a larger margin."
        )
    lon_deg, lat_deg = transform(plane, WGS84, x_m[columns], y_m[rows])
    return Lattice(
        rows=rows + count[1] - end[1],
        columns=columns + begin[0],
        lat_deg=np.array(lat_deg),
        lon_deg=np.array(lon_deg),
        shape=(int(count[1]), int(count[0])),
    )


def _require_fitting(orthophoto: Orthophoto, footprint_m: float, spacing_m: float, size_m: np.ndarray) -> None:
    size = f"{orthophoto.path} is {size_m[0]:.0f} m by {size_m[1]:.0f} m"
    for flag, metres, most_m in (
        ("--footprint-m", footprint_m, size_m.min()),
        ("--spacing-m", spacing_m, size_m.max()),
    ):
        if not 0 < metres <= most_m:  # false for NaN
            raise UsageError(f"{flag} is {metres:g}, and {size}: give more than 0 and no more than that.")


def _require_bounded(count: int, most: int, spacing_m: float) -> None:
    if count > most:
        needed_m = math.ceil(spacing_m * math.sqrt(count / MOST_PLACES))
        raise UsageError(
            f"A grid of {spacing_m:g} m has {count:,} points here, and a map {MOST_PLACES:,} places at most: give "
            f"--spacing-m {needed_m}, or an --area."
        )


def _require_touching(orthophoto: Orthophoto, area: Area) -> None:
    (south, west, north, east), (other_south, other_west, other_north, other_east) = (
        orthophoto.extent_deg,
        area.extent_deg,
    )
    if south > other_north + 1 or other_south > north + 1 or west > other_east + 1 or other_west > east + 1:
        raise _elsewhere(orthophoto, area)  # too far away to be projected to this plane


def _elsewhere(orthophoto: Orthophoto, area: Area) -> UsageError:
    return UsageError(
        f"The area does not touch {orthophoto.path}: it lies at {extent_words(area.extent_deg)}, the orthophoto at "
        f"{extent_words(orthophoto.extent_deg)}."
    )


def extent_words(extent_deg: tuple[float, float, float, float]) -> str:
    """Format a bounding box (south, west, north, east) for messages."""
    south, west, north, east = extent_deg
    return f"{south:.4f}..{north:.4f} north, {west:.4f}..{east:.4f} east"


def _box(area: Area, plane: CRS, margin_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the least and the largest (x, y) of the area with its margin, float64 (2,) each, in metres of `plane`."""
    points_m = [np.concatenate([_metres(ring, plane) for ring in rings]) for rings in area.polygons]
    low, high = [each.min(axis=0) for each in points_m], [each.max(axis=0) for each in points_m]
    for path in _paths_m(area, plane):
        low.append(path.min(axis=0) - margin_m)
        high.append(path.max(axis=0) + margin_m)
    return np.min(low, axis=0), np.max(high, axis=0)


def _metres(points: Sequence[tuple[float, float]], plane: CRS) -> np.ndarray:
    lat_deg, lon_deg = zip(*points, strict=True)
    return np.column_stack(transform(WGS84, plane, lon_deg, lat_deg))


def _paths_m(area: Area, plane: CRS) -> list[np.ndarray]:
    return [_metres([(way.lat_deg, way.lon_deg) for way in path], plane) for path in area.paths]


def _inside(area: Area, plane: CRS, margin_m: float, x_m: np.ndarray, y_m: np.ndarray, step_m: float) -> np.ndarray:
    """Return which points of the grid are in the area, bool (rows, columns). `x_m` are the x of the columns, ascending,
    and `y_m` the y of the rows, descending, in metres of `plane`; `step_m` is their distance."""
    shape = len(y_m), len(x_m)
    inside = np.zeros(shape, bool)
    if area.polygons:
        grid = rasterio.Affine(step_m, 0, x_m[0] - step_m / 2, 0, -step_m, y_m[0] + step_m / 2)
        rings_m = [[_metres(ring, plane).tolist() for ring in rings] for rings in area.polygons]
        polygons = [{"type": "Polygon", "coordinates": rings} for rings in rings_m]
        inside |= geometry_mask(polygons, shape, grid, invert=True)
    for points_m in _paths_m(area, plane):
        for begin, end in zip(points_m, points_m[1:] if len(points_m) > 1 else points_m, strict=False):
            _near(inside, x_m, y_m, begin, end, margin_m)
    return inside


def _near(
    inside: np.ndarray, x_m: np.ndarray, y_m: np.ndarray, begin: np.ndarray, end: np.ndarray, margin_m: float
) -> None:
    """Set the points of the grid `inside` to True that are within `margin_m` of the line `begin`-`end`, (2,) each."""
    low, high = np.minimum(begin, end) - margin_m, np.maximum(begin, end) + margin_m
    columns = slice(*np.searchsorted(x_m, (low[0], high[0])))
    rows = slice(*np.searchsorted(-y_m, (-high[1], -low[1])))
    east_m, north_m = x_m[columns][None] - begin[0], y_m[rows][:, None] - begin[1]
    way = end - begin
    share = np.clip((east_m * way[0] + north_m * way[1]) / max(way @ way, 1e-9), 0, 1)
    inside[rows, columns] |= np.hypot(east_m - share * way[0], north_m - share * way[1]) <= margin_m
