"""The pictures that a map is made from: taken in flight, or cut from an orthophoto."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from edgevpr.frames.source import Source, open_source

if TYPE_CHECKING:
    from edgevpr.mapmaking.orthophoto_source import OrthophotoSource


@dataclass(frozen=True, slots=True, kw_only=True)
class FlightPictures:
    """Pictures taken in flight. `source`: a folder of images, or a video. `positions`: the table of their positions
    (None: the one that `open_source` finds). `rate_hz`: pictures to use per second of video (None: every frame)."""

    source: str
    positions: Path | None = None
    rate_hz: float | None = None

    def open(self, only: Collection[str] | None = None, *, upright: bool) -> Source:
        """Open the source. Only pictures named in `only` are read (None: all). `upright` is as in `open_source`."""
        step_s = 1 / self.rate_hz if self.rate_hz else None
        return open_source(self.source, step_s=step_s, positions=self.positions, live=False, only=only, upright=upright)

    @property
    def folder(self) -> Path | None:
        """The folder of images; None for a video."""
        return Path(self.source) if Path(self.source).is_dir() else None


@dataclass(frozen=True, slots=True, kw_only=True)
class OrthophotoGrid:
    """A grid of pictures to cut from an orthophoto.

    `orthophoto`: see `Orthophoto`. `footprint_m`: length of a picture's side on the ground, or several lengths, each of
    which gets a grid of its own. `spacing_m`: distance between neighbouring points. `area`: file or circle that limits
    the places, see `missions.read_area` (None: the whole orthophoto). `attribution`: credit line that the owner
    requires, stored in the map (None: not required)."""

    orthophoto: str
    footprint_m: float | Sequence[float]
    spacing_m: float
    area: str | None = None
    attribution: str | None = None

    def open(self, only: Collection[str] | None = None) -> "OrthophotoSource":
        """Open the orthophoto and choose the places. Only pictures named in `only` are cut (None: all).
        Raises SourceError if it cannot be opened, and UsageError if the grid or the area does not fit it."""
        from edgevpr.mapmaking.orthophoto_source import open_orthophoto  # loads GDAL, or raises if it is missing

        return open_orthophoto(self, only)
