"""The messages in which a simulated autopilot reports its state: one function for each, from a `Firmware` to the
message, or None if there is nothing to report. Used by `controller`."""

import math
from collections.abc import Callable

from edgevpr.mavlink.wire import Message, mavlink
from simulated.firmware import Firmware
from simulated.motion import GRAVITY_M_S2, compute_tilt
from simulated.sensors import NOTHING, PositionMeasurement

Report = Callable[[Firmware], Message | None]
_UNKNOWN_16 = 65_535
_MAX_CM_S = 32_767
_CAPABILITIES = (
    mavlink.MAV_PROTOCOL_CAPABILITY_COMMAND_INT
    | mavlink.MAV_PROTOCOL_CAPABILITY_MAVLINK2
    | mavlink.MAV_PROTOCOL_CAPABILITY_MISSION_INT
)


def _heartbeat(brain: Firmware) -> Message:
    return mavlink.MAVLink_heartbeat_message(
        type=brain.vehicle_type,
        autopilot=brain.number,
        base_mode=mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED | mavlink.MAV_MODE_FLAG_SAFETY_ARMED,
        custom_mode=0,
        system_status=mavlink.MAV_STATE_ACTIVE,
        mavlink_version=3,
    )


def _position(brain: Firmware) -> Message | None:
    """Report the position: without one ArduPilot reports 0, 0, 0 and a true height above home, and PX4 nothing."""
    has_position = brain.origin is not None and brain.motion.is_known
    if not has_position and brain.number == mavlink.MAV_AUTOPILOT_PX4:
        return None
    truth, point, velocity_m_s = brain.truth, brain.point, brain.velocity_m_s
    position = [round(point[0] * 1e7), round(point[1] * 1e7), round(truth.alt_m * 1e3)]
    ned_m_s = velocity_m_s.imag, velocity_m_s.real, -truth.climb_m_s
    return mavlink.MAVLink_global_position_int_message(
        _boot_ms(brain),
        *(position if has_position else [0, 0, 0]),
        0 if math.isnan(truth.height_m) else round(truth.height_m * 1e3),
        *(max(-_MAX_CM_S, min(_MAX_CM_S, round(100 * speed_m_s))) for speed_m_s in ned_m_s),
        _UNKNOWN_16 if math.isnan(truth.heading_deg) else round(math.degrees(_compute_yaw(brain)) * 100) % 36_000,
    )


def _attitude(brain: Firmware) -> Message | None:
    """Report the estimated attitude: the true one and, of a vehicle that obeys its estimate, the error of that."""
    truth = brain.truth
    roll_deg, pitch_deg = truth.roll_deg, truth.pitch_deg
    if brain.tilt:
        roll_deg, pitch_deg = compute_tilt(truth.acceleration_m_s2 + GRAVITY_M_S2 * brain.tilt, truth.heading_deg)
    if math.isnan(roll_deg + pitch_deg):  # the track does not say
        return None
    roll, pitch = math.radians(roll_deg), math.radians(pitch_deg)
    turn_rad_s = 0.0 if math.isnan(brain.turn_rad_s) else brain.turn_rad_s * math.cos(pitch)
    rates_rad_s = 0.0, turn_rad_s * math.sin(roll), turn_rad_s * math.cos(roll)  # as gyros measure them
    return mavlink.MAVLink_attitude_message(_boot_ms(brain), roll, pitch, _compute_yaw(brain), *rates_rad_s)


def _specific_force(brain: Firmware) -> Message:
    """Report the specific force, in milli-g: a vehicle without drag feels its thrust, along its vertical axis."""
    force_g = math.hypot(1.0, abs(brain.truth.acceleration_m_s2) / GRAVITY_M_S2)
    return mavlink.MAVLink_scaled_imu_message(_boot_ms(brain), 0, 0, -round(1000 * force_g), *[0] * 6)


