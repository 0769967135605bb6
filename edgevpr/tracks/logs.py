"""Reads autopilot logs: ArduPilot DataFlash (.bin, .log), MAVLink telemetry (.tlog) and PX4 ULog (.ulg). Position and
attitude over time and, if the autopilot triggered the camera, for each picture."""

import os
from collections.abc import Callable, Sequence
from contextlib import redirect_stderr, redirect_stdout, suppress
from dataclasses import replace
from io import StringIO
from math import degrees
from pathlib import Path
from typing import Any

import numpy as np

from edgevpr.core.arrays import Array
from edgevpr.core.errors import UsageError
from edgevpr.frames.positions import GeoTag
from edgevpr.tracks.record import Attitude, Record, make_tag, make_track, require_package

_FIX_3D = 3  # minimum GPS status for a position to be used
_NO_HEADING = 65535  # of GLOBAL_POSITION_INT
_RECEIVERS = ("vehicle_gps_position", "sensor_gps")
_PX4_TOPICS = (*_RECEIVERS, "vehicle_global_position", "vehicle_attitude", "vehicle_local_position", "camera_capture")

Topics = dict[str, dict[str, Array]]  # values of PX4 messages by topic and field


def read_ardupilot(path: Path) -> Record:
    """Read a DataFlash log: POS (the autopilot's estimate) or, without it, GPS; ATT; CAM or, without it, TRIG."""
    from pymavlink import DFReader

    open_log = DFReader.DFReader_text if path.suffix.lower() == ".log" else DFReader.DFReader_binary
    lines: dict[str, list[tuple[float, GeoTag]]] = {"POS": [], "GPS": [], "CAM": [], "TRIG": []}
    attitude: Attitude | None = None
    for message in _read_messages(open_log, path, [*lines, "ATT"]):
        msg_type = message.get_type()
        if msg_type == "ATT":
            attitude = message.Yaw, message.Roll, message.Pitch
        elif msg_type != "GPS" or message.Status >= _FIX_3D:
            height_m = getattr(message, "RelHomeAlt", getattr(message, "RelAlt", None))
            angles_deg = attitude
            if msg_type in ("CAM", "TRIG"):  # older logs have long field names
                is_long = hasattr(message, "Yaw")
                angles_deg = tuple(getattr(message, name if is_long else name[0]) for name in ("Yaw", "Roll", "Pitch"))
            tag = make_tag(message.Lat, message.Lng, message.Alt, angles_deg, None if msg_type == "GPS" else height_m)
            lines[msg_type].append((message._timestamp, tag))
    shots = tuple(replace(tag, t_utc_s=t_s) for t_s, tag in lines["CAM"] or lines["TRIG"])
    return Record(kind="ArduPilot log", track=make_track(path, lines["POS"] or lines["GPS"]), shots=shots)


def read_telemetry(path: Path) -> Record:
    """Read a ground station's telemetry log: GLOBAL_POSITION_INT, ATTITUDE and CAMERA_FEEDBACK of the first vehicle
    that reports a position. Times are from the ground station's clock."""
    from pymavlink import mavutil

    types = ["GLOBAL_POSITION_INT", "ATTITUDE", "CAMERA_FEEDBACK"]
    lines, shots, vehicle, attitude = [], [], None, None
    for message in _read_messages(mavutil.mavlink_connection, path, types):
        msg_type, sender = message.get_type(), message.get_srcSystem()
        if msg_type == "GLOBAL_POSITION_INT":
            vehicle = sender if vehicle is None else vehicle
        if vehicle not in (None, sender):
            continue
        if msg_type == "ATTITUDE":
            attitude = degrees(message.yaw), degrees(message.roll), degrees(message.pitch)
        elif msg_type == "CAMERA_FEEDBACK":
            angles = message.yaw, message.roll, message.pitch
            tag = make_tag(message.lat / 1e7, message.lng / 1e7, message.alt_msl, angles, message.alt_rel)
            shots.append(replace(tag, t_utc_s=message._timestamp))
        else:
            heading = attitude or (None if message.hdg == _NO_HEADING else (message.hdg / 100, None, None))
            position = message.lat / 1e7, message.lon / 1e7, message.alt / 1000
            tag = make_tag(*position, heading, message.relative_alt / 1000)
            lines.append((message._timestamp, tag))
    return Record(kind="telemetry log", track=make_track(path, lines), shots=tuple(shots))


