"""The messages in which a simulated autopilot reports its state: one function for each, from a `Firmware` (`brain`) to
the message, or None if there is nothing to report. `SILENT` are messages that exist but are never sent. Used by
`controller`."""

import math
from collections.abc import Callable

from edgevpr.lab.simulate.firmware import Firmware
from edgevpr.lab.simulate.motion import GRAVITY_M_S2, TrueState, tilt_for
from edgevpr.lab.simulate.sensors import NO_FIX, NOTHING, PositionMeasurement
from edgevpr.mavlink.wire import Message, mavlink

Report = Callable[[Firmware], Message | None]
_UNKNOWN_16 = 65_535
_CAPABILITIES = (
    mavlink.MAV_PROTOCOL_CAPABILITY_COMMAND_INT
    | mavlink.MAV_PROTOCOL_CAPABILITY_MAVLINK2
    | mavlink.MAV_PROTOCOL_CAPABILITY_MISSION_INT
)


def _heartbeat(brain: Firmware) -> Message:
    armed = mavlink.MAV_MODE_FLAG_SAFETY_ARMED if brain.is_armed else 0
    return mavlink.MAVLink_heartbeat_message(
        type=brain.vehicle_type,
        autopilot=brain.number,
        base_mode=mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED | armed,
        custom_mode=0,
        system_status=mavlink.MAV_STATE_ACTIVE if brain.is_armed else mavlink.MAV_STATE_STANDBY,
        mavlink_version=3,
    )


def _position(brain: Firmware) -> Message | None:
    if brain.origin is None:
        return None
    truth, (lat_deg, lon_deg), over_ground_m_s = brain.truth, brain.place, brain.velocity_m_s
    ned_m_s = over_ground_m_s.imag, over_ground_m_s.real, -truth.climb_m_s
    north_cm_s, east_cm_s, down_cm_s = (max(-32_768, min(32_767, round(100 * each))) for each in ned_m_s)
    return mavlink.MAVLink_global_position_int_message(
        time_boot_ms=_boot_ms(brain),
        lat=round(lat_deg * 1e7),
        lon=round(lon_deg * 1e7),
        alt=round(truth.alt_m * 1e3),
        relative_alt=0 if math.isnan(truth.height_m) else round(truth.height_m * 1e3),
        vx=north_cm_s,
        vy=east_cm_s,
        vz=down_cm_s,
        hdg=_UNKNOWN_16 if math.isnan(truth.heading_deg) else round(truth.heading_deg * 100) % 36_000,
    )


def _attitude(brain: Firmware) -> Message | None:
    """The estimated attitude: the true one and, of a vehicle that obeys its estimate, the error of that."""
    truth = brain.truth
    roll_deg, pitch_deg = truth.roll_deg, truth.pitch_deg
    if brain.tilt:
        roll_deg, pitch_deg = tilt_for(truth.acceleration_m_s2 + GRAVITY_M_S2 * brain.tilt, truth.heading_deg)
    if math.isnan(roll_deg + pitch_deg):  # the track does not say
        return None
    roll, pitch = math.radians(roll_deg), math.radians(pitch_deg)
    return mavlink.MAVLink_attitude_message(_boot_ms(brain), roll, pitch, yaw_of(truth), 0, 0, 0)


def _felt(brain: Firmware) -> Message:
    """The specific force, in milli-g: a vehicle without drag feels its thrust, along its vertical axis."""
    felt_g = math.hypot(1.0, abs(brain.truth.acceleration_m_s2) / GRAVITY_M_S2)
    return mavlink.MAVLink_scaled_imu_message(_boot_ms(brain), 0, 0, -round(1000 * felt_g), *[0] * 6)


def _second_gps(brain: Firmware) -> Message | None:
    second = _gps(brain.receivers.second, brain)
    has_second = brain.receivers.has_second
    return mavlink.MAVLink_gps2_raw_message(**second, dgps_numch=0, dgps_age=0) if has_second else None


