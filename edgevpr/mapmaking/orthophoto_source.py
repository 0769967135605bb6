"""An orthophoto as a source of frames for a map. Each point of a regular grid becomes a place, with the picture that a
camera looking straight down would take there, north up."""

import logging
import math
import time
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np

from edgevpr.core.arrays import Doubles, Image, Ints
from edgevpr.core.contract import Technique
from edgevpr.core.errors import ImageError, UsageError
from edgevpr.core.geodesy import Extent
from edgevpr.core.text import decode_name
from edgevpr.core.types import Frame, Pose, Position
from edgevpr.frames.shot import Refusal
from edgevpr.frames.source import RecordingSource
from edgevpr.mapmaking.missions import Area, read_area, shapely
from edgevpr.mapmaking.orthophoto import WGS84, Orthophoto, make_local_crs, transform

if TYPE_CHECKING:
    from edgevpr.mapmaking.pictures import OrthophotoGrid

_log = logging.getLogger(__name__)

SIDE_PX = 512
MAX_WITHOUT_DATA = 0.1  # fraction of a picture's pixels
_GEOREFERENCE_SD_M = 1.0  # standard deviation of the orthophoto's georeference along each axis
# Raster pixels along the side of a picture, from benchmarks/results/from_space.md. Below the first limit recall
# falls; below the second nothing is recognised.
_SHARP_WIDTH_PX = 150
_MIN_WIDTH_PX = 32
_MIN_WHITE = 200  # a pixel is white if each of its colours is at least this bright (0..255)
_MAX_COLOUR_DIFFERENCE = 30  # and its colours differ by less than this
_MIN_CLOUDY_FRACTION = 1 / 3  # of white pixels in a picture; in seven sets without clouds it is at most a sixth
_METADATA_BYTES = 10_000  # per place in a map file in addition to its descriptor, mainly landmarks
_MAX_PLACES = 1_000_000
_MAX_GRID_POINTS = 20 * _MAX_PLACES  # in the bounding box of an area, before points outside the area are dropped


@dataclass(frozen=True, slots=True, kw_only=True)
class Lattice:
    """N places on a grid, as arrays (N,): `rows` (int, from the north), `columns` (int, from the west), `lat_deg` and
    `lon_deg` (degrees, WGS-84). `shape` is the number of (rows, columns) of the whole grid. `footprint_m` is the length
    of a picture's side on the ground."""

    footprint_m: float
    rows: Ints
    columns: Ints
    lat_deg: Doubles
    lon_deg: Doubles
    shape: tuple[int, int]

    def __len__(self) -> int:
        return len(self.rows)


