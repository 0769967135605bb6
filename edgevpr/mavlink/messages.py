"""Functions that make the messages we send, one for each kind: values in, a pymavlink message out; no I/O and no clock.

`t_mono_s` is a time of the system's monotonic clock in seconds. `stamp_s` is such a time by the receiver's clock:
ArduPilot keeps a single timestamp correction for all messages of a link, which a restart of our clock would corrupt."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

from edgevpr.core.geodesy import offset_m
from edgevpr.mavlink.wire import Message, mavlink, quaternion, rotmat

POSITION_FIX = mavlink.MAV_CMD_EXTERNAL_POSITION_ESTIMATE  # 43003
SET_SOURCE_SET = mavlink.MAV_CMD_SET_EKF_SOURCE_SET  # 42007
AUTOPILOT = mavlink.MAV_COMP_ID_AUTOPILOT1
MAX_TEXT_BYTES = 50
SENSOR_ID = 1  # `id` in message 296; must equal EKF2_AGP0_ID, whose value 0 would disable the slot
_YAW_SD_RAD = math.radians(5.0)
# A fallback must never outrank a real receiver with a 3D fix, which needs four satellites. At equal fix type ArduPilot
# switches to the receiver with more satellites, and blends by accuracy (AP_GPS::update_primary, AP_GPS_Blended).
_FALLBACK_SATELLITES = 2
_FALLBACK_SD_M = 100.0
_FALLBACK_SD_M_S = 10.0
_NORMAL_SATELLITES = 6  # the minimum for a filter to start, which also needs a dilution of precision of 2.5
_RANGE_SD_M = 2.0  # of a receiver; multiplied by the dilution of precision (HDOP), it is the error of the position
_GPS_EPOCH_S = 315_964_800  # 1980-01-06
_LEAP_S = 18  # leap seconds since the GPS epoch, as of 2017
_WEEK_S = 604_800


class Health(IntEnum):
    """State of this companion computer, reported in its heartbeat (MAV_STATE)."""

    BOOT = mavlink.MAV_STATE_BOOT
    STANDBY = mavlink.MAV_STATE_STANDBY  # paused by a ground station
    ACTIVE = mavlink.MAV_STATE_ACTIVE
    CRITICAL = mavlink.MAV_STATE_CRITICAL  # not working: no frames arrive, or the main loop hangs


class Severity(IntEnum):
    """Severity of a status text (MAV_SEVERITY)."""

    WARNING = mavlink.MAV_SEVERITY_WARNING
    NOTICE = mavlink.MAV_SEVERITY_NOTICE
    INFO = mavlink.MAV_SEVERITY_INFO


@dataclass(frozen=True, slots=True)
class Fix:
    """A fix: the vehicle's position at `t_frame_s`, when a frame was taken (monotonic clock). `accuracy_m`: standard
    deviation of one axis. Raises ValueError for an invalid position, accuracy or time."""

    lat_deg: float
    lon_deg: float
    accuracy_m: float
    t_frame_s: float

    def __post_init__(self) -> None:
        if not (abs(self.lat_deg) <= 90 and abs(self.lon_deg) <= 180):  # this form also rejects NaN
            raise ValueError(f"latitude {self.lat_deg}, longitude {self.lon_deg} is not a position on Earth")
        if not 0 < self.accuracy_m < math.inf:
            raise ValueError(f"the accuracy is {self.accuracy_m} m, but must be finite and above zero")
        if not math.isfinite(self.t_frame_s):
            raise ValueError(f"the frame time is {self.t_frame_s} s, but must be finite")


@dataclass(frozen=True, slots=True, kw_only=True)
class MotionState:
    """Position and motion of the vehicle at `t_mono_s`: altitude above sea level, velocity (east, north, down), and
    standard deviations (`accuracy_m` and `speed_accuracy_m_s` of one axis, `alt_accuracy_m` of the altitude).
    `attitude`: (roll, pitch, yaw) in radians, None if unknown. `is_fallback`: GPS is in use, so this is a fallback."""

    t_mono_s: float
    lat_deg: float
    lon_deg: float
    alt_m: float
    velocity_m_s: tuple[float, float, float]
    accuracy_m: float
    alt_accuracy_m: float
    speed_accuracy_m_s: float
    attitude: tuple[float, float, float] | None = None
    is_fallback: bool = False


def make_heartbeat(health: Health, kind: int = mavlink.MAV_TYPE_ONBOARD_CONTROLLER) -> Message:
    """Make the HEARTBEAT (0) of an onboard computer, or of another `kind` (MAV_TYPE)."""
    autopilot = mavlink.MAV_AUTOPILOT_INVALID
    return mavlink.MAVLink_heartbeat_message(kind, autopilot, 0, 0, system_status=health, mavlink_version=3)


def make_position_fix(fix: Fix, t_sent_s: float, target_system: int, stamp_s: float | None = None) -> Message:
    """Make a COMMAND_INT (75) with command 43003, in the form that ArduPilot accepts: global frame, no altitude (NaN).
    The processing time is the age of the fix, and the transmission time is `stamp_s` (None: `t_sent_s`), a float32
    with a resolution of 8 ms after one day."""
    return mavlink.MAVLink_command_int_message(
        target_system=target_system,
        target_component=AUTOPILOT,
        frame=mavlink.MAV_FRAME_GLOBAL,
        command=POSITION_FIX,
        current=0,
        autocontinue=0,
        param1=t_sent_s if stamp_s is None else stamp_s,
        param2=max(0.0, t_sent_s - fix.t_frame_s),
        param3=fix.accuracy_m,
        param4=math.nan,
        x=round(fix.lat_deg * 1e7),
        y=round(fix.lon_deg * 1e7),
        z=math.nan,
    )


def make_position_sensor(state: MotionState, target_system: int) -> Message:
    """Make a GLOBAL_POSITION_SENSOR (296): a position without altitude. PX4 uses its time of arrival."""
    return mavlink.MAVLink_global_position_sensor_message(
        target_system=target_system,
        target_component=AUTOPILOT,
        id=SENSOR_ID,
        time_usec=round(state.t_mono_s * 1e6),
        processing_time=0,
        source=mavlink.GLOBAL_POSITION_SRC_VISION,
        flags=0,
        lat=round(state.lat_deg * 1e7),
        lon=round(state.lon_deg * 1e7),
        alt=math.nan,
        alt_ellipsoid=math.nan,
        eph=state.accuracy_m,
        epv=math.nan,
    )


def make_gps_input(state: MotionState | None, receiver: int, stamp_s: float, t_unix_s: float | None) -> Message:
    """Make a GPS_INPUT (232) for the `receiver` (0: the first). A `state` of None is sent as "no fix", a fallback
    (`is_fallback`) as a poor fix. `stamp_s`: time of the state. `t_unix_s`: in seconds since 1970 (None: unknown)."""
    week, time_of_week_s = (0, 0) if t_unix_s is None else divmod(t_unix_s - _GPS_EPOCH_S + _LEAP_S, _WEEK_S)
    east, north, down = state.velocity_m_s if state else (0, 0, 0)
    satellites, sd_m, sd_m_s = 0, 0.0, 0.0
    if state:
        satellites, sd_m, sd_m_s = _NORMAL_SATELLITES, state.accuracy_m, state.speed_accuracy_m_s
    if state and state.is_fallback:
        satellites, sd_m, sd_m_s = _FALLBACK_SATELLITES, _FALLBACK_SD_M, _FALLBACK_SD_M_S
    return mavlink.MAVLink_gps_input_message(
        time_usec=round(stamp_s * 1e6),
        gps_id=receiver,
        ignore_flags=mavlink.GPS_INPUT_IGNORE_FLAG_VDOP,
        time_week_ms=int(time_of_week_s * 1000),
        time_week=int(week),
        fix_type=mavlink.GPS_FIX_TYPE_3D_FIX if state else mavlink.GPS_FIX_TYPE_NO_FIX,
        hdop=sd_m / _RANGE_SD_M,
        vdop=0.0,
        satellites_visible=satellites,
        lat=round(state.lat_deg * 1e7) if state else 0,
        lon=round(state.lon_deg * 1e7) if state else 0,
        alt=state.alt_m if state else 0,
        vn=north,
        ve=east,
        vd=down,
        speed_accuracy=sd_m_s,
        horiz_accuracy=sd_m,
        vert_accuracy=state.alt_accuracy_m if state else 0,
    )


def make_odometry(
    state: MotionState, attitude: tuple[float, float, float], origin: tuple[float, float, float], stamp_s: float
) -> Message:
    """Make an ODOMETRY (331) in the only frames that ArduPilot accepts: position north, east, down relative to `origin`
    (latitude, longitude in degrees, altitude in metres above sea level), velocity in the body frame. `attitude`:
    (roll, pitch, yaw) in radians. ArduPilot computes a standard deviation as the cube root of the sum of the squared
    variances (`GCS_MAVLINK::handle_odometry`), so we send variances that give the correct one. The variance of the
    height, which we do not measure, is zero."""
    east, north, down = state.velocity_m_s
    to_earth = rotmat.Matrix3()
    to_earth.from_euler(*attitude)
    velocity = to_earth.transposed() * rotmat.Vector3(north, east, down)  # forward, right, down
    # Upper triangle of the 6 x 6 covariance, row by row: only the diagonal is known.
    pose_variances, velocity_variances = [0.0] * 21, [0.0] * 21
    pose_variances[0] = pose_variances[6] = math.sqrt(state.accuracy_m**3 / 2)
    pose_variances[20] = math.sqrt(_YAW_SD_RAD**3)
    velocity_variances[0] = velocity_variances[6] = velocity_variances[11] = state.speed_accuracy_m_s**2
    return _complete_odometry(
        state,
        origin,
        time_usec=round(stamp_s * 1e6),
        frame_id=mavlink.MAV_FRAME_LOCAL_FRD,
        q=list(quaternion.QuaternionBase(list(attitude)).q),  # from the body frame to north, east, down; w, x, y, z
        vx=velocity.x,
        vy=velocity.y,
        vz=velocity.z,
        pose_covariance=pose_variances,
        velocity_covariance=velocity_variances,
    )


def make_vision_position(state: MotionState, origin: tuple[float, float, float]) -> Message:
    """Make an ODOMETRY (331) with only a position, north, east, down relative to `origin` (latitude, longitude in
    degrees, altitude in metres above sea level). PX4 synchronises with our clock by our answers to its TIMESYNC."""
    variances = [math.nan] * 21  # upper triangle of the 6 x 6 covariance, row by row
    variances[0] = variances[6] = state.accuracy_m**2
    variances[11] = state.alt_accuracy_m**2
    return _complete_odometry(
        state,
        origin,
        time_usec=round(state.t_mono_s * 1e6),
        frame_id=mavlink.MAV_FRAME_LOCAL_NED,
        q=[math.nan] * 4,
        vx=math.nan,
        vy=math.nan,
        vz=math.nan,
        pose_covariance=variances,
        velocity_covariance=[math.nan] * 21,
    )


def _complete_odometry(state: MotionState, origin: tuple[float, float, float], **fields: Any) -> Message:
    """Make an ODOMETRY from the position of a state relative to `origin`, and the channel's own `fields`."""
    east_m, north_m = offset_m(origin[0], origin[1], state.lat_deg, state.lon_deg)
    return mavlink.MAVLink_odometry_message(
        child_frame_id=mavlink.MAV_FRAME_BODY_FRD,
        x=float(north_m),
        y=float(east_m),
        z=origin[2] - state.alt_m,
        rollspeed=math.nan,
        pitchspeed=math.nan,
        yawspeed=math.nan,
        reset_counter=0,
        estimator_type=mavlink.MAV_ESTIMATOR_TYPE_VISION,
        quality=100,
        **fields,
    )


