"""Functions that make the messages of the channels other than command 43003: message 296 for single fixes, GPS_INPUT
and ODOMETRY for a continuous position. Like `messages`: values in, a message out. Used by `conversation`."""

import math
from dataclasses import dataclass

from edgevpr.core.geodesy import offset_m
from edgevpr.mavlink.messages import Fix
from edgevpr.mavlink.wire import Message, mavlink

SENSOR_ID = 1  # the `id` in our messages 296, equal to EKF2_AGP0_ID, whose value 0 would switch the slot off
_YAW_SD = math.radians(5.0)
_GPS_EPOCH_S, _LEAP_S = 315_964_800, 18  # 1980-01-06; leap seconds since then, as of 2017


@dataclass(frozen=True, slots=True, kw_only=True)
class MotionState:
    """Position and motion of the vehicle at `t_mono_s`: altitude above sea level, velocity (east, north, down), and
    standard deviations (`accuracy_m` and `speed_accuracy_m_s` of one axis, `alt_accuracy_m` of the altitude).
    `attitude` is (roll, pitch, yaw) in radians, None if unknown."""

    t_mono_s: float
    lat_deg: float
    lon_deg: float
    alt_m: float
    velocity_m_s: tuple[float, float, float]
    accuracy_m: float
    alt_accuracy_m: float
    speed_accuracy_m_s: float
    attitude: tuple[float, float, float] | None = None


def position_sensor(fix: Fix, t_sent_s: float) -> Message:
    """Make a GLOBAL_POSITION_SENSOR (296): a position found by vision, without altitude. PX4 ignores its time stamp: it
    subtracts a delay, a parameter of its own, from the time of arrival."""
    return mavlink.MAVLink_global_position_sensor_message(
        target_system=0,
        target_component=0,
        id=SENSOR_ID,
        time_usec=round(t_sent_s * 1e6),
        processing_time=0,
        source=mavlink.GLOBAL_POSITION_SRC_VISION,
        flags=0,
        lat=round(fix.lat_deg * 1e7),
        lon=round(fix.lon_deg * 1e7),
        alt=math.nan,
        alt_ellipsoid=math.nan,
        eph=fix.accuracy_m,
        epv=math.nan,
    )


def gps_input(state: MotionState | None, receiver: int, t_mono_s: float, t_unix_s: float | None) -> Message:
    """Make a GPS_INPUT (232) as GPS receiver number `receiver` (0: the first). A `state` of None is sent as "no fix".
    `t_mono_s` is the time of the state, `t_unix_s` the same time in UTC, seconds since 1970 (None: unknown)."""
    week, week_ms = _gps_time(t_unix_s)
    ignored = mavlink.GPS_INPUT_IGNORE_FLAG_HDOP | mavlink.GPS_INPUT_IGNORE_FLAG_VDOP
    east, north, down = state.velocity_m_s if state else (0, 0, 0)
    return mavlink.MAVLink_gps_input_message(
        time_usec=round(t_mono_s * 1e6),
        gps_id=receiver,
        ignore_flags=ignored,
        time_week_ms=week_ms,
        time_week=week,
        fix_type=mavlink.GPS_FIX_TYPE_3D_FIX if state else mavlink.GPS_FIX_TYPE_NO_FIX,
        hdop=0.0,
        vdop=0.0,
        # The smallest number with which a filter starts, so that a real receiver is always preferred.
        satellites_visible=6 if state else 0,
        lat=round(state.lat_deg * 1e7) if state else 0,
        lon=round(state.lon_deg * 1e7) if state else 0,
        alt=state.alt_m if state else 0,
        vn=north,
        ve=east,
        vd=down,
        speed_accuracy=state.speed_accuracy_m_s if state else 0,
        horiz_accuracy=state.accuracy_m if state else 0,
        vert_accuracy=state.alt_accuracy_m if state else 0,
    )


def odometry(state: MotionState, attitude: tuple[float, float, float], origin: tuple[float, float, float]) -> Message:
    """Make an ODOMETRY (331) in the only frames that ArduPilot accepts: position north, east, down of `origin`
    (latitude, longitude in degrees, altitude in metres above sea level), velocity along the axes of the airframe.
    `attitude` is (roll, pitch, yaw) in radians and must not contain NaN.

    ArduPilot computes a standard deviation as the cube root of the sum of the squared variances
    (`GCS_MAVLINK::handle_odometry`, 4.7-dev); the variances sent are those from which it gets the right one. That of
    the height is sent as zero, because the height is not measured by us.
    """
    east_m, north_m = offset_m(origin[0], origin[1], state.lat_deg, state.lon_deg)
    roll, pitch, yaw = attitude
    east, north, down = state.velocity_m_s
    vx, vy, vz = _along_airframe((north, east, down), roll, pitch, yaw)
    # The upper triangle of 6 x 6, row by row: only its diagonal is known.
    pose, velocity = [0.0] * 21, [0.0] * 21
    pose[0] = pose[6] = math.sqrt(state.accuracy_m**3 / 2)
    pose[20] = math.sqrt(_YAW_SD**3)
    velocity[0] = velocity[6] = velocity[11] = state.speed_accuracy_m_s**2
    return mavlink.MAVLink_odometry_message(
        time_usec=round(state.t_mono_s * 1e6),
        frame_id=mavlink.MAV_FRAME_LOCAL_FRD,
        child_frame_id=mavlink.MAV_FRAME_BODY_FRD,
        x=float(north_m),
        y=float(east_m),
        z=origin[2] - state.alt_m,
        q=_quaternion(roll, pitch, yaw),
        vx=vx,
        vy=vy,
        vz=vz,
        rollspeed=math.nan,
        pitchspeed=math.nan,
        yawspeed=math.nan,
        pose_covariance=pose,
        velocity_covariance=velocity,
        reset_counter=0,
        estimator_type=mavlink.MAV_ESTIMATOR_TYPE_VISION,
        quality=100,
    )


def _gps_time(t_unix_s: float | None) -> tuple[int, int]:
    """Return the time of GPS (0, 0 if `t_unix_s` is None):
    - number of the week;
    - millisecond in the week.
    """
    if t_unix_s is None:
        return 0, 0
    weeks, rest_s = divmod(t_unix_s - _GPS_EPOCH_S + _LEAP_S, 604_800)
    return int(weeks), int(rest_s * 1000)


def _quaternion(roll: float, pitch: float, yaw: float) -> list[float]:
    """Return the rotation from the airframe to north, east, down as a quaternion [w, x, y, z]. Angles in radians."""
    (cr, sr), (cp, sp), (cy, sy) = ((math.cos(each / 2), math.sin(each / 2)) for each in (roll, pitch, yaw))
    return [
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    ]


def _along_airframe(
    velocity: tuple[float, float, float], roll: float, pitch: float, yaw: float
) -> tuple[float, float, float]:
    """Rotate a velocity (north, east, down) to the axes of the airframe (nose, right, down). Angles in radians."""
    north, east, down = velocity
    ahead, right = north * math.cos(yaw) + east * math.sin(yaw), east * math.cos(yaw) - north * math.sin(yaw)
    ahead, down = ahead * math.cos(pitch) - down * math.sin(pitch), ahead * math.sin(pitch) + down * math.cos(pitch)
    return ahead, right * math.cos(roll) + down * math.sin(roll), down * math.cos(roll) - right * math.sin(roll)