class OrthophotoSource(RecordingSource):
    """Source of one frame, a square of ground, for each place of the grids `lattices` (one grid per footprint).
    `counts` holds counts of `MappingResult`. Places are skipped, and counted as `without_data`, if the orthophoto lacks
    more than a tenth of their ground. `only` are the names of the frames to read (None: all)."""

    def __init__(
        self, orthophoto: Orthophoto, lattices: Sequence[Lattice], *, only: Collection[str] | None = None
    ) -> None:
        super().__init__(only)
        self._orthophoto, self._lattices = orthophoto, lattices
        self.total = sum(map(len, lattices))
        self.short_name = decode_name(orthophoto.short_name)
        self.counts = {"without_data": 0, "white": 0}
        self._read_count = 0
        self._remaining = ((lattice, index) for lattice in lattices for index in range(len(lattice)))
        variance_m2 = _GEOREFERENCE_SD_M**2 + (orthophoto.resolution_m / 2) ** 2
        self._covariance_m2 = variance_m2, 0.0, variance_m2

    def read(self, timeout_s: float) -> Frame | None:
        """Return the frame of the next place, or None if that place is skipped. Raises ImageError if that part of the
        file is damaged; the next call continues with the place after it. `timeout_s` is ignored."""
        if self.ended:
            return None
        lattice, index = next(self._remaining)
        self._read_count += 1
        if self._read_count == self.total:
            self.end()
        grid_indices = zip((lattice.rows[index], lattice.columns[index]), lattice.shape, strict=True)
        # Leading zeros make the names sort in grid order.
        row, column = (str(number).zfill(max(3, len(str(count - 1)))) for number, count in grid_indices)
        footprint_suffix = f"_{lattice.footprint_m:g}m" if len(self._lattices) > 1 else ""
        name = f"{self.short_name}{footprint_suffix}_r{row}_c{column}"
        if not self.is_selected(name):
            return None
        position = Position(float(lattice.lat_deg[index]), float(lattice.lon_deg[index]))
        try:
            image, valid = self._orthophoto.cut(position, lattice.footprint_m, SIDE_PX)
        except ImageError:
            self.refused[Refusal.DAMAGED.value] += 1
            raise
        if valid.mean() < 1 - MAX_WITHOUT_DATA:
            self.counts["without_data"] += 1
            return None
        self.counts["white"] += _compute_white_fraction(image) > _MIN_CLOUDY_FRACTION
        pose = Pose(up_deg=0.0, footprint_m=lattice.footprint_m, covariance_m2=self._covariance_m2, is_surveyed=True)
        return Frame(image=image, name=name, t_mono_s=time.monotonic(), position=position, heading_deg=0.0, pose=pose)

    def announce_size(self, spacing_m: float, technique: Technique) -> None:
        """Log the number of places to be extracted, and their ground area, size and resolution."""
        lattice = min(self._lattices, key=lambda lattice: lattice.footprint_m)
        spec = technique.spec
        place_bytes = spec.coarse.nbytes + (spec.fine.nbytes if spec.fine else 0) + _METADATA_BYTES
        side_px = lattice.footprint_m / self._orthophoto.resolution_m
        warning = f" (too coarse to recognise all of them; {_SHARP_WIDTH_PX} are enough for nearly all)"
        _log.info(
            "%d places will be extracted from the orthophoto: %.2f km2 of ground, %.1f MB, pictures of %.0f pixels a "
            "side%s",
            self.total,
            len(lattice) * spacing_m**2 / 1e6,
            self.total * place_bytes / 1e6,
            side_px,
            warning if side_px < _SHARP_WIDTH_PX else "",
        )

    def close(self) -> None:
        """Close the orthophoto."""
        self._orthophoto.close()


def _compute_white_fraction(image: Image) -> float:
    """Return the fraction of white pixels in a picture."""
    blue, green, red = cv2.split(image)
    low, high = cv2.min(cv2.min(blue, green), red), cv2.max(cv2.max(blue, green), red)
    return float(((low > _MIN_WHITE) & (high - low < _MAX_COLOUR_DIFFERENCE)).mean())


def open_orthophoto(grid: "OrthophotoGrid", only: Collection[str] | None) -> OrthophotoSource:
    """Open an orthophoto and choose the places (see `OrthophotoGrid.open`)."""
    footprints_m = [float(footprint_m) for footprint_m in np.unique(grid.footprint_m)]
    area = read_area(grid.area) if grid.area else None
    orthophoto = Orthophoto(grid.orthophoto)
    lattices = [make_lattice(orthophoto, footprint_m, grid.spacing_m, area) for footprint_m in footprints_m]
    if (side_px := footprints_m[0] / orthophoto.resolution_m) < _MIN_WIDTH_PX:
        raise UsageError(
            f"{orthophoto.name} is too coarse: a picture of {footprints_m[0]:g} m is {side_px:.0f} pixels wide, and "
            f"fewer than {_MIN_WIDTH_PX} cannot be recognised: use an orthophoto of higher resolution."
        )
    return OrthophotoSource(orthophoto, lattices, only=only)


