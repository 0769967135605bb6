"""Tracks of GPS receivers: GPX files, and the telemetry that action cameras and drones write into their films."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from edgevpr.core.errors import UsageError
from edgevpr.frames.positions import GeoTag, parse_time
from edgevpr.tracks.record import Record, require, tag_of, track_of

_FIRST_YEAR = 1990  # receivers that have lost the time write others
_FIX, _FIX_2D = "0x47505346", 2  # GPSF of GoPro, and from which value on there is a fix


def read_gpx(path: Path) -> Record:
    """Read the points with a time of all tracks of a GPX file; a time without a zone is UTC."""
    require("gpxpy", "gpxpy", "A GPX file")
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
        (parse_time(point.time.isoformat()), tag_of(point.latitude, point.longitude, point.elevation))
        for point in timed
    ]
    return Record(kind="GPX track", track=track_of(path, lines))


def read_film(path: Path) -> Record:
    """Read the positions that a camera wrote into its film. Their times are those of the film."""
    require("telemetry_parser", "telemetry-parser", "The telemetry of a film")
    import telemetry_parser

    try:
        found = telemetry_parser.Parser(str(path))
        camera, telemetry = f"{found.camera} {found.model or ''}".strip(), found.telemetry()
    except Exception as error:  # files of any content
        raise UsageError(f"{path} has no telemetry that can be read ({error}): name a log or a track of it.") from error
    track = track_of(path, _lines(telemetry))
    return Record(kind=f"film of {camera}", track=track, is_utc=False)


def _lines(telemetry: list[dict[str, Any]]) -> Iterator[tuple[float, GeoTag]]:
    """Yield the time of each sample in the film, in seconds, and its position. Samples stand in blocks of about a
    second; each has the time of its first sample, or, of older cameras, none."""
    blocks = [
        (block["GPS"].get("TimestampUs", at * 1e6) / 1e6, block["GPS"])
        for at, block in enumerate(telemetry)
        if block.get("GPS", {}).get("Data") and block["GPS"].get(_FIX, _FIX_2D) >= _FIX_2D
    ]
    ends_s = [began_s for began_s, _ in blocks[1:]] + [began_s + 1 for began_s, _ in blocks[-1:]]
    for (began_s, block), end_s in zip(blocks, ends_s, strict=True):
        samples = np.array([sample[:3] for sample in block["Data"]], float) / np.array(block["Scale"][:3], float)
        lasts_s = min(end_s - began_s, 1.0)  # a fix may be lost between two blocks
        for at, (lat_deg, lon_deg, alt_m) in enumerate(samples.tolist()):
            yield began_s + at * lasts_s / len(samples), tag_of(lat_deg, lon_deg, alt_m)
