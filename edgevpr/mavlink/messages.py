"""Functions that make the messages we send, one for each kind: values in, a pymavlink message out; no I/O and no clock.
Used by the link and the flight.

`t_mono_s` is a time of the system's monotonic clock in seconds, the only clock of a link: an autopilot keeps a single
time correction for all messages of a link.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

from edgevpr.mavlink.wire import Message, mavlink

POSITION_FIX = mavlink.MAV_CMD_EXTERNAL_POSITION_ESTIMATE  # 43003
AUTOPILOT = mavlink.MAV_COMP_ID_AUTOPILOT1
TEXT_BYTES = 50


class Health(IntEnum):
    """The state of this companion computer that its heartbeat reports (MAV_STATE)."""

    BOOT = mavlink.MAV_STATE_BOOT
    STANDBY = mavlink.MAV_STATE_STANDBY  # paused by the ground
    ACTIVE = mavlink.MAV_STATE_ACTIVE
    CRITICAL = mavlink.MAV_STATE_CRITICAL  # it runs, but does not work: no frames come, or its main loop hangs


class Severity(IntEnum):
    """Severity of a status text (MAV_SEVERITY)."""

    WARNING = mavlink.MAV_SEVERITY_WARNING
    INFO = mavlink.MAV_SEVERITY_INFO


@dataclass(frozen=True, slots=True)
class Fix:
    """A position fix: latitude and longitude of the vehicle at `t_frame_s`, when the frame was taken (monotonic clock),
    and `accuracy_m`, the standard deviation of one axis.

    Raises ValueError for a position off the Earth, for an accuracy that is not finite and above zero, and for a time
    that is not finite.
    """

    lat_deg: float
    lon_deg: float
    accuracy_m: float
    t_frame_s: float

    def __post_init__(self) -> None:
        if not (abs(self.lat_deg) <= 90 and abs(self.lon_deg) <= 180):  # in this form NaN is refused too
            raise ValueError(f"latitude {self.lat_deg}, longitude {self.lon_deg} is no place on the Earth")
        if not 0 < self.accuracy_m < math.inf:
            raise ValueError(f"an accuracy of {self.accuracy_m} m says nothing: it must be finite and above zero")
        if not math.isfinite(self.t_frame_s):
            raise ValueError(f"a frame taken at {self.t_frame_s} s has no age")


def heartbeat(health: Health) -> Message:
    """Make the HEARTBEAT (0) of an onboard computer."""
    return mavlink.MAVLink_heartbeat_message(
        type=mavlink.MAV_TYPE_ONBOARD_CONTROLLER,
        autopilot=mavlink.MAV_AUTOPILOT_INVALID,
        base_mode=0,
        custom_mode=0,
        system_status=health,
        mavlink_version=3,
    )


def position_fix(fix: Fix, t_sent_s: float, target_system: int) -> Message:
    """Make a COMMAND_INT (75) with command 43003, in the form that ArduPilot accepts: global frame, no altitude (NaN).

    The time from `fix.t_frame_s` to `t_sent_s` is sent as the processing time, which tells the autopilot how old the
    position is. `t_sent_s` is sent as a float32: accurate to 8 ms after one day, to 60 ms after ten days.
    """
    return mavlink.MAVLink_command_int_message(
        target_system=target_system,
        target_component=AUTOPILOT,
        frame=mavlink.MAV_FRAME_GLOBAL,
        command=POSITION_FIX,
        current=0,
        autocontinue=0,
        param1=t_sent_s,
        param2=max(0.0, t_sent_s - fix.t_frame_s),
        param3=fix.accuracy_m,
        param4=math.nan,
        x=round(fix.lat_deg * 1e7),
        y=round(fix.lon_deg * 1e7),
        z=math.nan,
    )


def report_requests(target_system: int, firmware: int, is_continuous: bool = False) -> tuple[Message, ...]:
    """Make the requests for all reports that the flight needs, each a COMMAND_LONG (76) with SET_MESSAGE_INTERVAL
    (511). On many autopilots the companion's port sends none of them unless asked. `firmware` is a MAV_AUTOPILOT; a
    continuous channel (`is_continuous`) needs more.

    - 10 Hz: GLOBAL_POSITION_INT (33) and ATTITUDE (30); 5 Hz: GPS_RAW_INT (24).
    - 2 Hz: DISTANCE_SENSOR (132), TERRAIN_REPORT (136), and the status of the position filter of a known firmware.
    - Continuous: ATTITUDE and SCALED_IMU (26) at 25 Hz; SYSTEM_TIME (2) and GPS_GLOBAL_ORIGIN (49) at 1 Hz.
    """
    wanted_us = {
        mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: 100_000,
        mavlink.MAVLINK_MSG_ID_ATTITUDE: _DENSE_US if is_continuous else 100_000,
        mavlink.MAVLINK_MSG_ID_GPS_RAW_INT: 200_000,
        mavlink.MAVLINK_MSG_ID_DISTANCE_SENSOR: 500_000,
        mavlink.MAVLINK_MSG_ID_TERRAIN_REPORT: 500_000,
    }
    if is_continuous:
        wanted_us[mavlink.MAVLINK_MSG_ID_SCALED_IMU] = _DENSE_US
        wanted_us[mavlink.MAVLINK_MSG_ID_SYSTEM_TIME] = 1_000_000
        wanted_us[mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN] = 1_000_000
    if firmware in _FILTER_REPORTS:
        wanted_us[_FILTER_REPORTS[firmware]] = 500_000
    interval = mavlink.MAV_CMD_SET_MESSAGE_INTERVAL
    return tuple(_command(target_system, interval, *wanted) for wanted in wanted_us.items())


def message_request(target_system: int, message_id: int) -> Message:
    """Make a COMMAND_LONG (76) with REQUEST_MESSAGE (512): the autopilot shall send message `message_id` once."""
    return _command(target_system, mavlink.MAV_CMD_REQUEST_MESSAGE, message_id)


def parameter_request(target_system: int, name: str) -> Message:
    """Make a PARAM_REQUEST_READ (20) for the parameter of this name."""
    return mavlink.MAVLink_param_request_read_message(target_system, AUTOPILOT, name.encode(), -1)


def origin(target_system: int, lat_deg: float, lon_deg: float, alt_m: float) -> Message:
    """Make a SET_GPS_GLOBAL_ORIGIN (48): the origin of the autopilot's local frame, `alt_m` above sea level."""
    return mavlink.MAVLink_set_gps_global_origin_message(
        target_system, round(lat_deg * 1e7), round(lon_deg * 1e7), round(alt_m * 1e3)
    )


