"""Messages of a continuous position, as they are read at the other end."""

import math

import numpy as np
import pytest

from edgevpr.core.geodesy import moved
from edgevpr.mavlink.messages import Fix
from edgevpr.mavlink.positions import SENSOR_ID, MotionState, gps_input, odometry, position_sensor
from edgevpr.mavlink.wire import PacketReader, mavlink

STATE = MotionState(
    t_mono_s=100.0,
    lat_deg=47.1234567,
    lon_deg=8.7654321,
    alt_m=512.3,
    velocity_m_s=(3.0, -4.0, 0.5),
    accuracy_m=2.5,
    alt_accuracy_m=3.0,
    speed_accuracy_m_s=0.4,
    attitude=(0.1, -0.2, 1.3),
)


def received(message):
    (heard,) = PacketReader().feed(message.pack(mavlink.MAVLink(None, 1, 197)))
    return heard


def test_a_receiver_says_position_velocity_and_what_they_are_good_to():
    heard = received(gps_input(STATE, 1, 100.0, 1_700_000_000.25))
    assert (heard.gps_id, heard.fix_type, heard.lat, heard.lon) == (1, 3, 471234567, 87654321)
    assert (heard.ve, heard.vn, heard.vd) == (3.0, -4.0, 0.5)
    assert (heard.horiz_accuracy, heard.vert_accuracy) == (2.5, 3.0)
    assert heard.speed_accuracy == pytest.approx(0.4)
    assert heard.alt == pytest.approx(512.3, abs=1e-3)
    # 2023-11-14 22:13:20 UTC was a Tuesday: two days and 80000 s of week 2288, and 18 leap seconds.
    assert (heard.time_week, heard.time_week_ms) == (2288, (2 * 86_400 + 80_000 + 18) * 1000 + 250)
    assert heard.satellites_visible < 10, "a real receiver is to be preferred"
    assert heard.yaw == 0, "which says nothing"


def test_a_receiver_without_a_fix_says_so_and_one_without_a_clock_says_no_time():
    heard = received(gps_input(None, 0, 100.0, None))
    assert (heard.gps_id, heard.fix_type, heard.satellites_visible) == (0, mavlink.GPS_FIX_TYPE_NO_FIX, 0)
    assert (heard.time_week, heard.time_week_ms) == (0, 0)


def test_odometry_lies_north_east_down_of_the_origin_and_moves_along_the_airframe():
    origin = *moved(STATE.lat_deg, STATE.lon_deg, -200.0, 300.0), 500.0
    heard = received(odometry(STATE, STATE.attitude, origin))
    assert (heard.frame_id, heard.child_frame_id) == (mavlink.MAV_FRAME_LOCAL_FRD, mavlink.MAV_FRAME_BODY_FRD)
    assert (heard.x, heard.y, heard.z) == pytest.approx((-300.0, 200.0, -12.3), abs=0.1)
    w, x, y, z = heard.q
    earth_from_body = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    assert math.atan2(earth_from_body[1, 0], earth_from_body[0, 0]) == pytest.approx(1.3, abs=1e-6), "the yaw"
    assert math.atan2(earth_from_body[2, 1], earth_from_body[2, 2]) == pytest.approx(0.1, abs=1e-6), "the roll"
    assert -math.asin(earth_from_body[2, 0]) == pytest.approx(-0.2, abs=1e-6), "the pitch"
    velocity = earth_from_body @ (heard.vx, heard.vy, heard.vz)
    assert velocity == pytest.approx((-4.0, 3.0, 0.5), abs=1e-5)
    # As ArduPilot reads them (GCS_MAVLINK::handle_odometry).
    position, angle = (math.fsum(heard.pose_covariance[each] ** 2 for each in at) for at in ((0, 6, 11), (15, 18, 20)))
    assert position ** (1 / 3) == pytest.approx(2.5)
    assert math.degrees(angle ** (1 / 3)) == pytest.approx(5.0)
    assert heard.velocity_covariance[0] == pytest.approx(0.16)
    assert not any(map(math.isnan, (*heard.pose_covariance, *heard.velocity_covariance)))


def test_a_sensor_says_accuracy_and_no_altitude():
    heard = received(position_sensor(Fix(47.5, 8.25, 4.0, 99.0), 100.0))
    assert (heard.lat, heard.lon, heard.eph) == (475_000_000, 82_500_000, 4.0)
    assert math.isnan(heard.alt)
    assert math.isnan(heard.epv)
    assert heard.id == SENSOR_ID != 0, "EKF2_AGP0_ID 0 is a slot that is off"
    assert heard.source == mavlink.GLOBAL_POSITION_SRC_VISION
