"""Sources of frames: a folder of images, a video file, a camera or a network stream. `open_source` opens any of them as
a `Source`. `RecordingSource` is the base class of sources that end; `FolderSource` reads a folder."""

import os
import re
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import suppress
from dataclasses import fields
from itertools import pairwise
from pathlib import Path

from edgevpr.core.arrays import Image
from edgevpr.core.config import SOURCE_HELP
from edgevpr.core.errors import EdgevprError, ImageError, SourceError, UsageError
from edgevpr.core.text import decode_name
from edgevpr.core.types import Frame
from edgevpr.frames.depth import DepthRange
from edgevpr.frames.exif import read_exif
from edgevpr.frames.images import EXTENSIONS, list_images, read_image
from edgevpr.frames.positions import GeoTag, find_positions, find_track, read_positions, read_track
from edgevpr.frames.shot import Capture, Condition, OpeningError, Refusal, StreamFacts
from edgevpr.frames.stereo import StereoCheck

_READ_TIMEOUT_S = 1.0
_SNAPSHOT_PERIOD_S = 0.5
_PROGRAM_PATTERN = re.compile(r"rpicam(:\d+)?|gst:.*", re.DOTALL)
# udp://:PORT: on all interfaces.
_ADDRESS_PATTERN = re.compile(r"(?i)(rtsps?|https?)://[^/].*|tcp://.+:\d+.*|(udp|rtp)://.*:\d+.*")
# A password with a character at which FFmpeg stops parsing it. A port is not mistaken for a password.
_UNESCAPED_PASSWORD = re.compile(r"\w+://(?!\[)[^\s/?#@:]*:(?!\d*([/?#]|$))[^@]*[\s/?#].*@.*", re.DOTALL)


class Source:
    """A source of frames.

    `is_live`: a camera or stream, from which only the newest image is read; a recording is read to its end. `ended`:
    there are no more frames. `total`: approximate number of frames, 0 if unknown.
    `dropped`: number of images not read in time; None for a recording.
    `refused`: number of rejected images by reason (values of `Refusal`).
    `latency_s`: seconds from the capture of the newest image until it could be read, or until now if none has arrived
    for a while; None if unknown.
    `condition`: see `Condition`. `state`: the condition in words for people ("reading", "lost, reopening in 2 s").
    `facts`: a stream's description of its images, None if unknown.
    `step_s`: seconds from the last image read to the next, if a recording is replayed at its original times.
    `stereo`: rejects stereo images, whose halves show the same scene."""

    is_live: bool
    ended: bool
    total: int
    dropped: int | None
    refused: dict[str, int]
    latency_s: float | None
    condition: Condition
    state: str
    facts: StreamFacts | None = None
    step_s: float | None = None
    stereo: StereoCheck

    def read(self, timeout_s: float) -> Frame | None:
        """Return the next frame (of a live source, the newest), or None if there is none within `timeout_s` seconds.
        Raises ImageError for an image that cannot be used; the next call continues with the one after it."""
        raise NotImplementedError

    def close(self) -> None:
        """Release the file, the device or the connection."""

    def end(self) -> None:
        """Mark the source as ended: there are no more frames."""
        self.ended, self.condition, self.state = True, Condition.ENDED, "ended"


class RecordingSource(Source):
    """Base class of folders and video files. Only frames whose names are in `only` are read (None: all)."""

    is_live, ended, condition, state = False, False, Condition.RUNNING, "reading"
    dropped = latency_s = None

    def __init__(self, only: Collection[str] | None = None) -> None:
        self.refused = {Refusal.DAMAGED.value: 0}
        self.stereo = StereoCheck()
        self._only = None if only is None else frozenset(only)

    def is_selected(self, name: str) -> bool:
        """Return True if the frame of this name should be read."""
        return self._only is None or name in self._only


def make_frame(image: Image, name: str, t_mono_s: float, tag: GeoTag) -> Frame:
    """Make a frame of `image`, uint8 (H, W[, 3]), with the position, attitude, height and time of `tag`."""
    values = {field.name: getattr(tag, field.name) for field in fields(tag)}
    return Frame(image=image, name=name, t_mono_s=t_mono_s, **values)


