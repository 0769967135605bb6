"""Logs of autopilots: ArduPilot's DataFlash (.bin, .log), telemetry of MAVLink (.tlog) and PX4's (.ulg). Position and
attitude over time, and for each picture that the autopilot triggered, if it did."""

import os
from collections.abc import Callable, Sequence
from contextlib import redirect_stderr, redirect_stdout, suppress
from io import StringIO
from math import degrees
from pathlib import Path
from typing import Any

import numpy as np

from edgevpr.core.arrays import Array
from edgevpr.core.errors import UsageError
from edgevpr.frames.positions import GeoTag
from edgevpr.tracks.record import Attitude, Record, require, tag_of, track_of

_FIX_3D = 3  # GPS status from which on a position counts
_NO_HEADING = 65535  # of GLOBAL_POSITION_INT
_OF_PX4 = (
    "vehicle_global_position",
    "vehicle_attitude",
    "vehicle_local_position",
    "vehicle_gps_position",
    "sensor_gps",
    "camera_capture",
)

Topic = dict[str, Array]  # the values of a field of a PX4 message, by its name
Topics = dict[str, Topic]


def read_ardupilot(path: Path) -> Record:
    """Read a DataFlash log: POS (the autopilot's estimate) or, without it, GPS; ATT; CAM or, without it, TRIG."""
    from pymavlink import DFReader

    is_text = path.suffix.lower() == ".log"
    open_log = DFReader.DFReader_text if is_text else DFReader.DFReader_binary
    lines: dict[str, list[tuple[float, GeoTag]]] = {"POS": [], "GPS": [], "CAM": [], "TRIG": []}
    attitude: Attitude | None = None
    for message in _messages(open_log, path, [*lines, "ATT"]):
        kind = message.get_type()
        if kind == "ATT":
            attitude = message.Yaw, message.Roll, message.Pitch
        elif kind != "GPS" or message.Status >= _FIX_3D:
            height_m = getattr(message, "RelHomeAlt", getattr(message, "RelAlt", None))
            own = _angles(message) if kind in ("CAM", "TRIG") else attitude
            tag = tag_of(message.Lat, message.Lng, message.Alt, own, None if kind == "GPS" else height_m)
            lines[kind].append((message._timestamp, tag))
    shots = tuple(tag for _, tag in lines["CAM"] or lines["TRIG"])
    return Record(kind="ArduPilot log", track=track_of(path, lines["POS"] or lines["GPS"]), shots=shots)


def _angles(message: Any) -> Attitude:
    """Return yaw, roll and pitch of a CAM or TRIG message; older logs write the names out."""
    if hasattr(message, "Yaw"):
        return message.Yaw, message.Roll, message.Pitch
    return message.Y, message.R, message.P


def read_telemetry(path: Path) -> Record:
    """Read a telemetry log of a ground station: GLOBAL_POSITION_INT, ATTITUDE and CAMERA_FEEDBACK of the first vehicle
    that tells its position. Times are those of the ground station's clock."""
    from pymavlink import mavutil

    wanted = ["GLOBAL_POSITION_INT", "ATTITUDE", "CAMERA_FEEDBACK"]
    lines, shots, vehicle, attitude = [], [], None, None
    for message in _messages(mavutil.mavlink_connection, path, wanted):
        kind, sender = message.get_type(), message.get_srcSystem()
        if kind == "GLOBAL_POSITION_INT":
            vehicle = sender if vehicle is None else vehicle
        if vehicle not in (None, sender):
            continue
        if kind == "ATTITUDE":
            attitude = degrees(message.yaw), degrees(message.roll), degrees(message.pitch)
        elif kind == "CAMERA_FEEDBACK":
            turned = message.yaw, message.roll, message.pitch
            shots.append(tag_of(message.lat / 1e7, message.lng / 1e7, message.alt_msl, turned, message.alt_rel))
        else:
            heading = attitude or (None if message.hdg == _NO_HEADING else (message.hdg / 100, None, None))
            tag = tag_of(message.lat / 1e7, message.lon / 1e7, message.alt / 1000, heading, message.relative_alt / 1000)
            lines.append((message._timestamp, tag))
    return Record(kind="telemetry log", track=track_of(path, lines), shots=tuple(shots))


