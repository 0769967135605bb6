"""Tracks of GPS receivers: GPX files."""

from pathlib import Path

from edgevpr.core.errors import UsageError
from edgevpr.frames.positions import parse_time
from edgevpr.tracks.record import Record, make_tag, make_track, require_package

_FIRST_YEAR = 1990  # receivers that have lost the time write others


def read_gpx(path: Path) -> Record:
    """Read the points with a time of all tracks of a GPX file; a time without a zone is UTC."""
    require_package("gpxpy", "gpxpy", "A GPX file")
    import gpxpy
    from gpxpy.gpx import GPXException

    try:
        found = gpxpy.parse(path.read_bytes())
    except (OSError, GPXException, UnicodeDecodeError, ValueError) as error:
        raise UsageError(f"{path} is no GPX file that can be read ({error}): export it again.") from error
    points = [point for point, *_ in found.walk()]
    timed = [point for point in points if point.time and point.time.year >= _FIRST_YEAR]
    if points and not timed:
        raise UsageError(f"{path} has no times: export the track with them, for pictures are placed by time.")
    lines = [
        (parse_time(point.time.isoformat()), make_tag(point.latitude, point.longitude, point.elevation))
        for point in timed
    ]
    return Record(kind="GPX track", track=make_track(path, lines))