class FolderSource(RecordingSource):
    """Delivers each image of a folder once, in numeric order of the names (2 before 10). Position, attitude and time
    are from its line in the position table, else from its EXIF data. See `open_source` for the arguments."""

    def __init__(
        self,
        folder: Path,
        positions: Path | None,
        clock: Callable[[], float],
        only: Collection[str] | None = None,
        *,
        steps_s: Sequence[float] = (),
        upright: bool = True,
    ) -> None:
        super().__init__(only)
        self._steps_s, self._upright = iter(steps_s), upright
        paths = {decode_name(path.name): path for path in list_images(folder)}  # names in maps and tables are UTF-8
        self._tags = read_table(folder, positions)
        if positions and not self._tags.keys() & paths:
            raise UsageError(f"{positions} lists none of the images in {folder}: correct the column `file`.")
        self._unread = [(name, path) for name, path in paths.items() if self.is_selected(name)][::-1]
        self.total = len(self._unread)
        self._clock = clock
        self._depth = DepthRange()
        if not self._unread:
            self.end()

    def read(self, timeout_s: float) -> Frame | None:
        if self.ended:
            return None
        name, path = self._unread.pop()
        self.step_s = next(self._steps_s, None)
        if not self._unread:
            self.end()
        try:
            image = self.stereo.refuse_stereo(read_image(path, self._depth, upright=self._upright))
        except ImageError:
            self.refused[Refusal.DAMAGED.value] += 1
            raise
        return make_frame(image, name, self._clock(), self._tags.get(name) or read_exif(path))


def read_table(folder: Path, positions: Path | None) -> dict[str, GeoTag]:
    """Read the table of the positions of a folder of images; the tags, by file name, are empty if there is none."""
    csv_path = positions or find_positions(folder)
    return read_positions(csv_path) if csv_path else {}


def read_tags(folder: Path, positions: Path | None = None) -> dict[Path, GeoTag]:
    """Return the tags of a folder's images, by path, as `FolderSource` does. Raises UsageError."""
    tags = read_table(folder, positions)
    return {path: tags.get(decode_name(path.name)) or read_exif(path) for path in list_images(folder)}


def read_intervals(uri: str | None, positions: Path | None = None) -> list[float]:
    """Return the seconds from each image of a folder to the next, by their times in `positions` or EXIF data. Empty if
    `uri` is not a usable folder, an image has no time or is older than the one before it, or all times are equal."""
    times_s: list[float | None] = []
    if uri is not None and os.path.isdir(uri):
        with suppress(EdgevprError):
            times_s = [tag.t_utc_s for tag in read_tags(Path(uri), positions).values()]
    steps_s = [later - earlier for earlier, later in pairwise(times_s) if earlier is not None and later is not None]
    is_ordered = len(steps_s) == len(times_s) - 1 and min(steps_s, default=-1) >= 0
    return steps_s if is_ordered and any(steps_s) else []