def make_report_requests(target_system: int, firmware: int, is_continuous: bool = False) -> tuple[Message, ...]:
    """Make the requests for all reports that the flight needs, each a COMMAND_LONG (76) with SET_MESSAGE_INTERVAL
    (511). `firmware`: a MAV_AUTOPILOT. A continuous channel (`is_continuous`) needs more reports, at higher rates."""
    rates_hz = _rates_hz(is_continuous)
    if firmware in FILTER_REPORTS:
        rates_hz[FILTER_REPORTS[firmware]] = 2
    return _make_interval_requests(target_system, rates_hz)


def make_gps_requests(target_system: int) -> tuple[Message, ...]:
    """Make the requests for the reports of the GPS receivers alone."""
    return _make_interval_requests(target_system, _GPS_REPORTS_HZ)


def attitude_hz(is_continuous: bool) -> int:
    """Return the rate in Hz at which `make_report_requests` requests attitudes."""
    return _rates_hz(is_continuous)[mavlink.MAVLINK_MSG_ID_ATTITUDE]


def make_message_request(target_system: int, message_id: int) -> Message:
    """Make a COMMAND_LONG (76) with REQUEST_MESSAGE (512): request message `message_id` once."""
    return _make_command(target_system, mavlink.MAV_CMD_REQUEST_MESSAGE, message_id)