def _gps(last: PositionMeasurement, brain: Firmware) -> dict[str, int]:
    if last is NOTHING or not brain.motion.is_known:  # a second GPS that is silent
        lost = {"lat": 0, "lon": 0, "alt": 0, "eph": 9999, "epv": 9999, "vel": 0, "cog": 0}
        return {"time_usec": 0, "fix_type": NO_FIX, **lost, "satellites_visible": 0}
    velocity_m_s = last.velocity_m_s or 0j
    return {
        "time_usec": round((last.t_s - brain.booted_s) * 1e6),
        "fix_type": last.fix_type,
        "lat": round(last.lat_deg * 1e7),
        "lon": round(last.lon_deg * 1e7),
        "alt": round(last.alt_m * 1e3),
        "eph": 121,
        "epv": 200,
        "vel": min(_UNKNOWN_16 - 1, round(abs(velocity_m_s) * 100)),
        "cog": round(math.degrees(math.atan2(velocity_m_s.real, velocity_m_s.imag)) % 360 * 100) % 36_000,
        "satellites_visible": last.satellites,
        "h_acc": round(last.sd_m * 1e3),
        "v_acc": round(last.sd_m * 1e3),
        "vel_acc": round(last.speed_sd_m_s * 1e3),
    }


def _origin(brain: Firmware) -> Message | None:
    if brain.origin is None:
        return None
    lat_deg, lon_deg, alt_m = brain.origin
    return mavlink.MAVLink_gps_global_origin_message(round(lat_deg * 1e7), round(lon_deg * 1e7), round(alt_m * 1e3))


def _version(brain: Firmware) -> Message:
    is_px4 = brain.number == mavlink.MAV_AUTOPILOT_PX4
    capabilities = _CAPABILITIES | (mavlink.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_BYTEWISE if is_px4 else 0)
    return mavlink.MAVLink_autopilot_version_message(capabilities, brain.version, 0, 0, 0, *[[0] * 8] * 3, 0, 0, 0)


def _estimator_status(brain: Firmware) -> Message:
    both_m = math.sqrt(2) * brain.sd_m if brain.origin else 0.0
    return mavlink.MAVLink_estimator_status_message(
        round(brain.boot_s * 1e6),
        brain.flags(),
        brain.velocity_ratio,
        brain.test_ratio,
        0.1,
        0.1,
        0.0,
        0.0,
        both_m,
        0.5,
    )


REPORTS: dict[int, Report] = {
    mavlink.MAVLINK_MSG_ID_HEARTBEAT: _heartbeat,
    mavlink.MAVLINK_MSG_ID_SYSTEM_TIME: lambda brain: mavlink.MAVLink_system_time_message(
        round((brain.start_utc_s + brain.now_s) * 1e6), _boot_ms(brain)
    ),
    mavlink.MAVLINK_MSG_ID_GPS_RAW_INT: lambda brain: mavlink.MAVLink_gps_raw_int_message(
        **_gps(brain.receivers.first, brain)
    ),
    mavlink.MAVLINK_MSG_ID_SCALED_IMU: _felt,
    mavlink.MAVLINK_MSG_ID_ATTITUDE: _attitude,
    mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: _position,
    mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN: _origin,
    mavlink.MAVLINK_MSG_ID_GPS2_RAW: _second_gps,
    mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION: _version,
}
# Each firmware has its own report of its filter, and does not know the other's.
FILTER_REPORTS: dict[int, Report] = {
    mavlink.MAVLINK_MSG_ID_EKF_STATUS_REPORT: lambda brain: mavlink.MAVLink_ekf_status_report_message(
        brain.flags(), 0.05, brain.test_ratio, 0.05, 0.02, 0.0
    ),
    mavlink.MAVLINK_MSG_ID_ESTIMATOR_STATUS: _estimator_status,
}
# Known, but there is no such sensor.
SILENT = {mavlink.MAVLINK_MSG_ID_DISTANCE_SENSOR, mavlink.MAVLINK_MSG_ID_TERRAIN_REPORT}


def _boot_ms(brain: Firmware) -> int:
    return round(brain.boot_s * 1000) % 2**32


def yaw_of(truth: TrueState) -> float:
    """Return the yaw in radians, -pi..pi; 0 where the heading is unknown."""
    return 0.0 if math.isnan(truth.heading_deg) else math.remainder(math.radians(truth.heading_deg), math.tau)