def open_source(
    uri: str,
    *,
    step_s: float | None = None,
    positions: Path | None = None,
    live: bool,
    clock: Callable[[], float] = time.monotonic,
    only: Collection[str] | None = None,
    steps_s: Sequence[float] = (),
    upright: bool = True,
) -> Source:
    """Open the source at `uri`: a path, device or address.

    `step_s`: minimum video time in seconds between two frames of a video file (None: every frame); for the address of a
    single image, seconds between two requests (None: 0.5). `positions`: position table of a recording (None: for a
    folder, the positions.csv in or next to it, else EXIF data; for a video, the .csv of the same name next to it).
    `live`: allow cameras and streams, which never end. A missing one is opened once it appears. `clock`: the
    monotonic clock, seconds. `only`: names of the frames of a recording to read (None: all). `steps_s`: for a folder
    that is replayed at its original times, the result of `read_intervals`. `upright`: rotate single images
    by their EXIF data (see `read_image`); not for a camera that looks straight down, where it shows no direction.
    Raises SourceError for a source that is unknown, missing or not allowed, and UsageError for unusable positions."""
    path = Path(uri)
    if positions and is_live(uri):
        raise UsageError(f"{positions} is a position table for recordings, but {uri} is live: omit the table.")
    if os.path.isdir(uri):  # Path.is_dir raises OSError for a long pipeline
        return FolderSource(folder=path, positions=positions, clock=clock, only=only, steps_s=steps_s, upright=upright)
    if is_live(uri):
        if not live:
            raise SourceError(f"{uri} is live and never ends: use a folder of images or a video file instead.")
        from edgevpr.frames.live import LiveSource

        return LiveSource(_make_capture(uri, clock, step_s or _SNAPSHOT_PERIOD_S, upright), clock)
    if not path.is_file():
        raise SourceError(f"{uri} does not exist: choose {SOURCE_HELP}.")
    if path.name.lower().endswith(EXTENSIONS):
        raise SourceError(f"{uri} is a single image: use the folder that contains it.")
    from edgevpr.frames.video import VideoSource  # loads FFmpeg

    table = positions or find_track(path)
    return VideoSource(path, step_s or 0.0, clock, only, track=read_track(table) if table else None)


def read_to_end(source: Source, on_error: Callable[[ImageError], None] | None = None) -> Iterator[Frame | None]:
    """Yield all frames of a recording, and close it at the end. For an image that cannot be used, `on_error` is called
    with the error (None: the error is raised) and None is yielded. None is also yielded if reading the next frame takes
    longer than a second."""
    while not source.ended:
        try:
            yield source.read(_READ_TIMEOUT_S)
        except ImageError as error:
            if on_error is None:
                raise
            on_error(error)
            yield None
    source.close()


def is_live(uri: str | None) -> bool:
    """Return True if `uri` is a camera or a stream; anything else is a recording (None: there is no source)."""
    if uri is None:
        return False
    is_device = uri.startswith("/dev/") and not Path(uri).is_file()  # /dev/shm contains plain files
    return "://" in uri or is_device or uri.lower().endswith(".sdp") or is_program_uri(uri)


def is_program_uri(uri: str) -> bool:
    """Return True if `uri` is a camera that a system program reads, see `frames.programs`."""
    return bool(_PROGRAM_PATTERN.fullmatch(uri))


def find_missing_cause(uri: str) -> str | None:
    """Return in a few words why the device or .sdp file `uri` cannot be read; None if it can be read or is neither."""
    if "://" in uri or is_program_uri(uri):
        return None
    if not Path(uri).exists():
        return f"{uri} does not exist"
    if not os.access(uri, os.R_OK):
        return f"this user may not read {uri}: add the user to the group that owns it, often `video`"
    return None


def _make_capture(uri: str, clock: Callable[[], float], period_s: float, upright: bool) -> Callable[[], Capture]:
    """Return a function that opens the camera or stream `uri`. `period_s`: seconds between requests, if each image
    must be requested. Raises SourceError if opening can never succeed; a missing device or file may appear later."""
    if is_program_uri(uri):
        from edgevpr.frames.programs import open_program, require_program  # loads FFmpeg

        require_program(uri)
        return lambda: open_program(uri, clock)
    if "://" in uri and _UNESCAPED_PASSWORD.fullmatch(uri):
        raise SourceError(
            "The password in the address of the source must be percent-encoded: use %2F for /, %23 for #, %3F "
            "for ?, %40 for @, %25 for % and %20 for a space."
        )
    if "://" in uri and not _ADDRESS_PATTERN.fullmatch(uri):
        raise SourceError(
            f"{uri} is not the address of a stream, such as rtsp://HOST/PATH or udp://HOST:PORT: use {SOURCE_HELP}."
        )

    def open_capture() -> Capture:
        if cause := find_missing_cause(uri):
            raise OpeningError(cause)
        if uri.startswith("/dev/"):
            from edgevpr.frames.devices import open_device

            return open_device(uri, clock)
        from edgevpr.frames.streams import open_address  # loads FFmpeg

        return open_address(uri, clock, period_s, upright)

    return open_capture
