"""A folder of images, read in order to its end."""

from collections.abc import Callable, Collection
from pathlib import Path

import numpy as np

from edgevpr.core.errors import ImageError, UsageError
from edgevpr.core.text import decoded_name
from edgevpr.core.types import Frame
from edgevpr.frames.exif import read_exif
from edgevpr.frames.images import list_images, read_image
from edgevpr.frames.positions import GeoTag, find_positions, read_positions
from edgevpr.frames.shot import Condition, Refusal


class RecordingSource:
    """The common part of all recordings; a subclass sets `ended`. Frames whose names are not in `only` are passed over
    (None: all are read)."""

    is_live = False
    dropped = latency_s = None
    ended: bool

    def __init__(self, only: Collection[str] | None = None) -> None:
        self.refused = {Refusal.DAMAGED.value: 0}
        self._only = None if only is None else frozenset(only)

    def is_wanted(self, name: str) -> bool:
        """Tell whether the frame of this name is to be read."""
        return self._only is None or name in self._only

    @property
    def condition(self) -> Condition:
        return Condition.ENDED if self.ended else Condition.RUNNING

    @property
    def state(self) -> str:
        return "ended" if self.ended else "reading"


def tagged(image: np.ndarray, name: str, t_mono_s: float, tag: GeoTag) -> Frame:
    """Return a frame with all that its tag knows."""
    return Frame(
        image=image,
        name=name,
        t_mono_s=t_mono_s,
        t_utc_s=tag.t_utc_s,
        position=tag.position,
        heading_deg=tag.heading_deg,
        roll_deg=tag.roll_deg,
        pitch_deg=tag.pitch_deg,
        height_m=tag.height_m,
    )


class FolderSource(RecordingSource):
    """Each image of a folder once, with the position of its line in positions.csv, else that of its EXIF data."""

    def __init__(
        self,
        folder: Path,
        positions: Path | None,
        clock: Callable[[], float],
        only: Collection[str] | None = None,
    ):
        super().__init__(only)
        paths = list_images(folder)
        self._paths = [path for path in paths if self.is_wanted(decoded_name(path.name))]
        self.total = len(self._paths)
        self._read = 0
        self._clock = clock
        csv_path = positions or find_positions(folder)
        self._tags = read_positions(csv_path) if csv_path else {}
        if positions and not any(decoded_name(path.name) in self._tags for path in paths):
            raise UsageError(f"{positions} names none of the images in {folder}: its column `file` must.")

    @property
    def ended(self) -> bool:
        return self._read == self.total

    def read(self, timeout_s: float) -> Frame | None:
        """Return the next image, None after the last. Raises ImageError for an image that cannot be used; the next call
        goes on with the image after it."""
        if self.ended:
            return None
        path = self._paths[self._read]
        self._read += 1
        try:
            image = read_image(path)
        except ImageError:
            self.refused[Refusal.DAMAGED.value] += 1
            raise
        name = decoded_name(path.name)  # a map and a positions.csv hold UTF-8 only
        tag = self._tags.get(name) or read_exif(path)
        return tagged(image, name, self._clock(), tag)

    def close(self) -> None:
        """Do nothing: no file is held open between images."""