def _messages(open_log: Callable[[str], Any], path: Path, kinds: list[str]) -> list[Any]:
    """Return the messages of these kinds to the end of a log, or to where it is damaged."""
    os.environ["PYMAVLINK_FAST_INDEX"] = "0"  # the compiled index prints, past Python, each byte that it skips
    found = []
    with redirect_stdout(StringIO()), redirect_stderr(StringIO()):  # pymavlink prints what it skips
        try:
            log = open_log(str(path))
        except Exception as error:  # files of any content
            raise UsageError(
                f"{path} is no log that can be read ({error}): copy it from the autopilot again."
            ) from error
        with suppress(Exception):  # what is cut off or damaged is not read
            while message := log.recv_match(type=kinds):
                found.append(message)
        with suppress(AttributeError):  # of a log as text
            log.close()
    return found


def read_px4(path: Path) -> Record:
    """Read a log of PX4: its estimate of position, height over the place where it started, attitude, and
    `camera_capture`."""
    require("pyulog", "pyulog", "A log of PX4")
    from pyulog import ULog

    try:
        with open(path, "rb") as file:
            datasets = ULog(file, list(_OF_PX4), disable_str_exceptions=True).data_list
    except Exception as error:  # files of any content
        raise UsageError(f"{path} is no log of PX4 ({error}): copy it again from the autopilot.") from error
    data = {each.name: each.data for each in reversed(datasets) if len(each.data["timestamp"])}  # the first of each
    lines = list(_tags_of(data, data.get("vehicle_global_position")) or _tags_of(data, _receiver(data)))
    shots = tuple(tag for _, tag in _tags_of(data, data.get("camera_capture")))
    return Record(kind="PX4 log", track=track_of(path, lines), shots=shots)


def _receiver(data: Topics) -> Topic | None:
    """Return what the receiver told while it had a fix, with degrees and metres in the names and units of the estimate;
    None if it told nothing."""
    told = data.get("vehicle_gps_position", data.get("sensor_gps"))
    if told is None:
        return None
    fixed = told["fix_type"] >= _FIX_3D
    if "latitude_deg" in told:
        lat_deg, lon_deg, alt_m = told["latitude_deg"], told["longitude_deg"], told["altitude_msl_m"]
    else:
        lat_deg, lon_deg, alt_m = told["lat"] / 1e7, told["lon"] / 1e7, told["alt"] / 1e3
    found = {"timestamp": told["timestamp"], "lat": lat_deg, "lon": lon_deg, "alt": alt_m}
    return {name: values[fixed] for name, values in found.items()}


def _tags_of(data: Topics, positions: Topic | None) -> list[tuple[float, GeoTag]]:
    """Return seconds since 1970 and a tag for each of the `positions`, with attitude and height at that time."""
    if positions is None:
        return []
    at_us = positions["timestamp"]
    t_utc_s = at_us / 1e6 + _behind_utc_s(data)
    where = (positions[name].tolist() for name in ("lat", "lon", "alt"))
    tags = map(tag_of, *where, _attitude_at(data, at_us), _heights_at(data, at_us))
    return list(zip(t_utc_s.tolist(), tags, strict=True))


def _behind_utc_s(data: Topics) -> float:
    """Return what is to be added to seconds since the start of the autopilot to get those since 1970; 0 if no receiver
    told the time."""
    for name in ("vehicle_gps_position", "sensor_gps"):
        if name in data and (known := data[name]["time_utc_usec"] > 0).any():
            utc_us = data[name]["time_utc_usec"][known].astype(np.float64)
            return float(np.median(utc_us - data[name]["timestamp"][known])) / 1e6
    return 0.0


def _attitude_at(data: Topics, at_us: Array) -> Sequence[Attitude | None]:
    """Return yaw, roll and pitch in degrees, those last told at each time (None: not told)."""
    told = data.get("vehicle_attitude")
    if told is None:
        return [None] * len(at_us)
    last = np.clip(np.searchsorted(told["timestamp"], at_us, side="right") - 1, 0, None)
    w, x, y, z = (told[f"q[{axis}]"][last].astype(float) for axis in range(4))
    yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = np.arcsin(np.clip(2 * (w * y - z * x), -1, 1))
    return list(zip(*np.degrees([yaw, roll, pitch]).tolist(), strict=True))


def _heights_at(data: Topics, at_us: Array) -> Sequence[float | None]:
    told = data.get("vehicle_local_position")
    return [None] * len(at_us) if told is None else np.interp(at_us, told["timestamp"], -told["z"]).tolist()
