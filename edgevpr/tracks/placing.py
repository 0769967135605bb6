"""Assigns positions from a `Record` to pictures of a folder or video: by name, in the order of triggers, or by time."""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path, PurePosixPath

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
from edgevpr.tracks.triggers import ZONE_STEP_S, match_triggers

_MAX_ZONE_STEPS = 4 * 14  # UTC offsets are at most 14 hours
_MAX_COMPARED = 200  # pictures compared to estimate the clock offset
_MIN_RELATIVE_FRACTION = 0.9  # of another zone: images taken before the logger started do not show a zone
_MIN_FRACTION_IN_TRACK = 0.5  # minimum fraction of the pictures that must lie within the track
_ROUNDING_DEG = 1e-4  # as in subtitles with four decimals


@dataclass(frozen=True, slots=True, kw_only=True)
class Placement:
    """The positions assigned to pictures. `how`: how they were assigned, in words. `pictures`: number of pictures in
    the folder. `tags`: position and attitude of each placed picture by name; empty for a video. `track`: track of a
    video, in video time. `offset_s`: seconds added to the camera's clock (None: no clock was needed)."""

    how: str
    tags: Mapping[str, GeoTag] = field(default_factory=dict)
    pictures: int = 0
    track: Track | None = None
    offset_s: float | None = None


def place_pictures(record: Record, folder: Path, offset_s: float | None) -> Placement:
    """Place the pictures of a folder. `offset_s`: seconds to add to the camera's clock (None: estimate). Values that
    the record lacks are taken from the EXIF data. Raises UsageError if pictures and record do not belong together."""
    paths = list_images(folder)
    exif_tags = {path.name: read_exif(path) for path in progress(paths, len(paths), "reading pictures")}
    if record.tags_by_name:
        tags, how = _match_names(record.tags_by_name, list(exif_tags), folder.absolute().name), "by name"
    elif record.shots and offset_s is None and (matched := match_triggers(record.shots, exif_tags)):
        tags, how = matched
    elif record.track and record.is_utc:
        return _match_times(record.track, folder, exif_tags, offset_s)
    elif record.shots:
        raise UsageError(
            f"{len(record.shots)} camera triggers do not fit the {len(exif_tags)} images in {folder}: keep only those "
            "that were triggered."
        )
    else:
        raise UsageError(f"These positions ({record.kind}) belong to a video: pass that video as --images.")
    if not tags:
        raise UsageError(f"The {record.kind} lists none of the images in {folder}: pass the folder of its images.")
    tags = {name: _fill_tag(tag, exif_tags[name]) for name, tag in tags.items()}
    return Placement(how=how, tags=tags, pictures=len(exif_tags))


def _match_names(tags: Mapping[str, GeoTag], names: list[str], folder: str) -> dict[str, GeoTag]:
    """Match the pictures of a folder by their name, `FOLDER/NAME`, or these without extension, ignoring case."""
    tags_by_name = {name.casefold(): tag for name, tag in tags.items()}
    tags_by_stem = {str(PurePosixPath(name).with_suffix("")): tag for name, tag in tags_by_name.items()}
    matches = {}
    for name in names:
        choices = f"{folder}/{name}".casefold(), name.casefold()
        stems = (str(PurePosixPath(choice).with_suffix("")) for choice in choices)
        found = (*map(tags_by_name.get, choices), *map(tags_by_stem.get, stems))
        matches[name] = next(filter(None, found), None)
    return {name: tag for name, tag in matches.items() if tag and tag.position}


def _match_times(track: Track, folder: Path, exif_tags: Mapping[str, GeoTag], offset_s: float | None) -> Placement:
    times = {name: tag.t_utc_s for name, tag in exif_tags.items() if tag.t_utc_s is not None}
    if not times:
        raise UsageError("The images have no times (EXIF DateTimeOriginal): use the camera's original files.")
    how, times_s = "by time", np.array(list(times.values()))
    if offset_s is None:
        offset_s = _estimate_zone_offset_s(track, times_s, "the pictures")
        earliest = sorted(times, key=times.__getitem__)[:_MAX_COMPARED]
        paths = progress([folder / name for name in earliest], len(earliest), "comparing pictures")
        fine_s = estimate_clock_offset_s(track, [times[name] + offset_s for name in earliest], paths)
        offset_s += fine_s or 0.0
        how += ", camera clock corrected by " + ("time zone" if fine_s is None else "the motion between pictures")
    times = {name: t_s + offset_s for name, t_s in times.items()}
    interpolated = {name: replace(track.interpolate_tag(t_s), t_utc_s=t_s) for name, t_s in times.items()}
    tags = {name: _fill_tag(tag, exif_tags[name]) for name, tag in interpolated.items() if tag.position}
    if not tags:
        raise UsageError(f"With --offset-s {offset_s:g}, no image is within the track: {_format_spans(track, times_s)}")
    return Placement(how=how, tags=tags, pictures=len(exif_tags), offset_s=offset_s)