def make_lattice(orthophoto: Orthophoto, footprint_m: float, spacing_m: float, area: Area | None = None) -> Lattice:
    """Make a grid of places `spacing_m` apart over the orthophoto. Each place's square, with sides of `footprint_m`,
    lies inside the bounding box of the orthophoto. With an `area` (None: no limit), only places inside its circle or
    within `footprint_m` of its path are kept.

    Raises UsageError if footprint or spacing do not fit the orthophoto, or if there is no place or more than a million.
    """
    plane = make_local_crs(orthophoto.middle)
    outline_m = np.array(orthophoto.compute_outline(plane))
    low, high = outline_m.min(axis=1), outline_m.max(axis=1)
    size_m = high - low
    for flag, value_m, max_m in (
        ("--footprint-m", footprint_m, size_m.min()),
        ("--spacing-m", spacing_m, size_m.max()),
    ):
        if not 0 < value_m <= max_m:  # also catches NaN
            raise UsageError(
                f"{flag} is {value_m:g}, but must be above 0 and fit into {orthophoto.name}, which measures "
                f"{size_m[0]:.0f} m by {size_m[1]:.0f} m."
            )
    low, high = low + footprint_m / 2, high - footprint_m / 2
    count = ((high - low) / spacing_m).astype(int) + 1
    first = (low + high - (count - 1) * spacing_m) / 2  # the south-west corner of the grid
    begin, end = np.zeros(2, int), count
    if area:
        ground = area.project_ground(
            lambda lat_deg, lon_deg: transform(WGS84, plane, lon_deg, lat_deg), 0.0, footprint_m
        )
        area_low, area_high = np.reshape(ground.bounds, (2, 2))
        if not ((area_low <= high) & (area_high >= low)).all():  # also catches an empty area, whose bounds are NaN
            raise UsageError(
                f"The area does not overlap {orthophoto.name}: it extends over {format_extent(area.extent_deg)}, the "
                f"orthophoto over {format_extent(orthophoto.extent_deg)}."
            )
        begin = np.clip(np.ceil((area_low - first) / spacing_m), 0, count).astype(int)
        end = np.clip(np.floor((area_high - first) / spacing_m) + 1, begin, count).astype(int)
    _require_at_most((end - begin).prod(), _MAX_GRID_POINTS if area else _MAX_PLACES, spacing_m)
    x_m, y_m = (first[axis] + spacing_m * np.arange(begin[axis], end[axis]) for axis in (0, 1))
    y_m = y_m[::-1]
    everywhere = np.ones((len(y_m), len(x_m)), bool)
    rows, columns = np.nonzero(shapely.contains_xy(ground, x_m[None], y_m[:, None]) if area else everywhere)
    _require_at_most(len(rows), _MAX_PLACES, spacing_m)
    if not len(rows):
        raise UsageError(
            f"No point of a {spacing_m:g} m grid is inside both the area and {orthophoto.name}: use a smaller "
            "--spacing-m."
        )
    lon_deg, lat_deg = map(np.array, transform(plane, WGS84, x_m[columns], y_m[rows]))
    shape = (int(count[1]), int(count[0]))
    rows, columns = rows + count[1] - end[1], columns + begin[0]
    return Lattice(footprint_m=footprint_m, rows=rows, columns=columns, lat_deg=lat_deg, lon_deg=lon_deg, shape=shape)


def _require_at_most(count: int, max_count: int, spacing_m: float) -> None:
    if count > max_count:
        needed_m = math.ceil(spacing_m * math.sqrt(count / _MAX_PLACES))
        raise UsageError(
            f"A {spacing_m:g} m grid has {count:,} points here, but a map can hold at most {_MAX_PLACES:,} places: "
            f"pass --spacing-m {needed_m}, or limit the map with --area."
        )


def format_extent(extent_deg: Extent) -> str:
    """Format a bounding box (south, west, north, east) for messages."""
    south, west, north, east = extent_deg
    return f"{south:.4f}..{north:.4f} north, {west:.4f}..{east:.4f} east"
