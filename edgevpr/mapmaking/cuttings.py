"""An orthophoto as a source of frames, from which a map can be made: for each place of a regular grid it gives the
picture that a camera looking straight down would take there, with north at the top."""

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
from edgevpr.mapmaking.georaster import WGS84, make_local_crs, transform
from edgevpr.mapmaking.missions import Area, read_area, shapely
from edgevpr.mapmaking.orthophoto import Orthophoto

if TYPE_CHECKING:
    from edgevpr.mapmaking.pictures import Cuttings

_log = logging.getLogger(__name__)

SIDE_PX = 512
MAX_WITHOUT_DATA = 0.1  # share of a picture's pixels
_GEOREFERENCE_SD_M = 1.0  # standard deviation of the orthophoto's own position on the Earth, in each axis
# Pixels of the raster along a picture, by benchmarks/results/from_space.md: with fewer, less is found, or nothing.
_SHARP_WIDTH_PX = 150
_MIN_WIDTH_PX = 32
_MIN_WHITE = 200  # grey values: the least, and the largest difference of colours
_MAX_COLOUR_DIFFERENCE = 30
_MIN_CLOUDY_SHARE = 1 / 3  # share of a picture that is white: in seven sets without clouds it is at most a sixth
_METADATA_BYTES = 10_000  # of a place in a map file, beside its descriptor: mainly landmarks
_MAX_PLACES = 1_000_000
_MAX_GRID_POINTS = 20 * _MAX_PLACES  # of the grid in the bounding box of an area, before points outside are dropped


@dataclass(frozen=True, slots=True, kw_only=True)
class Lattice:
    """N places of a grid, in arrays (N,): `rows`, int, counted from the north, and `columns`, from the west; `lat_deg`
    and `lon_deg` in degrees of WGS-84. `shape` is the number of (rows, columns) of the whole grid, `footprint_m` the
    ground along a side of each picture."""

    footprint_m: float
    rows: Ints
    columns: Ints
    lat_deg: Doubles
    lon_deg: Doubles
    shape: tuple[int, int]

    def __len__(self) -> int:
        return len(self.rows)

    def locate_place(self, at: int) -> Position:
        """Return the position of one place."""
        return Position(float(self.lat_deg[at]), float(self.lon_deg[at]))


class OrthophotoSource(RecordingSource):
    """Gives a frame for each place of the grids `lattices`, one for each footprint: a square of ground. `counts` are
    those of `MappingResult`: places `without_data` are left out, since more than a tenth of them has none. `only` are
    the names of the frames to read (None: all)."""

    def __init__(
        self, orthophoto: Orthophoto, lattices: Sequence[Lattice], *, only: Collection[str] | None = None
    ) -> None:
        super().__init__(only)
        self._orthophoto, self._lattices = orthophoto, lattices
        self.total = sum(map(len, lattices))
        self.short_name = decode_name(orthophoto.short_name)
        self.counts = {"without_data": 0, "white": 0}
        self._read = 0
        self._left = ((lattice, at) for lattice in lattices for at in range(len(lattice)))
        variance_m2 = _GEOREFERENCE_SD_M**2 + (orthophoto.resolution_m / 2) ** 2
        self._covariance_m2 = variance_m2, 0.0, variance_m2

    def read(self, timeout_s: float) -> Frame | None:
        """Return the frame of the next place, None if that place is left out. Raises ImageError for a damaged part of
        the file; the next call continues with the place after it. `timeout_s` is ignored."""
        if self.ended:
            return None
        lattice, at = next(self._left)
        self._read += 1
        if self._read == self.total:
            self.end()
        numbers = zip((lattice.rows[at], lattice.columns[at]), lattice.shape, strict=True)
        # With leading zeros, so that names sort in the order of the numbers.
        row, column = (str(number).zfill(max(3, len(str(count - 1)))) for number, count in numbers)
        of_several = f"_{lattice.footprint_m:g}m" if len(self._lattices) > 1 else ""
        name = f"{self.short_name}{of_several}_r{row}_c{column}"
        if not self.is_selected(name):
            return None
        position = lattice.locate_place(at)
        try:
            image, valid = self._orthophoto.cut(position, lattice.footprint_m, SIDE_PX)
        except ImageError:
            self.refused[Refusal.DAMAGED.value] += 1
            raise
        if valid.mean() < 1 - MAX_WITHOUT_DATA:
            self.counts["without_data"] += 1
            return None
        self.counts["white"] += _compute_white_share(image) > _MIN_CLOUDY_SHARE
        pose = Pose(up_deg=0.0, footprint_m=lattice.footprint_m, covariance_m2=self._covariance_m2, is_surveyed=True)
        return Frame(image=image, name=name, t_mono_s=time.monotonic(), position=position, heading_deg=0.0, pose=pose)

    def announce_size(self, spacing_m: float, technique: Technique) -> None:
        """Log how much will be cut."""
        lattice = min(self._lattices, key=lambda each: each.footprint_m)
        spec = technique.spec
        place_bytes = spec.coarse.nbytes + (spec.fine.nbytes if spec.fine else 0) + _METADATA_BYTES
        across_px = lattice.footprint_m / self._orthophoto.resolution_m
        few = (
            ""
            if across_px >= _SHARP_WIDTH_PX
            else f", too few to find all (with {_SHARP_WIDTH_PX} nearly all are found)"
        )
        _log.info(
            "%d places will be cut: %.2f km2 of ground, %.1f MB, %.0f pixels along a picture%s",
            self.total,
            len(lattice) * spacing_m**2 / 1e6,
            self.total * place_bytes / 1e6,
            across_px,
            few,
        )

    def close(self) -> None:
        """Close the orthophoto."""
        self._orthophoto.close()