def make_parameter_request(target_system: int, name: str) -> Message:
    """Make a PARAM_REQUEST_READ (20) for the parameter of this name."""
    return mavlink.MAVLink_param_request_read_message(target_system, AUTOPILOT, name.encode(), -1)


def make_origin(target_system: int, lat_deg: float, lon_deg: float, alt_m: float) -> Message:
    """Make a SET_GPS_GLOBAL_ORIGIN (48): the origin of the autopilot's local frame, `alt_m` above sea level."""
    position = round(lat_deg * 1e7), round(lon_deg * 1e7), round(alt_m * 1e3)
    return mavlink.MAVLink_set_gps_global_origin_message(target_system, *position)


def make_named_values(t_mono_s: float, **values: float | None) -> tuple[Message, ...]:
    """Make a NAMED_VALUE_INT (252) for each integer and a NAMED_VALUE_FLOAT (251) for each other number; unknown values
    (None) are omitted. docs/reference/ground-station.md lists the names, which have at most 10 letters."""
    boot_ms = _boot_ms(t_mono_s)
    return tuple(
        mavlink.MAVLink_named_value_int_message(boot_ms, name.encode(), value)
        if isinstance(value, int)
        else mavlink.MAVLink_named_value_float_message(boot_ms, name.encode(), value)
        for name, value in values.items()
        if value is not None
    )


