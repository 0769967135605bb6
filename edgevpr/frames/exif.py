"""Data that the camera wrote into an image file: position, heading and time from EXIF, attitude and height from XMP."""

import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

from edgevpr.core.types import Position
from edgevpr.frames.positions import ALT_M, GeoTag, parse_time, position_or_none
from edgevpr.frames.xmp import read_xmp

T = TypeVar("T")

_log = logging.getLogger(__name__)


class _Senseless(ValueError):
    """A value is there, and cannot be true."""


def read_exif(path: str | Path) -> GeoTag:
    """Read the tag of a JPEG, TIFF, PNG or WebP file. Never raises: a value that is absent, broken or senseless is
    None. What is senseless in EXIF (minutes of 99, a date of 1e308) is said in the log.

    The time is that of the GPS receiver, else that of the camera clock, taken as UTC where it has no time zone. The
    heading is that of the gimbal, which goes with its roll and pitch, else that of EXIF. For the height see `read_xmp`.
    """
    import exifread  # not at the top: most sources never need it

    logging.getLogger("exifread").setLevel(logging.CRITICAL)  # it would report every file without EXIF

    def tags() -> dict[str, Any]:
        with open(path, "rb") as handle:
            return exifread.process_file(handle, details=False)

    def known(read: Callable[[dict[str, Any]], T]) -> T | None:
        try:
            return _known(lambda: read(found))
        except _Senseless as error:
            _log.warning("%s: its EXIF says %s, which cannot be: it is taken as unknown.", path, error)
            return None

    found = _known(tags) or {}
    gps_time_s = known(_gps_time_s)
    shooting = read_xmp(path)
    return GeoTag(
        position=known(lambda tags: _position(tags, known(_alt_m))),
        heading_deg=known(_heading_deg) if shooting.heading_deg is None else shooting.heading_deg,
        t_utc_s=known(_camera_time_s) if gps_time_s is None else gps_time_s,
        roll_deg=shooting.roll_deg,
        pitch_deg=shooting.pitch_deg,
        height_m=shooting.height_m,
    )


def _known(read: Callable[[], T]) -> T | None:
    try:
        return read()
    except _Senseless:
        raise
    except Exception:  # files of any origin: a tag may be absent, of another type or length, or divide by zero
        return None


def _position(tags: dict[str, Any], alt_m: float | None) -> Position | None:
    if "GPS GPSStatus" in tags and tags["GPS GPSStatus"].values == "V":  # void: the receiver has lost its fix
        return None
    lat_deg = _degrees(tags, "GPS GPSLatitude", {"N": 1, "S": -1}, 90)
    lon_deg = _degrees(tags, "GPS GPSLongitude", {"E": 1, "W": -1}, 180)
    return position_or_none(lat_deg, lon_deg, alt_m)


def _degrees(tags: dict[str, Any], name: str, signs: dict[str, int], limit: float) -> float:
    degrees, minutes, seconds = map(float, tags[name].values)
    value = degrees + minutes / 60 + seconds / 3600
    # 60 itself is what rounding makes of 59.99999.
    if not (0 <= minutes <= 60 and 0 <= seconds <= 60 and degrees >= 0 and value <= limit):
        raise _Senseless(f"{name.removeprefix('GPS ')} {degrees:g} {minutes:g} {seconds:g}")
    return signs[tags[f"{name}Ref"].values.strip()] * value


def _alt_m(tags: dict[str, Any]) -> float:
    # 0 is above and 1 below sea level; 2 and 3 (EXIF 3.0) are relative to the ellipsoid: not usable here.
    reference = tags["GPS GPSAltitudeRef"].values[0] if "GPS GPSAltitudeRef" in tags else 0
    alt_m = {0: 1, 1: -1}[reference] * float(tags["GPS GPSAltitude"].values[0])
    if not ALT_M[0] <= alt_m <= ALT_M[1]:
        raise _Senseless(f"GPSAltitude {alt_m:g}")
    return alt_m


def _heading_deg(tags: dict[str, Any]) -> float | None:
    if "GPS GPSImgDirectionRef" in tags and tags["GPS GPSImgDirectionRef"].values != "T":
        return None  # magnetic: off by the declination, which is unknown
    heading_deg = float(tags["GPS GPSImgDirection"].values[0])
    return heading_deg % 360 if 0 <= heading_deg <= 360 else None


def _gps_time_s(tags: dict[str, Any]) -> float:
    hours, minutes, seconds = map(float, tags["GPS GPSTimeStamp"].values)
    if not (0 <= hours <= 24 and 0 <= minutes <= 60 and 0 <= seconds <= 61):
        raise _Senseless(f"GPSTimeStamp {hours:g} {minutes:g} {seconds:g}")
    return _time_s("GPSDate", f"{tags['GPS GPSDate'].values} 00:00:00") + hours * 3600 + minutes * 60 + seconds


def _camera_time_s(tags: dict[str, Any]) -> float:
    zone = tags["EXIF OffsetTimeOriginal"].values if "EXIF OffsetTimeOriginal" in tags else ""
    return _time_s("DateTimeOriginal", f"{tags['EXIF DateTimeOriginal'].values}{zone}")


def _time_s(name: str, text: str) -> float:
    if not text.strip("\0 :0"):  # the standard's way of writing "unknown", and that of a clock that was never set
        raise KeyError(name)
    if ":" not in text:  # seconds, which are no EXIF
        raise _Senseless(f"{name} {text[:40]!r}")
    try:
        return parse_time(text)
    except (ValueError, OverflowError) as error:
        raise _Senseless(f"{name} {text[:40]!r}") from error
