"""Reads the camera's metadata from an image file: position, heading and time from EXIF, roll, pitch and height from
XMP. Used for images that are not listed in a positions.csv."""

import contextlib
import logging
import math
import re
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

from edgevpr.core.types import Position
from edgevpr.frames.positions import ALT_LIMITS_M, GeoTag, make_position, parse_time

T = TypeVar("T")
Tags = Mapping[str, Any]  # values from exifread by tag name, such as "GPS GPSLatitude"

_FILM_DIAGONAL_MM = 43.27
_MAX_SIDE_FRACTION = 0.82  # of the diagonal
_HEAD_BYTES = 300_000  # in a JPEG the XMP comes before the image, after at most 64 KB of EXIF data
# An XMP value, as an attribute or an element, of DJI, Parrot, Skydio, Autel (`drone`) or Pix4D (`Camera`).
_XMP_PATTERN = re.compile(
    rb"""\b((?:drone(?:-dji|-parrot|-skydio)?|Camera):\w+)(?:\s*=\s*["']|>)\s*([-+.\deE]+)\s*["'<]"""
)
_GIMBAL_NAMES = (
    "drone-dji:Gimbal{}Degree", "drone:Gimbal{}Degree", "drone-parrot:Camera{}Degree", "NED drone-skydio:{}"
)  # fmt: skip
# Skydio uses the same names for the angles in several coordinate frames; edgevpr uses those in NED.
_SKYDIO_PATTERN = re.compile(
    rb"<drone-skydio:CameraOrientationNED\b(.*?)(?:/>|</drone-skydio:CameraOrientationNED)", re.DOTALL
)


def read_exif(path: str | Path) -> GeoTag:
    """Read the EXIF and XMP data of a JPEG, TIFF, PNG or WebP file. Never raises: a value that is absent, damaged or
    impossible is None. The time is from the GPS receiver, or else from the camera clock, taken as UTC if it has no time
    zone. Heading, roll, pitch and height are those of `read_xmp`, with the heading of EXIF as a fallback."""
    tags, xmp = _read_tags(path), read_xmp(path)

    def read_first(*readers: Callable[[Tags], T]) -> T | None:
        for read in readers:
            with contextlib.suppress(Exception):  # a tag may be absent, impossible, of another type, or divide by zero
                return read(tags)
        return None

    position, alt_m = read_first(_read_position), read_first(_read_alt_m)
    heading_deg = read_first(_read_heading_deg) if xmp.heading_deg is None else xmp.heading_deg
    t_utc_s = read_first(_read_gps_time_s, _read_camera_time_s)
    return replace(xmp, position=position and replace(position, alt_m=alt_m), heading_deg=heading_deg, t_utc_s=t_utc_s)


def read_fov_deg(path: str | Path) -> float | None:
    """Return the approximate field of view in degrees along the longest side of an image, from the 35 mm equivalent
    focal length in its EXIF data, which refers to the diagonal (CIPA DCG-001); None if it has none. Never raises."""
    with contextlib.suppress(Exception):
        tags = _read_tags(path)
        focal_mm = float(tags["EXIF FocalLengthIn35mmFilm"].values[0])
        sides = [float(tags[f"EXIF ExifImage{side}"].values[0]) for side in ("Width", "Length")]
        # Images wider than 3:2 are crops of the full-width sensor image.
        side_fraction = min(max(sides) / math.hypot(*sides), _MAX_SIDE_FRACTION)
        return _require_range(math.degrees(2 * math.atan(_FILM_DIAGONAL_MM * side_fraction / 2 / focal_mm)), 5, 150)
    return None


def _read_tags(path: str | Path) -> Tags:
    import exifread  # not at the top: most sources never need it

    logging.getLogger("exifread").setLevel(logging.CRITICAL)  # by default it warns about every file without EXIF
    with contextlib.suppress(Exception), open(path, "rb") as handle:  # malformed files can raise anything
        tags: Tags = exifread.process_file(handle, details=False)
        return tags
    return {}


def _require_range(value: float, low: float, high: float) -> float:
    if not low <= value <= high:
        raise ValueError(f"{value:g} is not between {low:g} and {high:g}")
    return value


def _read_position(tags: Tags) -> Position | None:
    if "GPS GPSStatus" in tags and tags["GPS GPSStatus"].values == "V":  # void: the receiver has lost its fix
        return None
    lat_deg = _read_degrees(tags, "GPS GPSLatitude", {"N": 1, "S": -1}, 90)
    return make_position(lat_deg, _read_degrees(tags, "GPS GPSLongitude", {"E": 1, "W": -1}, 180), None)


def _read_degrees(tags: Tags, name: str, signs: dict[str, int], limit: float) -> float:
    # 60 is allowed: it may be a rounded 59.99999.
    parts = zip(map(float, tags[name].values), (limit, 60, 60), (1, 60, 3600), strict=True)
    value = sum(_require_range(part, 0, largest) / divisor for part, largest, divisor in parts)
    return signs[tags[f"{name}Ref"].values.strip()] * _require_range(value, 0, limit)


def _read_alt_m(tags: Tags) -> float:
    # 0 is above and 1 below sea level; 2 and 3 (EXIF 3.0) refer to the ellipsoid and are not used.
    reference = tags["GPS GPSAltitudeRef"].values[0] if "GPS GPSAltitudeRef" in tags else 0
    return _require_range({0: 1, 1: -1}[reference] * float(tags["GPS GPSAltitude"].values[0]), *ALT_LIMITS_M)


