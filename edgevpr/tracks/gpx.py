"""GPX files: tracks recorded by GPS receivers."""

from pathlib import Path

from edgevpr.core.errors import UsageError
from edgevpr.frames.positions import parse_time
from edgevpr.tracks.record import Record, make_tag, make_track, require_package

_FIRST_YEAR = 1990  # a receiver that does not know the time writes an earlier year


def read_gpx(path: Path) -> Record:
    """Read all track points of a GPX file that have a time; a time without a zone is UTC."""
    require_package("gpxpy", "A GPX file")
    import gpxpy
    from gpxpy.gpx import GPXException

    try:
        content = gpxpy.parse(path.read_bytes())
    except (OSError, GPXException, UnicodeDecodeError, ValueError) as error:
        raise UsageError(f"{path} cannot be read as GPX ({error}): export the track again.") from error
    points = [point for point, *_ in content.walk()]
    timed_points = [point for point in points if point.time and point.time.year >= _FIRST_YEAR]
    if points and not timed_points:
        raise UsageError(f"{path} has no times, which are needed to place pictures: export the track with times.")
    lines = [
        (parse_time(point.time.isoformat()), make_tag(point.latitude, point.longitude, point.elevation))
        for point in timed_points
    ]
    return Record(kind="GPX track", track=make_track(path, lines))
