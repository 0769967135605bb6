"""Makes folders of pictures from videos with positions, for data sets: each video is decoded once, and its pictures are
kept.

The positions of a video lie beside it, in a table of its name (later.csv of later.mp4). `frames.positions` explains its
columns. A side of a data set is its queries or its references.
"""

import tempfile
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from edgevpr.core.errors import EdgevprError, UsageError
from edgevpr.core.types import Frame
from edgevpr.frames.images import is_image, write_png
from edgevpr.frames.positions import MOST_GAP_S, GeoTag, read_positions, write_positions
from edgevpr.frames.source import Source, open_source
from edgevpr.lab.evaluate.asking import Progress
from edgevpr.lab.evaluate.provenance import key_of, stamp

# Of videos of a data set. A video that is given by its own path may have any ending.
_EXTENSIONS = frozenset(".mp4 .mov .mkv .avi .m4v .webm .ts .mts .m2ts .mpg .mpeg .mjpeg .h264".split())  # noqa: SIM905
_POSITIONS = "positions.csv"
_FORM = "time,lat,lon[,alt,yaw_deg,roll_deg,pitch_deg,height_m], `time` in seconds from its first frame"
_READ_TIMEOUT_S = 1.0


@dataclass(frozen=True, slots=True)
class VideoPictures:
    """Function object that turns a side of a data set, a folder or a video, into a folder of pictures. From a video
    `rate_hz` pictures a second are taken (None: every frame) and kept below `folder`; `progress` shows it."""

    folder: Path
    rate_hz: float | None
    progress: Progress[Any]

    def __call__(self, given: Path) -> Path:
        """Return `given` if it is a folder of pictures, and of a video the folder of its pictures. Raises UsageError
        for a video without positions, ImageError for a damaged one, SourceError for a file that is no video, and
        EdgevprError for a full disk."""
        video, table = given, given.with_suffix(".csv")
        if not video.is_file() or is_image(video.name):
            return given
        if not table.is_file():
            raise UsageError(f"{video} has no positions beside it: write {table.name} there ({_FORM}).")
        made = self.folder / key_of(video, stamp(video), stamp(table), self.rate_hz)
        if not made.is_dir():
            step_s = 1 / self.rate_hz if self.rate_hz else None
            source = open_source(str(video), step_s=step_s, positions=table, live=False)
            try:
                self.folder.mkdir(parents=True, exist_ok=True)
                with tempfile.TemporaryDirectory(prefix=".", dir=self.folder) as unfinished:
                    whole = Path(unfinished) / "made"
                    whole.mkdir()
                    frames = self.progress(_frames(source), source.total, f"{video.name}: pictures")
                    if not _written(frames, whole):
                        raise UsageError(
                            f"No frame of {video} lies between two lines of {table} that are at most {MOST_GAP_S:g} s "
                            "apart: write `time` in seconds from its first frame."
                        )
                    whole.rename(made)
            except OSError as error:
                raise EdgevprError(
                    f"{self.folder} takes no more pictures of {video} ({error.strerror}): make room, take fewer with "
                    "--rate-hz, or name another folder with --out."
                ) from error
            finally:
                source.close()
        return made


def _written(frames: Iterable[Frame], folder: Path) -> int:
    """Write each frame that has a position to `folder`, as a PNG, and a positions.csv with all frames. Returns the
    number of PNG files."""
    tags: dict[str, GeoTag] = {}
    for frame in frames:
        # Like frame_000006_t0.240_s.png: a space would separate names in a ground truth.
        name = frame.name.replace("=", "").replace(" ", "_") + ".png"
        tags[name] = GeoTag(
            position=frame.position,
            heading_deg=frame.heading_deg,
            roll_deg=frame.roll_deg,
            pitch_deg=frame.pitch_deg,
            height_m=frame.height_m,
        )
        if frame.position:
            write_png(folder / name, frame.image)
    write_positions(folder / _POSITIONS, tags)
    return sum(tag.position is not None for tag in tags.values())


def _frames(source: Source) -> Iterator[Frame]:
    while not source.ended:
        if frame := source.read(_READ_TIMEOUT_S):
            yield frame


def without_position(folder: Path) -> tuple[int, int]:
    """Return two counts of frames, by the positions.csv in the folder of a video's pictures: those without a position,
    which have no picture, and all frames."""
    tags = read_positions(folder / _POSITIONS)
    return sum(tag.position is None for tag in tags.values()), len(tags)


def side_of(folder: Path, name: str) -> Path | None:
    """Return the side `name` (query, ref) of the data set in `folder`: the folder or the video of that name; None if
    there is neither."""
    if (inner := folder / name).is_dir():
        return inner
    videos = sorted(path for path in folder.glob(f"{name}.*") if path.suffix.lower() in _EXTENSIONS)
    if len(videos) > 1:
        raise UsageError(f"{folder} holds {len(videos)} videos ({videos[0].name}, {videos[1].name}): keep one of them.")
    return videos[0] if videos else None