def _gps(report: PositionMeasurement, brain: Firmware) -> dict[str, int]:
    """Return the fields that GPS_RAW_INT and GPS2_RAW share."""
    report = report if brain.motion.is_known else NOTHING
    velocity_m_s = report.velocity_m_s or 0j
    return {
        "time_usec": round(report.t_s * 1e6),
        "fix_type": report.fix_type,
        "lat": round(report.point[0] * 1e7),
        "lon": round(report.point[1] * 1e7),
        "alt": round(report.alt_m * 1e3),
        "eph": 121,
        "epv": 200,
        "vel": min(_UNKNOWN_16 - 1, round(abs(velocity_m_s) * 100)),
        "cog": round(math.degrees(math.atan2(velocity_m_s.real, velocity_m_s.imag)) % 360 * 100) % 36_000,
        "satellites_visible": report.satellites,
        "h_acc": round(report.sd_m * 1e3),
        "v_acc": round(report.sd_m * 1e3),
        "vel_acc": round(report.speed_sd_m_s * 1e3),
    }


def _second_gps(brain: Firmware) -> Message | None:
    fields = _gps(brain.receivers.reports[1], brain)
    has_second = brain.receivers.has_second
    return mavlink.MAVLink_gps2_raw_message(**fields, dgps_numch=0, dgps_age=0) if has_second else None


def _origin(brain: Firmware) -> Message | None:
    if brain.origin is None or not brain.motion.is_known:
        return None
    lat_deg, lon_deg, alt_m = brain.origin
    return mavlink.MAVLink_gps_global_origin_message(round(lat_deg * 1e7), round(lon_deg * 1e7), round(alt_m * 1e3))


def _version(brain: Firmware) -> Message:
    is_px4 = brain.number == mavlink.MAV_AUTOPILOT_PX4
    capabilities = _CAPABILITIES | (mavlink.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_BYTEWISE if is_px4 else 0)
    return mavlink.MAVLink_autopilot_version_message(capabilities, brain.version, 0, 0, 0, *[[0] * 8] * 3, 0, 0, 0)


def _ekf_status(brain: Firmware) -> Message:
    return mavlink.MAVLink_ekf_status_report_message(brain.flags(), 0.05, brain.test_ratio, 0.05, 0.02, 0.0)


def _estimator_status(brain: Firmware) -> Message:
    both_m = math.sqrt(2) * brain.estimator.sd_m if brain.origin else 0.0
    ratios = brain.velocity_ratio, brain.test_ratio, 0.1, 0.1, 0.0, 0.0
    return mavlink.MAVLink_estimator_status_message(round(brain.now_s * 1e6), brain.flags(), *ratios, both_m, 0.5)


REPORTS: dict[int, Report] = {
    mavlink.MAVLINK_MSG_ID_HEARTBEAT: _heartbeat,
    mavlink.MAVLINK_MSG_ID_SYSTEM_TIME: lambda brain: mavlink.MAVLink_system_time_message(
        round((brain.start_utc_s + brain.now_s) * 1e6), _boot_ms(brain)
    ),
    mavlink.MAVLINK_MSG_ID_GPS_RAW_INT: lambda brain: mavlink.MAVLink_gps_raw_int_message(
        **_gps(brain.receivers.reports[0], brain)
    ),
    mavlink.MAVLINK_MSG_ID_SCALED_IMU: _specific_force,
    mavlink.MAVLINK_MSG_ID_ATTITUDE: _attitude,
    mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: _position,
    mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN: _origin,
    mavlink.MAVLINK_MSG_ID_GPS2_RAW: _second_gps,
    mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION: _version,
    # Known, but there is no such sensor.
    mavlink.MAVLINK_MSG_ID_DISTANCE_SENSOR: lambda brain: None,
    mavlink.MAVLINK_MSG_ID_TERRAIN_REPORT: lambda brain: None,
}
# Each firmware has its own report of its filter, and does not know the other's.
FILTER_REPORTS: dict[int, Report] = {
    mavlink.MAVLINK_MSG_ID_EKF_STATUS_REPORT: _ekf_status,
    mavlink.MAVLINK_MSG_ID_ESTIMATOR_STATUS: _estimator_status,
}


def _boot_ms(brain: Firmware) -> int:
    return round(brain.now_s * 1000) % 2**32


def _compute_yaw(brain: Firmware) -> float:
    """Return the estimated yaw in radians, -pi..pi; 0 where the heading is unknown."""
    yaw = math.radians(brain.truth.heading_deg + brain.heading_error_deg)
    return 0.0 if math.isnan(yaw) else math.remainder(yaw, math.tau)