def _fill_tag(tag: GeoTag, fallback: GeoTag) -> GeoTag:
    """Return `tag` with its unknown values taken from `fallback`."""
    missing = [item.name for item in fields(GeoTag) if getattr(tag, item.name) is None]
    return replace(tag, **{name: getattr(fallback, name) for name in missing})


def place_video(record: Record, video: Path, offset_s: float | None) -> Placement:
    """Place the frames of a video. `offset_s`: seconds to add to the camera's clock (None: estimate), or to the video
    time if the record is in video time. Raises UsageError if video and record do not belong together."""
    if record.track is None:
        raise UsageError(f"These positions ({record.kind}) have no times, but a video needs them: use a log or track.")
    start_s, duration_s = read_start_s(video)
    if record.is_utc:
        if start_s is None:
            raise UsageError(f"{video} has no start time: use its subtitles, which have video times.")
        if offset_s is None:
            offset_s = _estimate_zone_offset_s(record.track, np.linspace(start_s, start_s + duration_s, 60), str(video))
        shift_s, how = -start_s - offset_s, "by time"
    else:
        shift_s, how = -(offset_s or 0.0), "by video time"
    track = replace(record.track, t_s=tuple((np.array(record.track.t_s) + shift_s).tolist()))
    if duration_s:
        track.require_overlap(video, duration_s)
    return Placement(how=how, track=track, offset_s=offset_s)


def _estimate_zone_offset_s(track: Track, times_s: Doubles, label: str) -> float:
    """Estimate the time-zone offset to add to a camera clock so that most of its times, float (N,), fall within the
    track: in whole hours, else half hours, else quarter hours."""
    offsets_s = np.arange(-_MAX_ZONE_STEPS, _MAX_ZONE_STEPS + 1) * ZONE_STEP_S
    first_s, last_s = track.t_s[0], track.t_s[-1]
    shifted_s = times_s + offsets_s[:, None]
    fractions = ((shifted_s >= first_s) & (shifted_s <= last_s)).mean(axis=1)
    if fractions.max() < _MIN_FRACTION_IN_TRACK:
        raise UsageError(f"The track does not cover {label} in any time zone: {_format_spans(track, times_s)}")
    best_s = offsets_s[fractions >= _MIN_RELATIVE_FRACTION * fractions.max()].tolist()
    units_s = (4 * ZONE_STEP_S, 2 * ZONE_STEP_S, ZONE_STEP_S)
    candidates_s = next(filter(None, ([value_s for value_s in best_s if value_s % unit_s == 0] for unit_s in units_s)))
    if len(candidates_s) > 1:
        choices = ", ".join(f"{offset_s:g}" for offset_s in sorted(candidates_s, key=abs)[:4])
        raise UsageError(f"The camera's clock may be off by {choices} s: pass one as --offset-s (0 if right).")
    return float(candidates_s[0])


def _format_spans(track: Track, times_s: Doubles) -> str:
    """Return the time spans of camera and track as text, with advice."""
    ends_s = np.array([times_s.min(), times_s.max(), track.t_s[0], track.t_s[-1]])
    return "the camera's clock ran from {} to {}, the track is from {} to {} (UTC): pass --offset-s.".format(
        *ends_s.astype("datetime64[s]").astype(str)
    )


def find_rounding_m(placement: Placement) -> float | None:
    """Return the rounding step of all positions in metres if it is coarse, otherwise None."""
    tags = placement.track.tags if placement.track else placement.tags.values()
    steps = np.array([(tag.position.lat_deg, tag.position.lon_deg) for tag in tags if tag.position]) / _ROUNDING_DEG
    is_rounded = np.allclose(steps, np.round(steps), rtol=0, atol=1e-4)
    return float(np.radians(_ROUNDING_DEG)) * EARTH_RADIUS_M if is_rounded else None
