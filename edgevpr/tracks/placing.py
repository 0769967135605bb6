"""Says where the pictures of a folder, or of a video, were taken, by a `Record`: by their names, in the order in which
the autopilot triggered them, or by time."""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path

import numpy as np

from edgevpr.core.arrays import Doubles
from edgevpr.core.errors import UsageError
from edgevpr.core.geodesy import EARTH_RADIUS_M
from edgevpr.core.text import progress
from edgevpr.frames.exif import read_exif
from edgevpr.frames.images import list_images
from edgevpr.frames.positions import GeoTag, Track
from edgevpr.frames.video import read_start_s
from edgevpr.tracks.clock import estimate_clock_offset_s
from edgevpr.tracks.record import Record

_ZONE_STEP_S = 900  # time zones differ by quarters of an hour
_MAX_ZONE_STEPS = 4 * 14  # and by 14 hours at most
_MAX_COMPARED = 200  # pictures that are compared to set the clock
_MIN_SHARE_IN_TRACK = 0.5  # of the pictures that must lie within the track
_ROUNDING_DEG = 1e-4  # as subtitles with four decimals


@dataclass(frozen=True, slots=True, kw_only=True)
class Placement:
    """`how`: in words, how pictures were told apart. `tags`: position and attitude of those of the `pictures` that were
    placed, by name; empty for a video. `track`: that of a video, by its own time. `offset_s`: seconds added to the
    clock of the camera (None: no clock was needed)."""

    how: str
    tags: Mapping[str, GeoTag] = field(default_factory=dict)
    pictures: int = 0
    track: Track | None = None
    offset_s: float | None = None


def place_pictures(record: Record, folder: Path, offset_s: float | None) -> Placement:
    """Place the pictures of a folder. `offset_s` is what is to be added to the clock of the camera (None: estimated).
    What the record does not say of a picture is taken from its EXIF data. Raises UsageError if they do not belong
    together."""
    paths = list_images(folder)
    own = {path.name: read_exif(path) for path in progress(paths, len(paths), "reading pictures")}
    if record.named:
        found, how = _match_names(record.named, list(own)), "by their names"
    elif len(record.shots) == len(own):
        found, how = dict(zip(own, record.shots, strict=True)), "in the order of the autopilot's pictures"
    elif record.track and record.is_utc:
        return _match_times(record.track, folder, own, offset_s)
    elif record.shots:
        raise UsageError(
            f"{len(record.shots)} images were triggered, and {folder} holds {len(own)}: remove the others from it."
        )
    else:
        raise UsageError(f"These positions ({record.kind}) are those of a video: give it as --images.")
    if not found:
        raise UsageError(f"No image of {folder} is named in the {record.kind}: give the folder of its images.")
    tags = {name: _fill_tag(tag, own[name]) for name, tag in found.items()}
    return Placement(how=how, tags=tags, pictures=len(own))


def _match_names(named: Mapping[str, GeoTag], names: list[str]) -> dict[str, GeoTag]:
    """Find the pictures by their whole names, or by what stands before the ending, in letters of either case."""
    whole = {name.casefold(): tag for name, tag in named.items()}
    stems = {Path(name).stem.casefold(): tag for name, tag in named.items()}
    tags = {name: whole.get(name.casefold(), stems.get(Path(name).stem.casefold())) for name in names}
    return {name: tag for name, tag in tags.items() if tag and tag.position}


def _match_times(track: Track, folder: Path, own: Mapping[str, GeoTag], offset_s: float | None) -> Placement:
    times = {name: tag.t_utc_s for name, tag in own.items() if tag.t_utc_s is not None}
    if not times:
        raise UsageError("The images have no times (EXIF DateTimeOriginal): give the original files of the camera.")
    how, times_s = "by time", np.array(list(times.values()))
    if offset_s is None:
        offset_s = _estimate_zone_offset_s(track, times_s, "the pictures")
        earliest = sorted(times, key=times.__getitem__)[:_MAX_COMPARED]
        paths = progress([folder / name for name in earliest], len(earliest), "comparing pictures")
        fine_s = estimate_clock_offset_s(track, [times[name] + offset_s for name in earliest], paths)
        offset_s += fine_s or 0.0
        how += ", the camera's clock set by " + ("its time zone" if fine_s is None else "how the pictures move")
    times = {name: t_s + offset_s for name, t_s in times.items()}
    found = {name: replace(track.interpolate_tag(t_s), t_utc_s=t_s) for name, t_s in times.items()}
    tags = {name: _fill_tag(tag, own[name]) for name, tag in found.items() if tag.position}
    if not tags:
        raise UsageError(f"No image lies in the track with --offset-s {offset_s:g}: {_format_spans(track, times_s)}")
    return Placement(how=how, tags=tags, pictures=len(own), offset_s=offset_s)


