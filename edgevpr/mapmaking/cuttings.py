"""An orthophoto as a source of frames, from which a map can be made: for each place of a grid it gives the picture that
a camera looking straight down would take there, with north at the top."""

from collections.abc import Callable, Collection

from edgevpr.core.errors import ImageError
from edgevpr.core.text import decoded_name
from edgevpr.core.types import Frame, Pose, Position
from edgevpr.frames.shot import Refusal
from edgevpr.frames.source import RecordingSource
from edgevpr.mapmaking.lattice import Lattice
from edgevpr.mapmaking.orthophoto import Orthophoto

SIDE_PX = 512
MOST_WITHOUT_DATA = 0.1  # share of a picture's pixels
_GEO_REFERENCE_M = 1.0  # standard deviation of the orthophoto's own position on the Earth, in each axis


class OrthophotoSource(RecordingSource):
    """Gives a frame for each place of the grid `lattice`: a square of ground with sides of `footprint_m`. Places of
    which more than a tenth has no data in the orthophoto are left out and counted in `without_data`. `only` are the
    names of the frames to read (None: all)."""

    def __init__(
        self,
        orthophoto: Orthophoto,
        lattice: Lattice,
        footprint_m: float,
        clock: Callable[[], float],
        *,
        only: Collection[str] | None = None,
    ) -> None:
        super().__init__(only)
        self._orthophoto, self._lattice, self._footprint_m, self._clock = orthophoto, lattice, footprint_m, clock
        self.total = len(lattice)
        self.without_data = 0
        self._read = 0
        variance_m2 = _GEO_REFERENCE_M**2 + (orthophoto.resolution_m / 2) ** 2
        self._pose = Pose(
            up_deg=0.0, footprint_m=footprint_m, covariance_m2=(variance_m2, 0.0, variance_m2), is_surveyed=True
        )

    def read(self, timeout_s: float) -> Frame | None:
        """Return the frame of the next place, None if that place is left out. Raises ImageError for a damaged part of
        the file; the next call continues with the place after it. `timeout_s` is ignored."""
        if self.ended:
            return None
        lattice, at = self._lattice, self._read
        self._read += 1
        if self._read == self.total:
            self.end()
        numbers = zip((lattice.rows[at], lattice.columns[at]), lattice.shape, strict=True)
        # With leading zeros, so that names sort in the order of the numbers.
        row, column = (str(number).zfill(max(3, len(str(count - 1)))) for number, count in numbers)
        name = f"{decoded_name(self._orthophoto.path.name)}_r{row}_c{column}"
        if not self.is_wanted(name):
            return None
        position = Position(float(lattice.lat_deg[at]), float(lattice.lon_deg[at]))
        try:
            image, valid = self._orthophoto.cut(position, self._footprint_m, SIDE_PX)
        except ImageError:
            self.refused[Refusal.DAMAGED.value] += 1
            raise
        if valid.mean() < 1 - MOST_WITHOUT_DATA:
            self.without_data += 1
            return None
        return Frame(
            image=image, name=name, t_mono_s=self._clock(), position=position, heading_deg=0.0, pose=self._pose
        )

    def close(self) -> None:
        """Close the orthophoto."""
        self._orthophoto.close()
