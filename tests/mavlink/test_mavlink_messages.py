import math

import pytest

from edgevpr.mavlink import messages
from edgevpr.mavlink.messages import Fix, Health, Severity
from edgevpr.mavlink.wire import Message, PacketReader, mavlink


def sent_and_received(message: Message) -> Message:
    """What the other end makes of it."""
    packed = message.pack(mavlink.MAVLink(None, 1, 197))
    (received,) = PacketReader().feed(packed)
    return received


def test_the_heartbeat_is_that_of_an_onboard_computer_and_tells_its_health():
    heard = sent_and_received(messages.heartbeat(Health.CRITICAL))
    assert heard.type == mavlink.MAV_TYPE_ONBOARD_CONTROLLER
    assert heard.autopilot == mavlink.MAV_AUTOPILOT_INVALID
    assert heard.system_status == mavlink.MAV_STATE_CRITICAL


@pytest.mark.parametrize(
    ("lat_deg", "lon_deg"),
    [(50.12345678, 14.98765432), (-33.8688197, -151.2092955), (89.99999995, 179.99999995), (-90.0, -180.0), (0.0, 0.0)],
)
def test_a_fix_arrives_to_a_ten_millionth_of_a_degree_and_without_an_altitude(lat_deg, lon_deg):
    heard = sent_and_received(messages.position_fix(Fix(lat_deg, lon_deg, 25.0, 99.25), 100.5, target_system=7))
    assert heard.get_type() == "COMMAND_INT"
    assert (heard.command, heard.frame) == (43003, mavlink.MAV_FRAME_GLOBAL)
    assert (heard.target_system, heard.target_component) == (7, 1)
    assert heard.x / 1e7 == pytest.approx(lat_deg, abs=0.51e-7)
    assert heard.y / 1e7 == pytest.approx(lon_deg, abs=0.51e-7)
    assert (heard.param1, heard.param2, heard.param3) == (100.5, 1.25, 25.0)
    assert math.isnan(heard.z)
    assert math.isnan(heard.param4)


@pytest.mark.parametrize("accuracy_m", [0.0, -1.0, math.nan, math.inf])
def test_an_accuracy_that_says_nothing_is_refused(accuracy_m):
    with pytest.raises(ValueError, match="accuracy"):
        Fix(50.0, 14.0, accuracy_m, 0.0)


@pytest.mark.parametrize(
    ("lat_deg", "lon_deg"), [(90.1, 14.0), (-91.0, 14.0), (50.0, 180.1), (math.nan, 14.0), (50.0, -math.inf)]
)
def test_a_position_off_the_earth_is_refused(lat_deg, lon_deg):
    with pytest.raises(ValueError, match="the Earth"):
        Fix(lat_deg, lon_deg, 20.0, 0.0)


def test_a_frame_of_no_time_is_refused():
    with pytest.raises(ValueError, match="age"):
        Fix(50.0, 14.0, 20.0, math.nan)


def test_the_event_of_a_match_carries_the_place_and_its_score():
    place, score = map(sent_and_received, messages.place_match(12.5, 4711, 0.625))
    assert (place.get_type(), place.name, place.value, place.time_boot_ms) == (
        "NAMED_VALUE_INT",
        "vpr_place",
        4711,
        12500,
    )
    assert (score.get_type(), score.name, score.value) == ("NAMED_VALUE_FLOAT", "vpr_score", 0.625)


def test_the_event_of_a_match_carries_its_confidence_where_there_is_one():
    *_, confidence = map(sent_and_received, messages.place_match(12.5, 4711, 0.625, 0.75))
    assert (confidence.get_type(), confidence.name, confidence.value) == ("NAMED_VALUE_FLOAT", "vpr_conf", 0.75)


def test_the_figures_of_a_query_carry_the_cpu_share_and_the_charge():
    cpu, charge = map(sent_and_received, messages.query_figures(12.5, 0.25, 3.5))
    assert (cpu.name, cpu.value) == ("vpr_cpu", 0.25)
    assert (charge.name, charge.value) == ("vpr_mah", 3.5)


def test_the_time_since_boot_wraps_as_its_field_does():
    cpu, _ = messages.query_figures(2**32 / 1000 + 1.5, 0.25, 3.5)
    assert sent_and_received(cpu).time_boot_ms == 1500


def test_the_computer_tells_load_memory_and_temperature_and_marks_the_rest_as_unknown():
    heard = sent_and_received(messages.computer_status(60.0, [0.5, 1.25, 0.0], 512 << 20, 4096 << 20, 61.4))
    assert heard.cpu_cores == [50, 100, 0, 255, 255, 255, 255, 255]
    assert (heard.ram_usage, heard.ram_total) == (512, 4096)
    assert heard.temperature_core[:2] == [61, 127]
    assert heard.temperature_board == 127
    assert (heard.uptime, heard.time_usec) == (60_000, 60_000_000)
    assert set(heard.storage_total) == {2**32 - 1}


def test_a_computer_with_many_cores_and_no_thermometer_still_fits_the_message():
    heard = sent_and_received(messages.computer_status(60.0, [0.1] * 20, 1 << 20, 1 << 30))
    assert heard.cpu_cores == [10] * 8
    assert set(heard.temperature_core) == {127}


@pytest.mark.parametrize(
    ("text", "arrives"),
    [
        ("map valley.gpkg: 120 places", "map valley.gpkg: 120 places"),
        ("x" * 50, "x" * 50),
        ("x" * 51, "x" * 47 + "..."),
        ("ü" * 40, "ü" * 23 + "..."),  # two bytes each: never cut in the middle of a letter
    ],
)
def test_a_text_is_cut_to_what_one_message_holds(text, arrives):
    heard = sent_and_received(messages.status_text(Severity.WARNING, text))
    assert heard.severity == mavlink.MAV_SEVERITY_WARNING
    assert heard.get_msgbuf()[11:-2].decode() == arrives


@pytest.mark.parametrize(
    ("firmware", "filter_report"),
    [(mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA, [193]), (mavlink.MAV_AUTOPILOT_PX4, [230]), (mavlink.MAV_AUTOPILOT_PPZ, [])],
)
def test_a_firmware_is_asked_only_for_the_report_of_its_own_filter(firmware, filter_report):
    asked = {int(each.param1) for each in messages.report_requests(1, firmware)}
    assert sorted(asked & {193, 230}) == filter_report
    assert {24, 30, 33, 132, 136} <= asked
