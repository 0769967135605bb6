"""Videos with positions as folders of a data set: the frames are taken once, and kept as pictures.

The positions of a video lie beside it: a table of its name (later.csv of later.mp4), or positions.csv where it is the
only video of its folder. `frames.track` says what stands in it.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from edgevpr.core.errors import EdgevprError, UsageError
from edgevpr.core.files import sha256_of
from edgevpr.core.types import Frame
from edgevpr.frames.images import is_image, write_png
from edgevpr.frames.positions import MOST_GAP_S, GeoTag, read_positions, write_positions
from edgevpr.frames.source import Source, open_source
from edgevpr.lab.evaluate.asking import Progress
from edgevpr.lab.evaluate.cache import Cache, code_of_frames, key_of

# Of a folder that may hold other files as well; a video that is named itself may be called anything.
_EXTENSIONS = frozenset(".mp4 .mov .mkv .avi .m4v .webm .ts .mts .m2ts .mpg .mpeg .mjpeg .h264".split())  # noqa: SIM905
_POSITIONS = "positions.csv"
_FORM = "time,lat,lon[,alt,yaw_deg,roll_deg,pitch_deg,height_m], `time` in seconds from its first frame"
_READ_TIMEOUT_S = 1.0


@dataclass(frozen=True, slots=True)
class VideoPictures:
    """Finds the folder of pictures of a side of a data set. Those of a video are taken at `rate_hz` (None: every frame)
    and kept in `cache`; `progress` shows it."""

    cache: Cache
    rate_hz: float | None
    progress: Progress[Any]

    def __call__(self, given: Path) -> Path:
        """Return the folder of pictures of `given`, which is one, or a video, or a folder that holds one video and no
        picture. Raises UsageError for a video without positions, ImageError for one that is damaged, SourceError for
        one that is none, and EdgevprError for a full disk."""
        video = _video_of(given)
        if video is None:
            return given
        table = _positions_beside(video)
        key = key_of(code_of_frames(), sha256_of(video), sha256_of(table), self.rate_hz)
        return self.cache.keep("videos", key, partial(self._take, video, table))

    def _take(self, video: Path, table: Path, made: Path) -> None:
        """Write each frame that has a position as a picture without losses, and positions.csv of all frames."""
        source = open_source(str(video), step_s=1 / self.rate_hz if self.rate_hz else None, positions=table, live=False)
        tags: dict[str, GeoTag] = {}
        made.mkdir()
        try:
            for frame in self.progress(_frames(source), source.total, f"{video.name}: pictures"):
                name = _file_name(frame)
                tags[name] = GeoTag(
                    position=frame.position,
                    heading_deg=frame.heading_deg,
                    roll_deg=frame.roll_deg,
                    pitch_deg=frame.pitch_deg,
                    height_m=frame.height_m,
                )
                if frame.position:
                    write_png(made / name, frame.image)
            write_positions(made / _POSITIONS, tags)
        except OSError as error:
            raise EdgevprError(
                f"{self.cache.folder} takes no more pictures of {video} ({error.strerror}): make room, take fewer with "
                "--rate-hz, or name another folder with --out or --cache."
            ) from error
        finally:
            source.close()
        if not any(tag.position for tag in tags.values()):
            raise UsageError(
                f"No frame of {video} lies between two lines of {table} that are at most {MOST_GAP_S:g} s apart: write "
                "`time` in seconds from its first frame."
            )


def without_position(folder: Path) -> tuple[int, int]:
    """Return how many frames of a video had no position, and are no pictures in its folder, and how many it had."""
    tags = read_positions(folder / _POSITIONS)
    return sum(tag.position is None for tag in tags.values()), len(tags)


def side_of(folder: Path, name: str) -> Path | None:
    """Return the folder or the video of this name (query, ref) in the folder of a data set; None where there is
    none."""
    if (inner := folder / name).is_dir():
        return inner
    return _only([path for path in _videos_in(folder) if path.stem == name], folder)


def _video_of(given: Path) -> Path | None:
    if given.is_file():
        return None if is_image(given.name) else given
    if not given.is_dir() or any(is_image(path.name) for path in given.iterdir()):
        return None
    return _only(_videos_in(given), given)


def _only(videos: list[Path], folder: Path) -> Path | None:
    if len(videos) > 1:
        raise UsageError(f"{folder} holds {len(videos)} videos ({videos[0].name}, {videos[1].name}): keep one of them.")
    return videos[0] if videos else None


def _videos_in(folder: Path) -> list[Path]:
    found = (path for path in folder.iterdir() if path.suffix.lower() in _EXTENSIONS and path.name[0] != ".")
    return sorted(path for path in found if path.is_file())


def _positions_beside(video: Path) -> Path:
    own, common = video.with_suffix(".csv"), video.parent / _POSITIONS
    if own.is_file():
        return own
    if common.is_file() and _videos_in(video.parent) == [video]:
        return common
    raise UsageError(f"{video} has no positions beside it: write {own.name} there ({_FORM}).")


def _frames(source: Source) -> Iterator[Frame]:
    while not source.ended:
        if frame := source.read(_READ_TIMEOUT_S):
            yield frame


def _file_name(frame: Frame) -> str:
    """Return the name of the frame without what separates names in a ground truth: frame_000006_t0.240_s.png."""
    return frame.name.replace("=", "").replace(" ", "_") + ".png"
