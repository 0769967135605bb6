"""Recordings of a flight, written as autopilots and receivers write them, for tests."""

import struct
from datetime import datetime, timezone

START_S = 1_700_000_000.0
_GPS_EPOCH_S = 315_964_800
_LEAP_S = 18
_WEEK_S = 604_800
_HEAD = b"\xa3\x95"
_FORMATS = {  # of DataFlash: number, format and columns
    "GPS": (130, "QBIHBcLLefffB", "TimeUS,Status,GMS,GWk,NSats,HDop,Lat,Lng,Alt,Spd,GCrs,VZ,U"),
    "POS": (131, "QLLfff", "TimeUS,Lat,Lng,Alt,RelHomeAlt,RelOriginAlt"),
    "ATT": (132, "QccccCC", "TimeUS,DesRoll,Roll,DesPitch,Pitch,DesYaw,Yaw"),
    "CAM": (133, "QIHLLeeeccC", "TimeUS,GPSTime,GPSWeek,Lat,Lng,Alt,RelAlt,GPSAlt,Roll,Pitch,Yaw"),
}
_CODES = {"Q": "Q", "B": "B", "I": "I", "H": "H", "c": "h", "L": "i", "e": "i", "f": "f", "C": "H"}


def _dataflash(name, *values):
    number, letters, _ = _FORMATS[name]
    return _HEAD + bytes([number]) + struct.pack("<" + "".join(_CODES[each] for each in letters), *values)


def write_dataflash(path, points, shots=()):
    """Write ArduPilot's log. `points` and `shots` are (seconds, lat, lon, alt, height, roll, pitch, yaw)."""
    head = {"FMT": (128, "BBnNZ", "Type,Length,Name,Format,Columns"), **_FORMATS}
    blocks = []
    for name, (number, letters, columns) in head.items():
        length = 89 if name == "FMT" else 3 + struct.calcsize("<" + "".join(_CODES[each] for each in letters))
        texts = (name.encode(), letters.encode(), columns.encode())
        blocks.append(_HEAD + b"\x80" + struct.pack("<BB4s16s64s", number, length, *texts))
    for t_s, lat, lon, alt, height, roll, pitch, yaw in points:
        at_us, gps_s = int(1e6 * (t_s + 20)), START_S + t_s - _GPS_EPOCH_S + _LEAP_S
        week, ms = int(gps_s // _WEEK_S), int(1000 * (gps_s % _WEEK_S))
        where = round(lat * 1e7), round(lon * 1e7)
        turned = round(100 * roll), 0, round(100 * pitch), 0, round(100 * yaw)
        blocks.append(_dataflash("GPS", at_us, 3, ms, week, 12, 80, *where, round(alt * 100), 5.0, 0.0, 0.0, 1))
        blocks.append(_dataflash("ATT", at_us, 0, *turned))
        blocks.append(_dataflash("POS", at_us, *where, alt, height, height))
    for t_s, lat, lon, alt, height, roll, pitch, yaw in shots:
        where = round(lat * 1e7), round(lon * 1e7), round(alt * 100), round(height * 100), round(alt * 100)
        turned = round(100 * roll), round(100 * pitch), round(100 * yaw)
        blocks.append(_dataflash("CAM", int(1e6 * (t_s + 20)), 0, 0, *where, *turned))
    path.write_bytes(b"".join(blocks))


def write_tlog(path, points, shots=()):
    """Write the telemetry log of a ground station; arguments as of `write_dataflash`."""
    from math import radians

    from pymavlink.dialects.v20 import ardupilotmega as dialect

    link = dialect.MAVLink(None, srcSystem=1, srcComponent=1)

    def add_stamp(t_s, message):
        return struct.pack(">Q", int(1e6 * (START_S + t_s))) + message.pack(link)

    blocks = []
    for t_s, lat, lon, alt, height, roll, pitch, yaw in points:
        at_ms, turned = int(1000 * t_s), map(radians, (roll, pitch, yaw))
        where = round(lat * 1e7), round(lon * 1e7), round(alt * 1000), round(height * 1000)
        blocks.append(add_stamp(t_s, dialect.MAVLink_attitude_message(at_ms, *turned, 0, 0, 0)))
        position = dialect.MAVLink_global_position_int_message(at_ms, *where, 0, 0, 0, round(100 * yaw))
        blocks.append(add_stamp(t_s, position))
    for t_s, lat, lon, alt, height, roll, pitch, yaw in shots:
        where = round(lat * 1e7), round(lon * 1e7), alt, height
        values = int(1e6 * (START_S + t_s)), 1, 0, 0, *where, roll, pitch, yaw, 0, 0
        taken = dialect.MAVLink_camera_feedback_message(*values)
        blocks.append(add_stamp(t_s, taken))
    path.write_bytes(b"".join(blocks))


def write_ulog(path, topics):
    """Write PX4's log. `topics`: the names of each topic's fields with their types, and its rows."""
    parts = [b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 0)]

    def pack_message(kind, content):
        parts.append(struct.pack("<Hc", len(content), kind) + content)

    pack_message(b"B", bytes(40))
    codes = {"uint64_t": "Q", "double": "d", "float": "f", "int32_t": "i", "uint8_t": "B", "float[4]": "4f"}
    for name, (names, _) in topics.items():
        pack_message(b"F", f"{name}:{''.join(f'{kind} {field};' for field, kind in names.items())}".encode())
    for number, name in enumerate(topics):
        pack_message(b"A", struct.pack("<BH", 0, number) + name.encode())
    for number, (names, rows) in enumerate(topics.values()):
        layout = "<H" + "".join(codes[kind] for kind in names.values())
        for row in rows:
            flat = [value for cell in row for value in (cell if isinstance(cell, tuple) else (cell,))]
            pack_message(b"D", struct.pack(layout, number, *flat))
    path.write_bytes(b"".join(parts))


def write_gpx(path, points):
    """Write a GPX track of (seconds, lat, lon)."""
    lines = [
        f'<trkpt lat="{lat}" lon="{lon}"><ele>120</ele><time>'
        f"{datetime.fromtimestamp(START_S + t_s, timezone.utc).isoformat().replace('+00:00', 'Z')}</time></trkpt>"
        for t_s, lat, lon in points
    ]
    body = "".join(lines)
    path.write_text(
        '<?xml version="1.0"?><gpx version="1.1" creator="test" xmlns="http://www.topografix.com/GPX/1/1">'
        f"<trk><trkseg>{body}</trkseg></trk></gpx>"
    )