def _read_messages(open_log: Callable[[str], Any], path: Path, types: list[str]) -> list[Any]:
    """Return the messages of these types, up to the end of a log or the first damaged message."""
    os.environ["PYMAVLINK_FAST_INDEX"] = "0"  # the compiled index prints every skipped byte, bypassing sys.stdout
    messages = []
    with redirect_stdout(StringIO()), redirect_stderr(StringIO()):  # pymavlink prints the bytes that it skips
        try:
            log = open_log(str(path))
        except Exception as error:  # malformed files can raise anything
            raise UsageError(f"{path} cannot be read as a log ({error}): copy it from the autopilot again.") from error
        with suppress(Exception):  # read up to a truncated or damaged message
            while message := log.recv_match(type=types):
                messages.append(message)
        with suppress(AttributeError):  # a text log has no close()
            log.close()
    return messages


def read_px4(path: Path) -> Record:
    """Read a PX4 log: estimated position, height above the starting point, attitude, and `camera_capture`."""
    require_package("pyulog", "A PX4 log")
    from pyulog import ULog

    try:
        with open(path, "rb") as file:
            datasets = ULog(file, list(_PX4_TOPICS), disable_str_exceptions=True).data_list
    except Exception as error:  # malformed files can raise anything
        raise UsageError(f"{path} cannot be read as a PX4 log ({error}): copy it from the autopilot again.") from error
    data = {topic.name: topic.data for topic in reversed(datasets) if len(topic.data["timestamp"])}  # first instance
    shots = tuple(replace(tag, t_utc_s=t_s) for t_s, tag in _read_positions(data, "camera_capture"))
    return Record(kind="PX4 log", track=make_track(path, _read_positions(data, "vehicle_global_position")), shots=shots)


def _read_positions(data: Topics, topic: str) -> list[tuple[float, GeoTag]]:
    """Return (seconds since 1970, tag) for each position of a topic, with attitude and height at that time."""
    if (positions := data.get(topic)) is None:
        return []
    times_us = positions["timestamp"]
    heights_m: Sequence[float | None] = [None] * len(times_us)
    attitudes: Sequence[Attitude | None] = [None] * len(times_us)
    if local := data.get("vehicle_local_position"):
        heights_m = np.interp(times_us, local["timestamp"], -local["z"]).tolist()
    if attitude := data.get("vehicle_attitude"):
        attitudes = _interpolate_attitudes(attitude, times_us)
    coordinates = (positions[name].tolist() for name in ("lat", "lon", "alt"))
    tags = map(make_tag, *coordinates, attitudes, heights_m)
    return list(zip((times_us / 1e6 + _read_utc_offset_s(data)).tolist(), tags, strict=True))


def _read_utc_offset_s(data: Topics) -> float:
    """Return the offset from seconds since autopilot boot to seconds since 1970; 0 if no receiver knew the time."""
    for receiver in filter(None, map(data.get, _RECEIVERS)):
        if (has_time := receiver["time_utc_usec"] > 0).any():
            utc_us = receiver["time_utc_usec"][has_time].astype(np.float64)
            return float(np.median(utc_us - receiver["timestamp"][has_time])) / 1e6
    return 0.0


def _interpolate_attitudes(attitude: dict[str, Array], times_us: Array) -> list[Attitude]:
    """Return the last reported yaw, roll and pitch before each time, in degrees."""
    indices = np.clip(np.searchsorted(attitude["timestamp"], times_us, side="right") - 1, 0, None)
    w, x, y, z = (attitude[f"q[{axis}]"][indices].astype(float) for axis in range(4))
    yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = np.arcsin(np.clip(2 * (w * y - z * x), -1, 1))
    return list(zip(*np.degrees([yaw, roll, pitch]).tolist(), strict=True))