def _read_heading_deg(tags: Tags) -> float | None:
    if "GPS GPSImgDirectionRef" in tags and tags["GPS GPSImgDirectionRef"].values != "T":
        return None  # magnetic north: off by the declination, which is unknown
    return _require_range(float(tags["GPS GPSImgDirection"].values[0]), 0, 360) % 360


def _read_gps_time_s(tags: Tags) -> float:
    day_s = _parse_time_s(f"{tags['GPS GPSDate'].values} 00:00:00")
    parts = zip(map(float, tags["GPS GPSTimeStamp"].values), (24, 60, 61), (3600, 60, 1), strict=True)
    return sum((_require_range(part, 0, largest) * unit_s for part, largest, unit_s in parts), start=day_s)


def _read_camera_time_s(tags: Tags) -> float:
    zone = tags["EXIF OffsetTimeOriginal"].values if "EXIF OffsetTimeOriginal" in tags else ""
    digits = str(tags["EXIF SubSecTimeOriginal"].values).strip() if "EXIF SubSecTimeOriginal" in tags else ""
    fraction_s = float(f"0.{digits}") if digits.isdecimal() else 0.0
    return _parse_time_s(f"{tags['EXIF DateTimeOriginal'].values}{zone}") + fraction_s


def _parse_time_s(text: str) -> float:
    if ":" not in text:  # a plain number of seconds is not an EXIF time
        raise ValueError(text)
    return parse_time(text)


def read_xmp(path: str | Path) -> GeoTag:
    """Read the XMP tags of DJI, Autel, Parrot, Skydio and Pix4D from the first 300 KB of a file. Never raises: a value
    that is absent, damaged or impossible is None. The heading is the direction of the image's top or, if unknown, of
    the aircraft's nose. Roll and pitch: of the camera, from straight down. The height is above take-off."""
    head = b""
    with contextlib.suppress(OSError), open(path, "rb") as handle:
        head = handle.read(_HEAD_BYTES)
    values = _find_values(head)
    if orientation := _SKYDIO_PATTERN.search(head):
        values |= {f"NED {name}": text for name, text in _find_values(orientation[1]).items()}
    height_m = _find_number(values, "RelativeAltitude", ("drone-dji", "drone", "drone-skydio"), *ALT_LIMITS_M)
    for name in _GIMBAL_NAMES:
        # All zeros, which small DJI drones write, mean unknown: no gimbal points exactly north and level.
        if angles := _find_angles(values, name):
            heading_deg, roll_deg, pitch_deg = to_nadir_angles(*angles)
            return GeoTag(heading_deg=heading_deg, roll_deg=roll_deg, pitch_deg=pitch_deg, height_m=height_m)
    # In Pix4D tags, 0 is straight down. All zeros, which a camera without an IMU writes, are ignored.
    if angles := _find_angles(values, "Camera:{}"):
        yaw_deg, pitch_deg, roll_deg = angles
        return GeoTag(heading_deg=yaw_deg % 360, roll_deg=roll_deg, pitch_deg=pitch_deg, height_m=height_m)
    nose_deg = _find_number(values, "FlightYawDegree", ("drone-dji", "drone"), -360, 360)
    return GeoTag(heading_deg=None if nose_deg is None else nose_deg % 360, height_m=height_m)


def _find_values(packet: bytes) -> dict[str, bytes]:
    return {name.decode(): text for name, text in reversed(_XMP_PATTERN.findall(packet))}  # first one wins


def _find_angles(values: Mapping[str, bytes], name: str) -> tuple[float, float, float] | None:
    """Return yaw, pitch and roll; `name` has {} in place of the axis. None if one is missing or all are zero."""
    with contextlib.suppress(KeyError, ValueError):
        numbers = (float(values[name.format(axis)]) for axis in ("Yaw", "Pitch", "Roll"))
        yaw, pitch, roll = (_require_range(number, -360, 360) for number in numbers)
        return (yaw, pitch, roll) if any((yaw, pitch, roll)) else None
    return None


def _find_number(
    values: Mapping[str, bytes], name: str, makers: tuple[str, ...], low: float, high: float
) -> float | None:
    for maker in makers:
        with contextlib.suppress(KeyError, ValueError):
            return _require_range(float(values[f"{maker}:{name}"]), low, high)
    return None


def to_nadir_angles(yaw_deg: float, pitch_deg: float, roll_deg: float) -> tuple[float, float, float]:
    """Convert gimbal angles (a pitch of -90 is straight down) to (heading of the image's top, roll, pitch), where
    roll and pitch are the camera's deviation from straight down. All in degrees."""
    # The result is the attitude of an imaginary airframe whose nose points to the image's top and whose down axis is
    # the viewing direction. If the camera looks straight down, the gimbal's roll only rotates the image.
    yaw, pitch, roll = map(math.radians, (yaw_deg, pitch_deg, roll_deg))
    # The nose before applying the yaw. Adding or subtracting 0.0 avoids -0.0, for which atan2 is off by 180 degrees.
    forward, right = 0.0 - math.cos(roll) * math.sin(pitch), 0.0 + math.sin(roll)
    north, east = forward * math.cos(yaw) - right * math.sin(yaw), forward * math.sin(yaw) + right * math.cos(yaw)
    return (
        math.degrees(math.atan2(east, north)) % 360,
        math.degrees(math.atan2(math.sin(roll) * math.cos(pitch) + 0.0, 0.0 - math.sin(pitch))),
        math.degrees(math.asin(max(-1.0, min(1.0, math.cos(roll) * math.cos(pitch))))),
    )
