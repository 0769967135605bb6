"""Messages that we send, as they are read at the other end."""

import math

import pytest
from scipy.spatial.transform import Rotation

from edgevpr.core.geodesy import offset_position
from edgevpr.mavlink import messages
from edgevpr.mavlink.messages import Fix, MotionState, Severity
from edgevpr.mavlink.wire import Message, PacketReader, mavlink

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


def pack_and_unpack(message: Message) -> Message:
    """What the other end makes of it."""
    (received,) = PacketReader().feed(message.pack(mavlink.MAVLink(None, 1, 197)))
    return received


@pytest.mark.parametrize(
    ("lat_deg", "lon_deg"),
    [(50.12345678, 14.98765432), (-33.8688197, -151.2092955), (89.99999995, 179.99999995), (-90.0, -180.0), (0.0, 0.0)],
)
def test_make_position_fix_keeps_seven_decimals_and_no_altitude(lat_deg, lon_deg):
    heard = pack_and_unpack(messages.make_position_fix(Fix(lat_deg, lon_deg, 25.0, 99.25), 100.5, target_system=7))
    assert heard.get_type() == "COMMAND_INT"
    assert (heard.command, heard.frame) == (43003, mavlink.MAV_FRAME_GLOBAL)
    assert (heard.target_system, heard.target_component) == (7, 1)
    assert heard.x / 1e7 == pytest.approx(lat_deg, abs=0.51e-7)
    assert heard.y / 1e7 == pytest.approx(lon_deg, abs=0.51e-7)
    assert (heard.param1, heard.param2, heard.param3) == (100.5, 1.25, 25.0)
    assert math.isnan(heard.z)
    assert math.isnan(heard.param4)


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        *(({"accuracy_m": accuracy_m}, "accuracy") for accuracy_m in (0.0, -1.0, math.nan, math.inf)),
        *(({"lat_deg": lat_deg}, "position on Earth") for lat_deg in (90.1, -91.0, math.nan)),
        *(({"lon_deg": lon_deg}, "position on Earth") for lon_deg in (180.1, -math.inf)),
        ({"t_frame_s": math.nan}, "frame time"),
    ],
)
def test_fix_refuses_undefined_values(wrong, says):
    with pytest.raises(ValueError, match=says):
        Fix(**{"lat_deg": 50.0, "lon_deg": 14.0, "accuracy_m": 20.0, "t_frame_s": 0.0} | wrong)


def test_make_named_values_sends_integers_and_floats_and_omits_unknown_values():
    named = messages.make_named_values(12.5, vpr_place=4711, vpr_score=0.625, vpr_conf=None)
    heard = [(m.get_type(), m.name, m.value, m.time_boot_ms) for m in map(pack_and_unpack, named)]
    assert heard == [("NAMED_VALUE_INT", "vpr_place", 4711, 12500), ("NAMED_VALUE_FLOAT", "vpr_score", 0.625, 12500)]
    (cpu,) = messages.make_named_values(2**32 / 1000 + 1.5, vpr_cpu=0.25)
    assert pack_and_unpack(cpu).time_boot_ms == 1500, "it wraps as its field does"


def test_make_computer_status_reports_load_memory_and_temperature_and_marks_unknown_values():
    heard = pack_and_unpack(messages.make_computer_status(60.0, [0.5, 1.25, 0.0], 512 << 20, 4096 << 20, 61.4))
    assert heard.cpu_cores == [50, 100, 0, 255, 255, 255, 255, 255]
    assert (heard.ram_usage, heard.ram_total) == (512, 4096)
    assert heard.temperature_core[:2] == [61, 127]
    assert heard.temperature_board == 127
    assert (heard.uptime, heard.time_usec) == (60_000, 60_000_000)
    assert set(heard.storage_total) == {2**32 - 1}
    heard = pack_and_unpack(messages.make_computer_status(60.0, [0.1] * 20, 1 << 20, 1 << 30, None))
    assert (heard.cpu_cores, set(heard.temperature_core)) == ([10] * 8, {127})