def _compute_white_share(image: Image) -> float:
    """Return the share of a picture's pixels that are white."""
    blue, green, red = cv2.split(image)
    low, high = cv2.min(cv2.min(blue, green), red), cv2.max(cv2.max(blue, green), red)
    return float(((low > _MIN_WHITE) & (high - low < _MAX_COLOUR_DIFFERENCE)).mean())


def open_cuttings(cuttings: "Cuttings", only: Collection[str] | None) -> OrthophotoSource:
    """Open an orthophoto and choose the places, see `Cuttings.open`."""
    footprints_m = [float(footprint_m) for footprint_m in np.unique(cuttings.footprint_m)]
    area = read_area(cuttings.area) if cuttings.area else None
    orthophoto = Orthophoto(cuttings.orthophoto)
    lattices = [make_lattice(orthophoto, footprint_m, cuttings.spacing_m, area) for footprint_m in footprints_m]
    if (across_px := footprints_m[0] / orthophoto.resolution_m) < _MIN_WIDTH_PX:
        raise UsageError(
            f"{orthophoto.name} has {across_px:.0f} pixels along a picture of {footprints_m[0]:g} m, and nothing is "
            f"found with fewer than {_MIN_WIDTH_PX}: give a sharper one."
        )
    return OrthophotoSource(orthophoto, lattices, only=only)


def make_lattice(orthophoto: Orthophoto, footprint_m: float, spacing_m: float, area: Area | None = None) -> Lattice:
    """Make a grid of places `spacing_m` apart over the orthophoto. A square with sides of `footprint_m` around each
    place is inside its bounding box. With an `area` (None: no limit), keep only the places of this grid that are in
    its circle or within `footprint_m` of its path.

    Raises UsageError if footprint or spacing do not fit the orthophoto, or there are more than a million places, or
    none.
    """
    plane = make_local_crs(orthophoto.middle)
    outline_m = np.array(orthophoto.compute_outline(plane))
    low, high = outline_m.min(axis=1), outline_m.max(axis=1)
    size_m = high - low
    for flag, given_m, most_m in (
        ("--footprint-m", footprint_m, size_m.min()),
        ("--spacing-m", spacing_m, size_m.max()),
    ):
        if not 0 < given_m <= most_m:  # false for NaN
            raise UsageError(
                f"{flag} is {given_m:g}, and {orthophoto.name} is {size_m[0]:.0f} m by {size_m[1]:.0f} m: give more "
                "than 0 and no more than that."
            )
    low, high = low + footprint_m / 2, high - footprint_m / 2
    count = ((high - low) / spacing_m).astype(int) + 1
    first = (low + high - (count - 1) * spacing_m) / 2  # the south-west place
    begin, end = np.zeros(2, int), count
    if area:
        ground = area.project_ground(
            lambda lat_deg, lon_deg: transform(WGS84, plane, lon_deg, lat_deg), 0.0, footprint_m
        )
        area_low, area_high = np.reshape(ground.bounds, (2, 2))
        if not ((area_low <= high) & (area_high >= low)).all():  # false for an empty one, whose bounds are NaN
            raise UsageError(
                f"The area does not touch {orthophoto.name}: it is at {format_extent(area.extent_deg)}, the orthophoto "
                f"at {format_extent(orthophoto.extent_deg)}."
            )
        begin = np.clip(np.ceil((area_low - first) / spacing_m), 0, count).astype(int)
        end = np.clip(np.floor((area_high - first) / spacing_m) + 1, begin, count).astype(int)
    _require_at_most((end - begin).prod(), _MAX_GRID_POINTS if area else _MAX_PLACES, spacing_m)
    x_m, y_m = (first[axis] + spacing_m * np.arange(begin[axis], end[axis]) for axis in (0, 1))
    y_m = y_m[::-1]
    if area:
        wanted = shapely.contains_xy(ground, x_m[None], y_m[:, None])
    else:
        wanted = np.ones((len(y_m), len(x_m)), bool)
    rows, columns = np.nonzero(wanted)
    _require_at_most(len(rows), _MAX_PLACES, spacing_m)
    if not len(rows):
        raise UsageError(
            f"No place of a grid of {spacing_m:g} m lies in the area and in {orthophoto.name}: give a smaller spacing."
        )
    lon_deg, lat_deg = map(np.array, transform(plane, WGS84, x_m[columns], y_m[rows]))
    shape = (int(count[1]), int(count[0]))
    rows, columns = rows + count[1] - end[1], columns + begin[0]
    return Lattice(footprint_m=footprint_m, rows=rows, columns=columns, lat_deg=lat_deg, lon_deg=lon_deg, shape=shape)


def _require_at_most(count: int, most: int, spacing_m: float) -> None:
    if count > most:
        needed_m = math.ceil(spacing_m * math.sqrt(count / _MAX_PLACES))
        raise UsageError(
            f"A grid of {spacing_m:g} m has {count:,} points here, and a map {_MAX_PLACES:,} places at most: give "
            f"--spacing-m {needed_m}, or an --area."
        )


def format_extent(extent_deg: Extent) -> str:
    """Format a bounding box (south, west, north, east) for messages."""
    south, west, north, east = extent_deg
    return f"{south:.4f}..{north:.4f} north, {west:.4f}..{east:.4f} east"
