"""Data that the camera wrote into an image file: position, heading and time from EXIF, attitude and height from XMP.
Used for the images of a folder without a positions.csv. An attitude is roll and pitch."""

import logging
import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar
from xml.etree import ElementTree

from edgevpr.core.types import Position
from edgevpr.frames.positions import ALT_M, GeoTag, parse_time, position_or_none

T = TypeVar("T")
Tags = Mapping[str, Any]  # values of exifread by their names, such as "GPS GPSLatitude"

_HEAD_BYTES = 300_000  # in a JPEG the XMP stands before the picture, behind EXIF data of 64 KB at most
_MOST_XMP_BYTES = 65_536  # largest segment of a JPEG
_BEGIN, _END = b"<x:xmpmeta", b"</x:xmpmeta>"
_DJI, _PARROT = "{http://www.dji.com/drone-dji/1.0/}", "{http://www.parrot.com/drone-parrot/1.0/}"
_PIX4D = ("{http://pix4d.com/camera/1.0/}", "{http://pix4d.com/camera/1.0}")

_log = logging.getLogger(__name__)


class _Senseless(ValueError):
    """A value is present in the file but impossible, such as a latitude of 99 degrees."""


def read_exif(path: str | Path) -> GeoTag:
    """Read the EXIF and XMP data of a JPEG, TIFF, PNG or WebP file. Never raises: a value that is absent, damaged or
    impossible is None. Impossible EXIF values (minutes of 99, a date of 1e308) are reported in the log.

    The time is that of the GPS receiver, else that of the camera clock, taken as UTC if it has no time zone. The
    heading is that of the gimbal, with its roll and pitch, else that of EXIF. For the height see `read_xmp`.
    """
    tags = _exif_of(path)

    def known(read: Callable[[Tags], T]) -> T | None:
        try:
            return read(tags)
        except _Senseless as error:
            _log.warning("%s: its EXIF says %s, which cannot be: it is taken as unknown.", path, error)
        except Exception:  # files of any origin: a tag may be absent, of another type or length, or divide by zero
            pass
        return None

    gps_time_s = known(_gps_time_s)
    xmp = read_xmp(path)
    return replace(
        xmp,
        position=known(lambda tags: _position(tags, known(_alt_m))),
        heading_deg=known(_heading_deg) if xmp.heading_deg is None else xmp.heading_deg,
        t_utc_s=known(_camera_time_s) if gps_time_s is None else gps_time_s,
    )


def _exif_of(path: str | Path) -> Tags:
    import exifread  # not at the top: most sources never need it

    logging.getLogger("exifread").setLevel(logging.CRITICAL)  # it would report every file without EXIF
    try:
        with open(path, "rb") as handle:
            tags: Tags = exifread.process_file(handle, details=False)
            return tags
    except Exception:  # files of any origin
        return {}


def _position(tags: Tags, alt_m: float | None) -> Position | None:
    if "GPS GPSStatus" in tags and tags["GPS GPSStatus"].values == "V":  # void: the receiver has lost its fix
        return None
    lat_deg = _degrees(tags, "GPS GPSLatitude", {"N": 1, "S": -1}, 90)
    lon_deg = _degrees(tags, "GPS GPSLongitude", {"E": 1, "W": -1}, 180)
    return position_or_none(lat_deg, lon_deg, alt_m)


def _degrees(tags: Tags, name: str, signs: dict[str, int], limit: float) -> float:
    degrees, minutes, seconds = map(float, tags[name].values)
    value = degrees + minutes / 60 + seconds / 3600
    # 60 is allowed: 59.99999 may have been rounded to it.
    if not (0 <= minutes <= 60 and 0 <= seconds <= 60 and degrees >= 0 and value <= limit):
        raise _Senseless(f"{name.removeprefix('GPS ')} {degrees:g} {minutes:g} {seconds:g}")
    return signs[tags[f"{name}Ref"].values.strip()] * value


def _alt_m(tags: Tags) -> float:
    # 0 is above and 1 below sea level; 2 and 3 (EXIF 3.0) are relative to the ellipsoid: not usable here.
    reference = tags["GPS GPSAltitudeRef"].values[0] if "GPS GPSAltitudeRef" in tags else 0
    alt_m = {0: 1, 1: -1}[reference] * float(tags["GPS GPSAltitude"].values[0])
    if not ALT_M[0] <= alt_m <= ALT_M[1]:
        raise _Senseless(f"GPSAltitude {alt_m:g}")
    return alt_m


def _heading_deg(tags: Tags) -> float | None:
    if "GPS GPSImgDirectionRef" in tags and tags["GPS GPSImgDirectionRef"].values != "T":
        return None  # magnetic: off by the declination, which is unknown
    heading_deg = float(tags["GPS GPSImgDirection"].values[0])
    return heading_deg % 360 if 0 <= heading_deg <= 360 else None


def _gps_time_s(tags: Tags) -> float:
    hours, minutes, seconds = map(float, tags["GPS GPSTimeStamp"].values)
    if not (0 <= hours <= 24 and 0 <= minutes <= 60 and 0 <= seconds <= 61):
        raise _Senseless(f"GPSTimeStamp {hours:g} {minutes:g} {seconds:g}")
    return _time_s("GPSDate", f"{tags['GPS GPSDate'].values} 00:00:00") + hours * 3600 + minutes * 60 + seconds