def _fill_tag(tag: GeoTag, own: GeoTag) -> GeoTag:
    """Return `tag`, with what it does not know taken from `own`."""
    missing = [item.name for item in fields(GeoTag) if getattr(tag, item.name) is None]
    return replace(tag, **{name: getattr(own, name) for name in missing})


def place_video(record: Record, video: Path, offset_s: float | None) -> Placement:
    """Place the frames of a video. `offset_s` is what is to be added to the clock of the camera (None: estimated), or
    to the time of the video if the record goes by it. Raises UsageError if they do not belong together."""
    if record.track is None:
        raise UsageError(f"These positions ({record.kind}) have no times: a video needs them.")
    began_s, lasts_s = read_start_s(video)
    if record.is_utc:
        if began_s is None:
            raise UsageError(f"{video} has no start time: give a flight log that covers the time of the video.")
        if offset_s is None:
            offset_s = _estimate_zone_offset_s(record.track, np.linspace(began_s, began_s + lasts_s, 60), str(video))
        shift_s, how = -began_s - offset_s, "by time"
    else:
        shift_s, how = -(offset_s or 0.0), "by the time of the video"
    track = replace(record.track, t_s=tuple((np.array(record.track.t_s) + shift_s).tolist()))
    if lasts_s:
        track.require_overlap(video, lasts_s)
    return Placement(how=how, track=track, offset_s=offset_s)


def _estimate_zone_offset_s(track: Track, times_s: Doubles, what: str) -> float:
    """Estimate what is to be added to the clock of a camera that shows a local time, so that most of its times, float
    (N,), lie within the track: whole hours, else half hours, else quarters."""
    offsets_s = np.arange(-_MAX_ZONE_STEPS, _MAX_ZONE_STEPS + 1) * _ZONE_STEP_S
    first_s, last_s = track.t_s[0], track.t_s[-1]
    within = np.array([np.mean((times_s + by_s >= first_s) & (times_s + by_s <= last_s)) for by_s in offsets_s])
    if within.max() < _MIN_SHARE_IN_TRACK:
        raise UsageError(f"No time zone brings {what} into the track: {_format_spans(track, times_s)}")
    fitting_s = offsets_s[within == within.max()].tolist()
    for unit_s in (4 * _ZONE_STEP_S, 2 * _ZONE_STEP_S, _ZONE_STEP_S):
        of_unit = sorted((offset_s for offset_s in fitting_s if offset_s % unit_s == 0), key=abs)
        if len(of_unit) > 1:
            choices = ", ".join(f"{offset_s:g}" for offset_s in of_unit[:4])
            raise UsageError(f"The camera's clock may be off by {choices} s: set one with --offset-s (0: it is right).")
        if of_unit:
            return float(of_unit[0])
    raise AssertionError("the smallest unit fits")


def _format_spans(track: Track, times_s: Doubles) -> str:
    """Return the time spans of camera and track as text."""
    ends_s = np.array([times_s.min(), times_s.max(), track.t_s[0], track.t_s[-1]])
    return "the camera says {} to {}, the track lasts from {} to {} (UTC): give --offset-s.".format(
        *ends_s.astype("datetime64[s]").astype(str)
    )


def find_rounding_m(placed: Placement) -> float | None:
    """Return to how many metres all positions are rounded, if it is much (None: not)."""
    tags = placed.track.tags if placed.track else placed.tags.values()
    parts = np.array([(tag.position.lat_deg, tag.position.lon_deg) for tag in tags if tag.position]) / _ROUNDING_DEG
    is_rounded = np.allclose(parts, np.round(parts), rtol=0, atol=1e-4)
    return float(np.radians(_ROUNDING_DEG)) * EARTH_RADIUS_M if is_rounded else None
