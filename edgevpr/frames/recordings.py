"""`FolderSource`, a folder of images that is read in order to its end, and `RecordingSource`, the base class of all
sources that end: folders, video files and orthophotos."""

from collections.abc import Callable, Collection
from dataclasses import fields
from pathlib import Path

from edgevpr.core.arrays import Image
from edgevpr.core.errors import ImageError, UsageError
from edgevpr.core.text import decoded_name
from edgevpr.core.types import Frame
from edgevpr.frames.exif import read_exif
from edgevpr.frames.images import list_images, read_image
from edgevpr.frames.positions import GeoTag, find_positions, read_positions
from edgevpr.frames.shot import Condition, Refusal


class RecordingSource:
    """Base class of sources that end, see `Source`. Only frames whose names are in `only` are read (None: all)."""

    is_live, ended, condition, state = False, False, Condition.RUNNING, "reading"
    dropped: int | None = None
    latency_s: float | None = None

    def __init__(self, only: Collection[str] | None = None) -> None:
        self.refused = {Refusal.DAMAGED.value: 0}
        self._only = None if only is None else frozenset(only)

    def is_wanted(self, name: str) -> bool:
        """Return True if the frame of this name is to be read."""
        return self._only is None or name in self._only

    def end(self) -> None:
        """Say from now on that no more frames will come."""
        self.ended, self.condition, self.state = True, Condition.ENDED, "ended"

    def close(self) -> None:
        """Do nothing: no file is held open between images."""


def tagged(image: Image, name: str, t_mono_s: float, tag: GeoTag) -> Frame:
    """Make a frame of `image`, uint8 (H, W[, 3]), with the position, attitude, height and time of `tag`."""
    known = {field.name: getattr(tag, field.name) for field in fields(tag)}
    return Frame(image=image, name=name, t_mono_s=t_mono_s, **known)


class FolderSource(RecordingSource):
    """Gives each image of a folder once, in counting order of the names, with the data of its line in the table
    `positions` (None: positions.csv in or beside the folder), or if it has no line, with its EXIF data."""

    def __init__(
        self, folder: Path, positions: Path | None, clock: Callable[[], float], only: Collection[str] | None = None
    ) -> None:
        super().__init__(only)
        paths = {decoded_name(path.name): path for path in list_images(folder)}  # names in maps and tables are UTF-8
        csv_path = positions or find_positions(folder)
        self._tags = read_positions(csv_path) if csv_path else {}
        if positions and not self._tags.keys() & paths:
            raise UsageError(f"{positions} names none of the images in {folder}: its column `file` must.")
        self._unread = [(name, path) for name, path in paths.items() if self.is_wanted(name)][::-1]
        self.total = len(self._unread)
        self._clock = clock
        if not self._unread:
            self.end()

    def read(self, timeout_s: float) -> Frame | None:
        """Return the next image, None after the last. Raises ImageError for an image that cannot be used; the next call
        continues with the image after it."""
        if self.ended:
            return None
        name, path = self._unread.pop()
        if not self._unread:
            self.end()
        try:
            image = read_image(path)
        except ImageError:
            self.refused[Refusal.DAMAGED.value] += 1
            raise
        return tagged(image, name, self._clock(), self._tags.get(name) or read_exif(path))
