"""Recordings of an aircraft's path: autopilot logs, subtitles of drone videos, tracks, and tables of other programs."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path

from edgevpr.core.errors import UsageError
from edgevpr.frames.positions import ALT_LIMITS_M, GeoTag, Track, make_position

_MIN_INTERVAL_S = 1.0  # a track keeps one line per second while the position does not change
Attitude = tuple[float | None, float | None, float | None]  # heading, roll and pitch, degrees
_UNKNOWN: Attitude = (None, None, None)


@dataclass(frozen=True, slots=True, kw_only=True)
class Record:
    """Content of a recording.

    `kind`: type of recording, in words. `track`: position and attitude over time (None: no times). `is_utc`: the
    times of the track are seconds since 1970; otherwise seconds from the first frame of the video that it belongs to.
    `shots`: what the autopilot logged for each picture that it triggered, in order. `tags_by_name`: position and
    attitude by picture name, from a table that names pictures; by `FOLDER/NAME` where a name is used in several."""

    kind: str
    track: Track | None = None
    is_utc: bool = True
    shots: tuple[GeoTag, ...] = ()
    tags_by_name: Mapping[str, GeoTag] = field(default_factory=dict)


def read_record(path: Path) -> Record:
    """Read a recording. The extension determines its type: .bin, .log, .tlog, .ulg, .srt, .gpx or .jsonl; any other
    file is a table. Raises UsageError for a file that cannot be read or has no position."""
    from edgevpr.tracks import edgevpr_logs, gpx, logs, srt, tables

    if not path.is_file():
        raise UsageError(f"{path} does not exist: choose a log, a track, subtitles or a table.")
    readers: dict[str, Callable[[Path], Record]] = {
        ".bin": logs.read_ardupilot,
        ".log": logs.read_ardupilot,
        ".tlog": logs.read_telemetry,
        ".ulg": logs.read_px4,
        ".srt": srt.read_subtitles,
        ".gpx": gpx.read_gpx,
        ".jsonl": edgevpr_logs.read_flight,
    }
    record = readers.get(path.suffix.lower(), tables.read_table)(path)
    if not (record.track or record.shots or record.tags_by_name):
        raise UsageError(f"{path} ({record.kind}) has no position: did the receiver have a GPS fix?")
    return record


def make_tag(
    lat_deg: float | None,
    lon_deg: float | None,
    alt_m: float | None = None,
    attitude: Attitude | None = None,
    height_m: float | None = None,
) -> GeoTag:
    """Make a tag from recorded values. None, NaN and impossible values become unknown."""
    heading_deg, roll_deg, pitch_deg = attitude or _UNKNOWN
    low_m, high_m = ALT_LIMITS_M
    alt_m, height_m = (m if m is not None and low_m <= m <= high_m else None for m in (alt_m, height_m))
    position = None
    if lat_deg is not None and lon_deg is not None and abs(lat_deg) <= 90 and abs(lon_deg) <= 180:
        position = make_position(float(lat_deg), float(lon_deg), alt_m)
    heading_deg = None if heading_deg is None else heading_deg % 360
    return GeoTag(position=position, heading_deg=heading_deg, roll_deg=roll_deg, pitch_deg=pitch_deg, height_m=height_m)


def make_track(path: Path, lines: Iterable[tuple[float, GeoTag]]) -> Track | None:
    """Make a track from times and tags in any order; None if no tag has a position. Of lines that repeat a position, as
    subtitles do for each frame, one per second is kept, because positions between two lines are interpolated."""
    tags: dict[float, GeoTag] = {}
    previous_s, previous = float("-inf"), GeoTag()
    for t_s, tag in sorted(lines, key=lambda line: line[0]):
        if tag.position and (tag.position != previous.position or t_s - previous_s >= _MIN_INTERVAL_S):
            tags[t_s], previous_s, previous = tag, t_s, tag
    return Track(path, tuple(tags), tuple(tags.values())) if tags else None


def require_package(package: str, what: str) -> None:
    """Raise UsageError if the package that reads `what` is not installed."""
    if find_spec(package) is None:
        raise UsageError(f"{what} needs {package}, which is not installed: run `pip install {package}`.")
