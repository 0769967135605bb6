"""Reads the subtitles (.srt) that DJI drones write for a video: position, height and gimbal angles of each frame or
second, in formats that depend on the model. Times are video times, so no clock is involved."""

import re
from collections.abc import Iterator
from pathlib import Path

from edgevpr.core.errors import UsageError
from edgevpr.core.files import read_file
from edgevpr.frames.exif import to_nadir_angles
from edgevpr.frames.positions import GeoTag
from edgevpr.tracks.record import Attitude, Record, make_tag, make_track

_MAX_FILE_BYTES = 200_000_000  # an hour at 60 frames a second
_START_TIME = re.compile(r"(\d+):(\d\d):(\d\d)[,.](\d{1,3})\s*-->")
_NUMBER = r"([-+]?\d+(?:\.\d+)?)"
# `[latitude: 50.1]`, `[longtitude : 8.5]` (misspelt by some), `[rel_alt: 1.2 abs_alt: 230.4]`, `[gb_yaw: 12.0 ...]`.
_NAMED_VALUE = re.compile(
    rf"\b(lat|latitude|lon|longitude|longtitude|altitude|rel_alt|abs_alt|gb_\w+|drone_yaw|Yaw)\s*:\s*{_NUMBER}"
)
_GPS = re.compile(rf"\bGPS\s*\(\s*{_NUMBER}\s*,\s*{_NUMBER}\s*,\s*{_NUMBER}(M?)\s*\)")
_GIMBAL = re.compile(rf"\bG\.PRY\s*\(\s*{_NUMBER}\D?,\s*{_NUMBER}\D?,\s*{_NUMBER}")  # pitch, roll, yaw
_HEIGHT = re.compile(rf"(?:\b(?:BAROMETER|Hb)\s*:\s*|\bH\s+){_NUMBER}\s*m?\b", re.IGNORECASE)


def read_subtitles(path: Path) -> Record:
    """Read the subtitles of a video. Raises UsageError for a file that cannot be read."""
    try:
        text = read_file(path, _MAX_FILE_BYTES).decode("utf-8-sig", errors="replace")
    except OSError as error:
        raise UsageError(f"{path} cannot be read ({error.strerror}): pass the .SRT file of the video.") from error
    return Record(kind="subtitles of a video", track=make_track(path, _read_blocks(text)), is_utc=False)


def _read_blocks(text: str) -> Iterator[tuple[float, GeoTag]]:
    """Yield the video time of each subtitle, in seconds, and its tag."""
    starts = list(_START_TIME.finditer(text))
    ends = [start.start() for start in starts[1:]] + [len(text)]
    for start, end in zip(starts, ends, strict=False):  # if the file is empty, `ends` has one element too many
        hours, minutes, seconds, fraction = start.groups()
        t_s = 3600 * int(hours) + 60 * int(minutes) + int(seconds) + float(f"0.{fraction}")
        yield t_s, _parse_block(text[start.end() : end])


def _parse_block(block: str) -> GeoTag:
    values = {name.lower(): float(number) for name, number in _NAMED_VALUE.findall(block)}
    lat_deg, height_m = values.get("lat", values.get("latitude")), values.get("rel_alt")
    lon_deg = values.get("lon", values.get("longitude", values.get("longtitude")))
    if gps := _GPS.search(block):
        lon_deg, lat_deg = float(gps[1]), float(gps[2])  # the third is an altitude, or the number of satellites
        if gps[4] or abs(lat_deg) > 90:  # formats with the altitude in M have the latitude first
            lon_deg, lat_deg = lat_deg, lon_deg
    if height_m is None and (height := _HEIGHT.search(block)):
        height_m = float(height[1])
    attitude: Attitude = (values.get("drone_yaw", values.get("yaw")), None, None)
    gimbal = [values[name] for name in ("gb_pitch", "gb_roll", "gb_yaw") if name in values]
    if match := _GIMBAL.search(block):
        gimbal = list(map(float, match.groups()))
    if len(gimbal) == 3 and any(gimbal):
        pitch, roll, yaw = gimbal
        attitude = to_nadir_angles(yaw, pitch, roll)
    return make_tag(lat_deg, lon_deg, values.get("abs_alt", values.get("altitude")), attitude, height_m)