def place_match(t_mono_s: float, place_id: int, score: float, confidence: float | None = None) -> tuple[Message, ...]:
    """Make the messages for an accepted match: NAMED_VALUE_INT (252) `vpr_place`, NAMED_VALUE_FLOAT (251) `vpr_score`
    and, if `confidence` (0..1) is known, `vpr_conf`, the probability that the match is right."""
    return (
        mavlink.MAVLink_named_value_int_message(_boot_ms(t_mono_s), b"vpr_place", place_id),
        _named_float(t_mono_s, b"vpr_score", score),
        *((_named_float(t_mono_s, b"vpr_conf", confidence),) if confidence is not None else ()),
    )


def query_figures(t_mono_s: float, cpu_share: float, used_mah: float) -> tuple[Message, Message]:
    """Make two NAMED_VALUE_FLOAT (251) with the cost of a query: `vpr_cpu`, its share of all processor cores (0..1),
    and `vpr_mah`, the charge used so far in the flight (mAh)."""
    return (_named_float(t_mono_s, b"vpr_cpu", cpu_share), _named_float(t_mono_s, b"vpr_mah", used_mah))


def gps_distance(t_mono_s: float, off_m: float) -> Message:
    """Make a NAMED_VALUE_FLOAT (251) `vpr_gps_m`: the distance between GPS and an accepted match, metres."""
    return _named_float(t_mono_s, b"vpr_gps_m", off_m)


def source_set(number: int, target_system: int) -> Message:
    """Make a COMMAND_LONG (76) with SET_EKF_SOURCE_SET (42007): ArduPilot shall use source set `number` (1..3)."""
    return _command(target_system, mavlink.MAV_CMD_SET_EKF_SOURCE_SET, number)


def computer_status(
    t_mono_s: float,
    core_shares: Sequence[float],
    ram_used_bytes: int,
    ram_total_bytes: int,
    temperature_c: float | None = None,
) -> Message:
    """Make an ONBOARD_COMPUTER_STATUS (390): the load of each core (0..1; the first eight are sent), used and total RAM
    (sent in MiB), and the temperature in degrees Celsius (None: unknown)."""
    percents = [min(100, max(0, round(100 * share))) for share in core_shares[:8]]
    temperature = 127 if temperature_c is None else min(126, max(-128, round(temperature_c)))
    return mavlink.MAVLink_onboard_computer_status_message(
        time_usec=round(t_mono_s * 1e6),
        uptime=_boot_ms(t_mono_s),
        type=0,
        ram_usage=ram_used_bytes >> 20,
        ram_total=ram_total_bytes >> 20,
        cpu_cores=percents + [255] * (8 - len(percents)),
        temperature_core=[temperature] + [127] * 7,
        # The other fields are not measured; MAVLink marks that by the largest value of their type.
        cpu_combined=[255] * 10,
        gpu_cores=[255] * 4,
        gpu_combined=[255] * 10,
        temperature_board=127,
        fan_speed=[32_767] * 4,
        **{f"storage_{what}": [_UNUSED] * 4 for what in ("type", "usage", "total")},
        **{f"link_{what}": [_UNUSED] * 6 for what in ("type", "tx_rate", "rx_rate", "tx_max", "rx_max")},
    )


def status_text(severity: Severity, text: str) -> Message:
    """Make a STATUSTEXT (253), cut to 50 bytes.

    The text is not sent in chunks: if one chunk is lost, or the ground station knows no chunks, it cannot be read.
    """
    data = text.encode()
    if len(data) > TEXT_BYTES:
        data = data[: TEXT_BYTES - 3].decode(errors="ignore").encode() + b"..."
    return mavlink.MAVLink_statustext_message(severity, data)


_DENSE_US = 40_000  # an ArduPilot plane, whose loop runs fifty times a second, denies more than forty messages a second
_UNUSED = 2**32 - 1
# Only the right one: ArduPilot sends the pilot a text for each request of a message that it does not know.
_FILTER_REPORTS = {
    mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA: mavlink.MAVLINK_MSG_ID_EKF_STATUS_REPORT,
    mavlink.MAV_AUTOPILOT_PX4: mavlink.MAVLINK_MSG_ID_ESTIMATOR_STATUS,
}


def _command(target_system: int, command: int, first: float, second: float = 0) -> Message:
    return mavlink.MAVLink_command_long_message(target_system, AUTOPILOT, command, 0, first, second, 0, 0, 0, 0, 0)


def _named_float(t_mono_s: float, name: bytes, value: float) -> Message:
    return mavlink.MAVLink_named_value_float_message(_boot_ms(t_mono_s), name, value)


def _boot_ms(t_mono_s: float) -> int:
    return round(t_mono_s * 1000) % 2**32  # uint32: wraps after 49 days, as in every MAVLink system