@pytest.mark.parametrize(
    ("text", "arrives"),
    [
        ("map valley.gpkg: 120 places", "map valley.gpkg: 120 places"),
        ("x" * 50, "x" * 50),
        ("x" * 51, "x" * 47 + "..."),
        ("ü" * 40, "ü" * 23 + "..."),  # two bytes each: never cut in the middle of a letter
    ],
)
def test_make_status_text_truncates_to_one_message(text, arrives):
    heard = pack_and_unpack(messages.make_status_text(Severity.WARNING, text))
    assert heard.severity == mavlink.MAV_SEVERITY_WARNING
    assert heard.get_msgbuf()[11:-2].decode() == arrives


@pytest.mark.parametrize(
    ("firmware", "filter_report"),
    [(mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA, [193]), (mavlink.MAV_AUTOPILOT_PX4, [230]), (mavlink.MAV_AUTOPILOT_PPZ, [])],
)
def test_make_report_requests_requests_only_the_reports_of_that_firmware(firmware, filter_report):
    asked = {int(each.param1) for each in messages.make_report_requests(1, firmware)}
    assert sorted(asked & {193, 230}) == filter_report
    assert {24, 30, 33, 132, 136} <= asked


def test_make_gps_input_has_position_velocity_and_accuracy_or_no_fix():
    heard = pack_and_unpack(messages.make_gps_input(STATE, 1, 100.0, 1_700_000_000.25))
    assert (heard.gps_id, heard.fix_type, heard.lat, heard.lon) == (1, 3, 471234567, 87654321)
    assert (heard.ve, heard.vn, heard.vd) == (3.0, -4.0, 0.5)
    assert (heard.horiz_accuracy, heard.vert_accuracy) == (2.5, 3.0)
    assert heard.speed_accuracy == pytest.approx(0.4)
    assert heard.alt == pytest.approx(512.3, abs=1e-3)
    # 2023-11-14 22:13:20 UTC was a Tuesday: two days and 80000 s of week 2288, and 18 leap seconds.
    assert (heard.time_week, heard.time_week_ms) == (2288, (2 * 86_400 + 80_000 + 18) * 1000 + 250)
    assert heard.satellites_visible < 10, "a real receiver is to be preferred"
    assert heard.yaw == 0, "which says nothing"
    heard = pack_and_unpack(messages.make_gps_input(None, 0, 100.0, None))
    assert (heard.gps_id, heard.fix_type, heard.satellites_visible) == (0, mavlink.GPS_FIX_TYPE_NO_FIX, 0)
    assert (heard.time_week, heard.time_week_ms) == (0, 0)


def test_odometry_lies_north_east_down_of_the_origin_and_moves_along_the_airframe():
    origin = *offset_position(STATE.lat_deg, STATE.lon_deg, -200.0, 300.0), 500.0
    heard = pack_and_unpack(messages.make_odometry(STATE, STATE.attitude, origin, 7.0))
    assert (heard.frame_id, heard.child_frame_id) == (mavlink.MAV_FRAME_LOCAL_FRD, mavlink.MAV_FRAME_BODY_FRD)
    assert (heard.x, heard.y, heard.z) == pytest.approx((-300.0, 200.0, -12.3), abs=0.1)
    w, *axis = heard.q
    earth_from_body = Rotation.from_quat((*axis, w))
    assert earth_from_body.as_euler("ZYX") == pytest.approx((1.3, -0.2, 0.1), abs=1e-6), "yaw, pitch, roll"
    assert earth_from_body.apply((heard.vx, heard.vy, heard.vz)) == pytest.approx((-4.0, 3.0, 0.5), abs=1e-5)
    # As ArduPilot reads them (GCS_MAVLINK::handle_odometry).
    position, angle = (math.fsum(heard.pose_covariance[each] ** 2 for each in at) for at in ((0, 6, 11), (15, 18, 20)))
    assert position ** (1 / 3) == pytest.approx(2.5)
    assert math.degrees(angle ** (1 / 3)) == pytest.approx(5.0)
    assert heard.velocity_covariance[0] == pytest.approx(0.16)
    assert not any(map(math.isnan, (*heard.pose_covariance, *heard.velocity_covariance)))