def make_source_set(number: int, target_system: int) -> Message:
    """Make a COMMAND_LONG (76) with SET_EKF_SOURCE_SET (42007): make ArduPilot use source set `number` (1..3)."""
    return _make_command(target_system, SET_SOURCE_SET, number)


def make_computer_status(
    t_mono_s: float, loads: Sequence[float], ram_used_bytes: int, ram_total_bytes: int, temperature_c: float | None
) -> Message:
    """Make an ONBOARD_COMPUTER_STATUS (390) from the load of each core (0..1; the first eight are sent), used and total
    RAM (sent in MiB), and the temperature in degrees Celsius (None: unknown)."""
    percents = [min(100, max(0, round(100 * load))) for load in loads[:8]]
    temperature = 127 if temperature_c is None else min(126, max(-128, round(temperature_c)))
    return mavlink.MAVLink_onboard_computer_status_message(
        time_usec=round(t_mono_s * 1e6),
        uptime=_boot_ms(t_mono_s),
        type=0,
        ram_usage=ram_used_bytes >> 20,
        ram_total=ram_total_bytes >> 20,
        cpu_cores=percents + [255] * (8 - len(percents)),
        temperature_core=[temperature] + [127] * 7,
        # The other fields are not measured: MAVLink encodes this as the largest value of their type.
        cpu_combined=[255] * 10,
        gpu_cores=[255] * 4,
        gpu_combined=[255] * 10,
        temperature_board=127,
        fan_speed=[32_767] * 4,
        **{f"storage_{field}": [_UNKNOWN_UINT32] * 4 for field in ("type", "usage", "total")},
        **{f"link_{field}": [_UNKNOWN_UINT32] * 6 for field in ("type", "tx_rate", "rx_rate", "tx_max", "rx_max")},
    )


def make_status_text(severity: Severity, text: str) -> Message:
    """Make a STATUSTEXT (253), truncated to 50 bytes: not every ground station supports text in chunks."""
    data = text.encode()
    if len(data) > MAX_TEXT_BYTES:
        data = data[: MAX_TEXT_BYTES - 3].decode(errors="ignore").encode() + b"..."
    return mavlink.MAVLink_statustext_message(severity, data)


_GPS_REPORTS_HZ = {mavlink.MAVLINK_MSG_ID_GPS_RAW_INT: 5, mavlink.MAVLINK_MSG_ID_GPS2_RAW: 5}
_REPORTS_HZ = _GPS_REPORTS_HZ | {
    mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: 10,
    mavlink.MAVLINK_MSG_ID_ATTITUDE: 10,
    mavlink.MAVLINK_MSG_ID_DISTANCE_SENSOR: 2,
    mavlink.MAVLINK_MSG_ID_TERRAIN_REPORT: 2,
}
# An ArduPilot plane, whose loop runs at 50 Hz, denies rates above 40 Hz.
_CONTINUOUS_HZ = {
    mavlink.MAVLINK_MSG_ID_ATTITUDE: 25,
    mavlink.MAVLINK_MSG_ID_SCALED_IMU: 25,
    mavlink.MAVLINK_MSG_ID_SYSTEM_TIME: 1,
    mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN: 1,
}
_UNKNOWN_UINT32 = 2**32 - 1
# Request only the firmware's own report: ArduPilot sends the pilot a text for each request of an unknown message.
FILTER_REPORTS = {
    mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA: mavlink.MAVLINK_MSG_ID_EKF_STATUS_REPORT,
    mavlink.MAV_AUTOPILOT_PX4: mavlink.MAVLINK_MSG_ID_ESTIMATOR_STATUS,
}


def _rates_hz(is_continuous: bool) -> dict[int, int]:
    return _REPORTS_HZ | (_CONTINUOUS_HZ if is_continuous else {})


def _make_interval_requests(target_system: int, rates_hz: Mapping[int, int]) -> tuple[Message, ...]:
    interval = mavlink.MAV_CMD_SET_MESSAGE_INTERVAL
    return tuple(_make_command(target_system, interval, number, 1e6 / rate_hz) for number, rate_hz in rates_hz.items())


def _make_command(target_system: int, command: int, first: float, second: float = 0) -> Message:
    return mavlink.MAVLink_command_long_message(target_system, AUTOPILOT, command, 0, first, second, 0, 0, 0, 0, 0)


def _boot_ms(t_mono_s: float) -> int:
    return round(t_mono_s * 1000) % 2**32  # uint32: wraps after 49 days, as in every MAVLink system
