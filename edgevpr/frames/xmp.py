"""XMP data that a drone wrote into an image file: which way its camera looked, and how high it was."""

import math
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

_HEAD_BYTES = 300_000  # in a JPEG the packet stands before the picture, behind EXIF data of 64 KB at most
_MOST_BYTES = 65_536  # of a packet: that of a JPEG fits a segment
_BEGIN, _END = b"<x:xmpmeta", b"</x:xmpmeta>"
_DJI, _PARROT = "{http://www.dji.com/drone-dji/1.0/}", "{http://www.parrot.com/drone-parrot/1.0/}"
_PIX4D = ("{http://pix4d.com/camera/1.0/}", "{http://pix4d.com/camera/1.0}")
_HEIGHTS_M = (-1000.0, 100_000.0)


@dataclass(frozen=True, slots=True)
class Shooting:
    """The way a picture was taken (None: unknown): `heading_deg` (0..360) of its top, roll and pitch of the camera as
    its deviation from straight down, and height over the take-off point, which is the height above the ground only
    where the ground is level."""

    heading_deg: float | None = None
    roll_deg: float | None = None
    pitch_deg: float | None = None
    height_m: float | None = None


def read_xmp(path: str | Path) -> Shooting:
    """Read what DJI, Parrot and Pix4D's tags say, from the packet in the first 300 KB of a file. Never raises: a value
    that is absent, broken or senseless is None."""
    try:
        with open(path, "rb") as handle:
            head = handle.read(_HEAD_BYTES)
        return _shooting(_values(head))
    except (OSError, ElementTree.ParseError, ValueError, MemoryError, RecursionError):  # files of any origin
        return Shooting()


def _values(head: bytes) -> dict[str, str]:
    """Return the texts of the attributes and elements of the first packet, by qualified name.

    The packet is cut out at its first element. A document type, with which entities would be declared, can only stand
    before that one, and so is never read.
    """
    start = head.find(_BEGIN)
    end = head.find(_END, start)
    if start < 0 or not 0 < end - start <= _MOST_BYTES:
        return {}
    values: dict[str, str] = {}
    for element in ElementTree.fromstring(head[start : end + len(_END)]).iter():
        values.update(element.attrib)
        if element.text and element.text.strip():
            values[element.tag] = element.text
    return values


def _shooting(values: dict[str, str]) -> Shooting:
    height_m = _number(values, f"{_DJI}RelativeAltitude", *_HEIGHTS_M)
    for maker, what in ((_DJI, "Gimbal"), (_PARROT, "Camera")):
        yaw, pitch, roll = (_number(values, f"{maker}{what}{axis}Degree") for axis in ("Yaw", "Pitch", "Roll"))
        if None not in (yaw, pitch, roll):
            return Shooting(*_from_straight_down(yaw, pitch, roll), height_m)
    for maker in _PIX4D:  # of these tags 0 is straight down
        yaw, pitch, roll = (_number(values, f"{maker}{axis}") for axis in ("Yaw", "Pitch", "Roll"))
        if None not in (yaw, pitch, roll) and (yaw, pitch, roll) != (0, 0, 0):  # a camera without an IMU writes zeros
            return Shooting(yaw % 360, roll, pitch, height_m)
    yaw = _number(values, f"{_DJI}FlightYawDegree")
    return Shooting(heading_deg=None if yaw is None else yaw % 360, height_m=height_m)


def _number(values: dict[str, str], name: str, low: float = -360.0, high: float = 360.0) -> float | None:
    try:
        value = float(values[name])
    except (KeyError, ValueError):
        return None
    return value if low <= value <= high else None


def _from_straight_down(yaw_deg: float, pitch_deg: float, roll_deg: float) -> tuple[float, float, float]:
    """Return heading, roll and pitch from straight down of a gimbal whose pitch is -90 there. Its roll then turns the
    picture and tilts nothing: a gimbal may tell half a turn in yaw as half a turn in roll."""
    yaw, pitch, roll = map(math.radians, (yaw_deg, pitch_deg, roll_deg))
    # Columns: the axes of a level airframe whose camera looks straight down like this one. Its nose is where the top of
    # the picture points, its right that of the picture, and its down what the camera looks at.
    nose = _turned(yaw, pitch, roll, (0.0, 0.0, -1.0))
    right = _turned(yaw, pitch, roll, (0.0, 1.0, 0.0))
    down = _turned(yaw, pitch, roll, (1.0, 0.0, 0.0))
    heading = math.atan2(nose[1], nose[0])
    return (
        math.degrees(heading) % 360,
        math.degrees(math.atan2(right[2], down[2])),
        math.degrees(math.asin(max(-1.0, min(1.0, -nose[2])))),
    )


def _turned(yaw: float, pitch: float, roll: float, axis: tuple[float, float, float]) -> tuple[float, float, float]:
    """Turn an axis (ahead, right, down) by roll, then pitch, then yaw: (north, east, down)."""
    ahead, right, down = axis
    right, down = right * math.cos(roll) - down * math.sin(roll), right * math.sin(roll) + down * math.cos(roll)
    ahead, down = ahead * math.cos(pitch) + down * math.sin(pitch), down * math.cos(pitch) - ahead * math.sin(pitch)
    return ahead * math.cos(yaw) - right * math.sin(yaw), ahead * math.sin(yaw) + right * math.cos(yaw), down
