"""EXIF data that the camera wrote into an image file: position, heading, time."""

import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

from edgevpr.frames.positions import GeoTag, parse_time, position_or_none
from edgevpr.types import Position

T = TypeVar("T")


def read_exif(path: str | Path) -> GeoTag:
    """Read the tag of a JPEG, TIFF, PNG or WebP file. Never raises: a value that is absent, broken or senseless is
    None.

    The time is that of the GPS receiver, else that of the camera clock, taken as UTC where it has no time zone.
    """
    import exifread  # not at the top: most sources never need it

    logging.getLogger("exifread").setLevel(logging.CRITICAL)  # it would report every file without EXIF

    def tags() -> dict[str, Any]:
        with open(path, "rb") as handle:
            return exifread.process_file(handle, details=False)

    found = _known(tags) or {}
    return GeoTag(
        _known(lambda: _position(found)),
        _known(lambda: _heading_deg(found)),
        _known(lambda: _gps_time_s(found)) or _known(lambda: _camera_time_s(found)),
    )


def _known(read: Callable[[], T]) -> T | None:
    try:
        return read()
    except Exception:  # files of any origin: a tag may be absent, of another type or length, or divide by zero
        return None


def _position(tags: dict[str, Any]) -> Position | None:
    if "GPS GPSStatus" in tags and tags["GPS GPSStatus"].values == "V":  # void: the receiver has lost its fix
        return None
    lat_deg = _degrees(tags, "GPS GPSLatitude", {"N": 1, "S": -1}, 90)
    lon_deg = _degrees(tags, "GPS GPSLongitude", {"E": 1, "W": -1}, 180)
    return position_or_none(lat_deg, lon_deg, _known(lambda: _alt_m(tags)))


def _degrees(tags: dict[str, Any], name: str, signs: dict[str, int], limit: float) -> float:
    degrees, minutes, seconds = map(float, tags[name].values)
    value = degrees + minutes / 60 + seconds / 3600
    if not 0 <= value <= limit:
        raise ValueError(f"{name} is {value}")
    return signs[tags[f"{name}Ref"].values.strip()] * value


def _alt_m(tags: dict[str, Any]) -> float:
    # 0 is above and 1 below sea level; 2 and 3 (EXIF 3.0) are relative to the ellipsoid: not usable here.
    reference = tags["GPS GPSAltitudeRef"].values[0] if "GPS GPSAltitudeRef" in tags else 0
    return {0: 1, 1: -1}[reference] * float(tags["GPS GPSAltitude"].values[0])


def _heading_deg(tags: dict[str, Any]) -> float | None:
    if "GPS GPSImgDirectionRef" in tags and tags["GPS GPSImgDirectionRef"].values != "T":
        return None  # magnetic: off by the declination, which is unknown
    heading_deg = float(tags["GPS GPSImgDirection"].values[0])
    return heading_deg % 360 if 0 <= heading_deg <= 360 else None


def _gps_time_s(tags: dict[str, Any]) -> float:
    hours, minutes, seconds = map(float, tags["GPS GPSTimeStamp"].values)
    return parse_time(f"{tags['GPS GPSDate'].values} 00:00:00") + hours * 3600 + minutes * 60 + seconds


def _camera_time_s(tags: dict[str, Any]) -> float:
    zone = tags["EXIF OffsetTimeOriginal"].values if "EXIF OffsetTimeOriginal" in tags else ""
    return parse_time(f"{tags['EXIF DateTimeOriginal'].values}{zone}")