def _camera_time_s(tags: Tags) -> float:
    zone = tags["EXIF OffsetTimeOriginal"].values if "EXIF OffsetTimeOriginal" in tags else ""
    return _time_s("DateTimeOriginal", f"{tags['EXIF DateTimeOriginal'].values}{zone}")


def _time_s(name: str, text: str) -> float:
    if not text.strip("\0 :0"):  # the standard's way of writing "unknown", and that of a clock that was never set
        raise KeyError(name)
    try:
        if ":" in text:  # without a colon it would be seconds, which EXIF does not have
            return parse_time(text)
    except (ValueError, OverflowError):
        pass
    raise _Senseless(f"{name} {text[:40]!r}")


def read_xmp(path: str | Path) -> GeoTag:
    """Read the XMP tags of DJI, Parrot and Pix4D from the first 300 KB of a file. Never raises: a value that is absent,
    damaged or impossible is None.

    The heading is that of the top of the picture, or if unknown that of the aircraft. Roll and pitch are the deviation
    of the camera from straight down. The height is over the take-off point, and above the ground only if that is level.
    """
    try:
        with open(path, "rb") as handle:
            values = _xmp_of(handle.read(_HEAD_BYTES))
    except (OSError, ElementTree.ParseError, ValueError, MemoryError, RecursionError):  # files of any origin
        return GeoTag()
    height_m = _number(values, f"{_DJI}RelativeAltitude", *ALT_M)
    for maker in (f"{_DJI}Gimbal", f"{_PARROT}Camera"):
        if angles := _yaw_pitch_roll(values, maker, "Degree"):
            heading_deg, roll_deg, pitch_deg = _from_straight_down(*angles)
            return GeoTag(heading_deg=heading_deg, roll_deg=roll_deg, pitch_deg=pitch_deg, height_m=height_m)
    for maker in _PIX4D:  # in these tags 0 is straight down; a camera without an IMU writes zeros, which are ignored
        if (angles := _yaw_pitch_roll(values, maker, "")) and any(angles):
            yaw_deg, pitch_deg, roll_deg = angles
            return GeoTag(heading_deg=yaw_deg % 360, roll_deg=roll_deg, pitch_deg=pitch_deg, height_m=height_m)
    nose_deg = _number(values, f"{_DJI}FlightYawDegree")
    return GeoTag(heading_deg=None if nose_deg is None else nose_deg % 360, height_m=height_m)


def _xmp_of(head: bytes) -> dict[str, str]:
    """Return the texts of the attributes and elements of the first XMP packet in `head`, by qualified name; {} if there
    is none.

    Only the outermost element is parsed. A document type, which could declare harmful entities, can only stand before
    that element, and so is never parsed.
    """
    start = head.find(_BEGIN)
    end = head.find(_END, start)
    if start < 0 or not 0 < end - start <= _MOST_XMP_BYTES:
        return {}
    values: dict[str, str] = {}
    for element in ElementTree.fromstring(head[start : end + len(_END)]).iter():
        values.update(element.attrib)
        if element.text and element.text.strip():
            values[element.tag] = element.text
    return values


def _yaw_pitch_roll(values: dict[str, str], before: str, behind: str) -> tuple[float, float, float] | None:
    yaw, pitch, roll = (_number(values, f"{before}{axis}{behind}") for axis in ("Yaw", "Pitch", "Roll"))
    return None if yaw is None or pitch is None or roll is None else (yaw, pitch, roll)


def _number(values: dict[str, str], name: str, low: float = -360.0, high: float = 360.0) -> float | None:
    try:
        value = float(values[name])
    except (KeyError, ValueError):
        return None
    return value if low <= value <= high else None


def _from_straight_down(yaw_deg: float, pitch_deg: float, roll_deg: float) -> tuple[float, float, float]:
    """Convert a gimbal's angles, whose pitch is -90 when it looks straight down, to (heading, roll, pitch) in degrees,
    with roll and pitch 0 when it looks straight down.

    The result is the attitude of an imaginary airframe whose nose points along the top of the picture, and whose down
    is the camera's viewing direction. Looking straight down, the gimbal's roll only turns the picture: a gimbal may
    report half a turn in yaw as half a turn in roll.
    """
    yaw, pitch, roll = map(math.radians, (yaw_deg, pitch_deg, roll_deg))
    # The nose before the yaw is applied. Adding or subtracting 0.0 avoids -0.0, with which atan2 is off by half a turn.
    ahead, aside = 0.0 - math.cos(roll) * math.sin(pitch), 0.0 + math.sin(roll)
    north, east = ahead * math.cos(yaw) - aside * math.sin(yaw), ahead * math.sin(yaw) + aside * math.cos(yaw)
    return (
        math.degrees(math.atan2(east, north)) % 360,
        math.degrees(math.atan2(math.sin(roll) * math.cos(pitch) + 0.0, 0.0 - math.sin(pitch))),
        math.degrees(math.asin(max(-1.0, min(1.0, math.cos(roll) * math.cos(pitch))))),
    )
