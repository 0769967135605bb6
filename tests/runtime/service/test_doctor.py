"""`edgevpr doctor`: the rules, on what might be read of a flight controller; and the command over a real link."""

import json
import re
import socket
from dataclasses import replace
from pathlib import Path

import pytest
from answering_autopilot import AnsweringAutopilot, healthy_messages
from mavlink_peers import AutopilotThread, free_port

from edgevpr.cli.main import main
from edgevpr.mavlink import reading as module
from edgevpr.mavlink.address import parse_link
from edgevpr.mavlink.channel import ardupilot_choice
from edgevpr.mavlink.positions import SENSOR_ID
from edgevpr.mavlink.reading import AutopilotReading, FilterState
from edgevpr.mavlink.signing import UNSIGNED, WRONG
from edgevpr.mavlink.wire import mavlink
from edgevpr.runtime.service import ardupilot, px4
from edgevpr.runtime.service.doctor import autopilot_findings, silence
from edgevpr.runtime.service.finding import Plan

UDP, SERIAL = parse_link("udpin:127.0.0.1:14550"), parse_link("serial:/dev/ttyAMA0:57600")
FIXES, DRY = Plan(sends_fixes=True, every_s=1.0), Plan(sends_fixes=False, every_s=1.0)
PLAIN = {"GPS1_TYPE": 1, "GPS2_TYPE": 0, "GPS_AUTO_SWITCH": 1, "VISO_TYPE": 0, "FLOW_TYPE": 0, "EK3_SRC1_POSXY": 3}
READY = FilterState(flags=0x33F, has_attitude=True, has_position=True, has_velocity=True, holds_still=False)
COPTER = AutopilotReading(
    system_id=1,
    firmware="ardupilot",
    vehicle="copter",
    is_armed=False,
    version=(4, 6, 2),
    version_text="4.6.2",
    parameters=PLAIN | {"GPS2_TYPE": 14},
    streams_hz={"ATTITUDE": 4.0},
    heard=("ATTITUDE", "GLOBAL_POSITION_INT", "GPS_RAW_INT"),
    gps_fix=(3, None),
    filter=READY,
    origin=(50.0, 14.0),
    signs=False,
    is_signed_to=False,
    answers=True,
    says_version_1=False,
    other_systems=(),
    bad_bytes=0,
    round_trip_s=0.02,
    clock_ahead_s=0.1,
)
PX4 = replace(
    COPTER,
    firmware="px4",
    version=(1, 17, 0),
    version_text="1.17.0",
    parameters={"EKF2_AGP0_CTRL": 1, "EKF2_AGP0_ID": SENSOR_ID, "EKF2_AGP0_DELAY": 0.0, "MAV_1_CONFIG": 102},
)


def with_parameters(reading: AutopilotReading, **parameters) -> AutopilotReading:
    return replace(reading, parameters=reading.parameters | parameters)


def wrong(reading: AutopilotReading, link=UDP, plan=FIXES) -> dict:
    """What is wrong, and the changes that it needs."""
    return {each.what: each.changes for each in autopilot_findings(reading, link, plan) if not each.ok}


def said(reading: AutopilotReading, what: str, link=UDP, plan=FIXES) -> str:
    return next(each.message for each in autopilot_findings(reading, link, plan) if each.what == what)


def test_a_copter_and_a_px4_that_are_set_up_have_nothing_wrong():
    assert wrong(COPTER) == {}
    assert wrong(PX4) == {}
    assert said(PX4, "channel") == "Message 296, as its EKF2_AGP0_CTRL fuses positions."


# The channel of an ArduPilot.


@pytest.mark.parametrize(
    ("vehicle", "parameters", "sentence"),
    [
        ("copter", {"GPS2_TYPE": 14}, "GPS_INPUT as receiver 2, as its GPS2_TYPE is 14."),
        ("copter", {"GPS1_TYPE": 14, "GPS2_TYPE": 14}, "GPS_INPUT as receiver 1, as its GPS1_TYPE is 14."),
        ("plane", {}, "Command 43003, which a plane that reckons takes at any time."),
        ("plane", {"Q_ENABLE": 1, "GPS2_TYPE": 14}, "GPS_INPUT as receiver 2, as its GPS2_TYPE is 14."),
        ("copter", {"FLOW_TYPE": 6, "EK3_SRC2_VELXY": 5}, "Command 43003: FLOW_TYPE=6 carries it from fix to fix."),
    ],
)
def test_the_channel_is_the_one_that_the_flight_will_choose(vehicle, parameters, sentence):
    reading = replace(COPTER, vehicle=vehicle, parameters=PLAIN | parameters)
    assert (said(reading, "channel"), wrong(reading)) == (sentence, {})
    assert ardupilot_choice(reading.asked).channel.name in {"GPS_INPUT", "COMMAND"}


def test_the_channel_follows_from_the_older_names_too():
    older = {"GPS_TYPE": 1, "GPS_TYPE2": 14, "EK3_SRC1_POSXY": 3}
    assert "GPS_TYPE2 is 14" in said(replace(COPTER, parameters=older), "channel")
    assert "GPS_TYPE is 14" in said(replace(COPTER, parameters=older | {"GPS_TYPE": 14}), "channel")


@pytest.mark.parametrize("vehicle", ["copter", "rover", "vehicle"])
@pytest.mark.parametrize(
    "parameters", [PLAIN, {"FLOW_TYPE": 6}, {"FLOW_TYPE": 0, "EK3_SRC1_VELXY": 5}, {"VISO_TYPE": 2}]
)
def test_without_anything_that_carries_it_single_fixes_are_wrong(vehicle, parameters):
    found = wrong(replace(COPTER, vehicle=vehicle, parameters=PLAIN | parameters))
    assert found == {"channel": ("GPS2_TYPE=14",)}


def test_a_plane_that_hovers_needs_what_a_copter_needs():
    hovers = replace(COPTER, vehicle="plane", parameters=PLAIN | {"Q_ENABLE": 1})
    assert wrong(hovers) == {"channel": ("GPS2_TYPE=14",)}
    assert "while it hovers (Q_ENABLE=1): without GPS it falls back to QHOVER or QLAND" in said(hovers, "channel")
    assert wrong(with_parameters(hovers, Q_ENABLE=0)) == {}
    assert wrong(with_parameters(hovers, FLOW_TYPE=6, EK3_SRC1_VELXY=5)) == {}


def test_a_copter_without_a_channel_is_told_what_to_change_for_its_firmware():
    bare = replace(COPTER, parameters=PLAIN)
    assert wrong(bare) == {"channel": ("GPS2_TYPE=14",)}
    assert "lands by its EKF failsafe after some 9 s" in said(bare, "channel")
    assert wrong(with_parameters(bare, GPS_AUTO_SWITCH=0)) == {"channel": ("GPS2_TYPE=14", "GPS_AUTO_SWITCH=1")}
    older = replace(COPTER, parameters={"GPS_TYPE": 1, "GPS_TYPE2": 0, "GPS_AUTO_SWITCH": 1})
    assert wrong(older) == {"channel": ("GPS_TYPE2=14",)}
    assert "takes the place of the second receiver (type 1)" in said(with_parameters(bare, GPS2_TYPE=1), "channel")
    assert "the flow is not used" in said(with_parameters(bare, FLOW_TYPE=6), "channel")
    assert "stops by its EKF failsafe" in said(replace(bare, vehicle="rover"), "channel")


def test_a_receiver_over_mavlink_must_be_switched_to_and_used_by_the_filter():
    assert wrong(with_parameters(COPTER, GPS_AUTO_SWITCH=0)) == {"channel": ("GPS_AUTO_SWITCH=1",)}
    assert wrong(with_parameters(COPTER, GPS_AUTO_SWITCH=2)) == {"channel": ("GPS_AUTO_SWITCH=1",)}
    assert wrong(with_parameters(COPTER, GPS_AUTO_SWITCH=4)) == {}
    assert wrong(with_parameters(COPTER, EK3_SRC1_POSXY=6)) == {"channel": ("EK3_SRC1_POSXY=3",)}
    only = replace(COPTER, parameters=PLAIN | {"GPS1_TYPE": 14, "GPS_AUTO_SWITCH": 0})
    assert wrong(only) == {}


def test_odometry_needs_a_source_set_and_an_origin():
    visual = replace(COPTER, parameters=PLAIN | {"VISO_TYPE": 1})
    changes = ("EK3_SRC2_POSXY=6", "EK3_SRC2_VELXY=0", "EK3_SRC2_POSZ=1", "EK3_SRC2_YAW=1")
    assert wrong(visual) == {"channel": changes}
    prepared = with_parameters(visual, EK3_SRC2_POSXY=6)
    assert said(prepared, "channel").endswith("when GPS is lost, the operator switches to source set 2.")
    assert wrong(prepared) == {}
    assert set(wrong(replace(prepared, origin=None))) == {"channel", "origin"}
    assert said(with_parameters(visual, EK3_SRC1_POSXY=6), "channel") == "ODOMETRY, as its VISO_TYPE is 1."
    assert said(replace(visual, vehicle="plane"), "channel").startswith("ODOMETRY, as its VISO_TYPE is 1, but no ")


def test_the_velocity_of_odometry_must_not_be_fused():
    fused = replace(COPTER, parameters=PLAIN | {"VISO_TYPE": 1, "EK3_SRC2_POSXY": 6, "EK3_SRC2_VELXY": 6})
    assert wrong(fused) == {"channel": ("EK3_SRC2_VELXY=0",)}
    assert "trust it more than its gyros" in said(fused, "channel")
    elsewhere = with_parameters(fused, EK3_SRC2_VELXY=0, EK3_SRC3_VELXY=6)  # a set without our position
    assert wrong(elsewhere) == {}


def test_a_plane_is_told_whether_it_knows_its_airspeed():
    plane = replace(COPTER, vehicle="plane", parameters=PLAIN)
    assert wrong(plane) == {}
    assert "drifts faster" in said(plane, "airspeed")
    assert "drifts faster" in said(with_parameters(plane, ARSPD_TYPE=1, ARSPD_USE=0), "airspeed")
    assert "the wind is known" in said(with_parameters(plane, ARSPD_TYPE=1, ARSPD_USE=1), "airspeed")
    assert "airspeed" not in {each.what for each in autopilot_findings(COPTER, UDP, FIXES)}


@pytest.mark.parametrize(
    ("change", "what", "changes"),
    [
        ({"version": (4, 4, 4), "version_text": "4.4.4"}, "firmware", ("ArduPilot 4.5 or later",)),
        ({"version": None, "version_text": None}, "firmware", ()),
        ({"firmware": "other"}, "firmware", ()),
        ({"says_version_1": True}, "port", ("SERIALn_PROTOCOL=2",)),
        ({"bad_bytes": 5000}, "link", ()),
        ({"other_systems": (2, 3)}, "vehicles", ("mavlink: {system_id: 1}",)),
        ({"filter": None}, "filter", ()),
        ({"filter": replace(READY, has_position=False)}, "filter", ()),
        ({"filter": replace(READY, has_attitude=False)}, "filter", ()),
        ({"filter": replace(READY, holds_still=True)}, "filter", ()),
        ({"gps_fix": (None, None)}, "gps", ()),
        ({"gps_fix": (1, 2)}, "gps", ()),
        ({"origin": None}, "origin", ()),
        ({"clock_ahead_s": 86_400.0}, "clock", ("timedatectl set-ntp true, or a clock chip",)),
        ({"clock_ahead_s": -86_400.0}, "clock", ("timedatectl set-ntp true, or a clock chip",)),
        ({"heard": ("ATTITUDE",)}, "streams", ()),
    ],
)
def test_each_thing_that_is_wrong_is_the_only_one_found(change, what, changes):
    assert wrong(replace(COPTER, **change)) == {what: changes}


def test_an_armed_vehicle_is_said():
    assert ", armed; an answer takes 20 ms" in said(replace(COPTER, is_armed=True), "link")


def test_what_the_autopilot_does_not_know_is_not_wrong():
    assert wrong(replace(COPTER, clock_ahead_s=None, round_trip_s=None, gps_fix=(0, 4))) == {}


def test_the_filter_must_be_the_third():
    assert wrong(with_parameters(COPTER, EK3_ENABLE=0)) == {"EKF3": ("EK3_ENABLE=1",)}
    assert wrong(with_parameters(COPTER, AHRS_EKF_TYPE=2, EK3_ENABLE=1)) == {"EKF3": ("AHRS_EKF_TYPE=3",)}


def test_a_port_with_mavlink_1_is_named():
    ports = {"SERIAL0_PROTOCOL": 2, "SERIAL1_PROTOCOL": 1, "SERIAL2_PROTOCOL": 5, "SERIAL1_BAUD": 57}
    assert wrong(replace(with_parameters(COPTER, **ports), says_version_1=True)) == {"port": ("SERIAL1_PROTOCOL=2",)}
    assert said(with_parameters(COPTER, **ports), "port").endswith("SERIAL0 (baud 0), SERIAL1 (baud 57)")


def test_a_slow_line_is_to_be_faster():
    assert wrong(replace(COPTER, round_trip_s=0.4), SERIAL) == {"link": ("SERIALn_PROTOCOL=2", "SERIALn_BAUD=921")}
    px4_changes = ("MAV_1_CONFIG=102", "MAV_1_MODE=2", "SER_TEL2_BAUD=921600")
    assert wrong(replace(PX4, round_trip_s=0.4), SERIAL) == {"link": px4_changes}


@pytest.mark.parametrize(("baud", "code"), [(57_600, 57), (111_100, 111), (115_200, 115), (1_500_000, 1500)])
def test_ardupilot_has_its_own_numbers_for_baud_rates(baud, code):
    assert ardupilot.port_changes(baud) == ("SERIALn_PROTOCOL=2", f"SERIALn_BAUD={code}")


def test_who_answers_nothing_is_judged_by_nothing_but_that():
    mute = replace(COPTER, answers=False, version=None, parameters={}, heard=(), filter=None, origin=None)
    assert set(wrong(mute)) == {"link"}
    assert set(wrong(replace(mute, signs=True))) == {"link", "signing"}
    signed = replace(mute, signs=True, is_signed_to=True)
    assert set(wrong(signed)) == {"link"}
    assert "the clock of this board" in said(signed, "link")
    assert said(signed, "signing") == "its packets carry the right signature, and so do ours"
    assert wrong(replace(COPTER, signs=True)) == {}


# A dry run.


@pytest.mark.parametrize("vehicle", ["copter", "rover"])
def test_a_dry_run_needs_no_second_receiver_and_hears_that_the_first_flight_with_fixes_does(vehicle):
    bare = replace(COPTER, vehicle=vehicle, parameters=PLAIN | {"GPS_AUTO_SWITCH": 0})
    assert wrong(bare) == {"channel": ("GPS2_TYPE=14", "GPS_AUTO_SWITCH=1")}
    assert wrong(bare, plan=DRY) == {}
    message = said(bare, "channel", plan=DRY)
    assert "The first flight with fixes on needs GPS2_TYPE=14 and GPS_AUTO_SWITCH=1: This " in message
    plane = replace(COPTER, vehicle="plane", parameters=PLAIN)
    assert said(plane, "channel", plan=DRY) == said(plane, "channel"), "nothing is needed, dry or not"


@pytest.mark.parametrize(
    ("parameters", "change"),
    [
        ({"GPS2_TYPE": 14}, "GPS2_TYPE=0"),
        ({"GPS1_TYPE": 14}, "GPS1_TYPE=1"),
        ({"VISO_TYPE": 1, "EK3_SRC2_POSXY": 6}, "VISO_TYPE=0"),
    ],
)
def test_a_dry_run_could_not_arm_with_what_waits_for_positions(parameters, change):
    ready = replace(COPTER, parameters=PLAIN | parameters)
    assert wrong(ready) == {}
    assert wrong(ready, plan=DRY) == {"channel": (change,)}
    assert "would not arm" in said(ready, "channel", plan=DRY)
    older = replace(COPTER, parameters={"GPS_TYPE": 1, "GPS_TYPE2": 14})
    assert wrong(older, plan=DRY) == {"channel": ("GPS_TYPE2=0",)}


def test_what_a_dry_run_bears_is_wrong_before_it_too():
    assert wrong(with_parameters(COPTER, GPS2_TYPE=0, EK3_ENABLE=0), plan=DRY) == {"EKF3": ("EK3_ENABLE=1",)}
    assert set(wrong(with_parameters(PX4, EKF2_AGP0_CTRL=0), plan=DRY)) == {"channel"}


# PX4.


def test_a_px4_that_is_told_too_rarely_would_keep_no_position():
    assert "a query every 4.9 s" in said(PX4, "rate", plan=Plan(True, 4.9))
    for plan in (Plan(True, 5.0), Plan(False, 5.0)):
        assert set(wrong(PX4, plan=plan)) == {"rate"}
    assert "source: {rate_hz: 0.4}" in wrong(PX4, plan=Plan(True, 5.0))["rate"][0]
    plane = replace(PX4, vehicle="plane", version=(1, 16, 0))  # command 43003: it reckons from fix to fix
    assert wrong(plane, plan=Plan(True, 5.0)) == {}
    assert "rate" not in {each.what for each in autopilot_findings(COPTER, UDP, Plan(True, 5.0))}


def test_the_page_of_px4_names_the_same_silence():
    page = " ".join((Path(__file__).parents[3] / "docs/how-to/px4.md").read_text().split())
    silence_s = re.search(r"PX4 stops using positions after (\d+) s of silence", page)[1]
    assert f"PX4 drops positions after {silence_s} s of silence" in px4.rarity(1.0)
    assert px4.is_too_rare(float(silence_s))


def test_a_px4_that_can_take_positions_is_told_how():
    bare = with_parameters(PX4, EKF2_AGP0_CTRL=0, EKF2_AGP0_ID=0, EKF2_AGP0_DELAY=300.0)
    assert wrong(bare) == {"channel": ("EKF2_AGP0_CTRL=1", "EKF2_AGP0_ID=1", "EKF2_AGP0_DELAY=0")}
    assert wrong(with_parameters(PX4, EKF2_AGP0_DELAY=250.0)) == {"channel": ("EKF2_AGP0_DELAY=0",)}
    assert wrong(with_parameters(PX4, EKF2_AGP0_CTRL=2)) == {"channel": ("EKF2_AGP0_CTRL=1",)}


@pytest.mark.parametrize("change", [{"version": (1, 16, 0)}, {"parameters": {}}])
def test_a_px4_without_message_296_must_reckon_well_by_itself(change):
    without = replace(PX4, **change)
    assert wrong(without) == {"channel": ("PX4 1.17 or later, with EKF2_AGP0_CTRL", "or EKF2_OF_CTRL=1")}
    assert wrong(replace(without, vehicle="plane")) == {}
    assert said(replace(without, vehicle="plane"), "channel").startswith("Command 43003, as ")
    assert wrong(with_parameters(without, EKF2_OF_CTRL=1)) == {}


def test_an_old_or_a_silent_px4_is_wrong():
    assert wrong(replace(PX4, vehicle="plane", version=(1, 14, 3), version_text="1.14.3", parameters={})) == {
        "firmware": ("PX4 1.15 or later",)
    }
    assert set(wrong(replace(PX4, version=None))) == {"firmware"}
    assert wrong(replace(PX4, says_version_1=True)) == {"port": ("MAV_PROTO_VER=2",)}


def test_a_px4_that_takes_another_pose_is_told_of():
    assert "EKF2_EV_CTRL=11" in said(with_parameters(PX4, EKF2_EV_CTRL=11), "vision")
    assert "MAV_1_CONFIG=102 (mode ?)" in said(PX4, "port")


# Nothing heard.


def test_a_silent_line_is_explained_by_what_arrives():
    nothing = silence(SERIAL, 0, set())
    assert (nothing.ok, "nothing arrives (TX and RX?)" in nothing.message) == (False, True)
    assert nothing.changes == (
        "ArduPilot: SERIALn_PROTOCOL=2, SERIALn_BAUD=57",
        "PX4: MAV_1_CONFIG=102, MAV_1_MODE=2, SER_TEL2_BAUD=57600",
    )
    assert "another baud rate?" in silence(SERIAL, 900, set()).message
    assert silence(UDP, 0, {5, 3}).changes == ("mavlink: {system_id: 3}",)
    refused = silence(UDP, 0, set(), {UNSIGNED: 4, WRONG: 5}).message
    assert refused == (
        f"{UDP}: messages arrive, and are refused (wrong signature): the other end has another key, or somebody forges "
        "them."
    )
    for url in ("udpin:0.0.0.0:14550", "udpout:10.0.0.2:14550", "tcp:10.0.0.2:5760"):
        assert silence(parse_link(url), 0, set()).message.startswith(f"{url}: no heartbeat of an autopilot in 5 s: ")


def test_the_pages_of_the_vehicles_name_what_is_told_to_change():
    docs = Path(__file__).parents[3] / "docs/how-to"
    copter, px4_page = (docs / "ardupilot-copter.md").read_text(), (docs / "px4.md").read_text()
    bare = with_parameters(replace(COPTER, parameters=PLAIN), GPS_AUTO_SWITCH=0)
    for parameter, value in (change.split("=") for change in wrong(bare)["channel"]):
        assert re.search(rf"`{parameter}`.*\| {value} \|", copter)
    for change in (*wrong(replace(COPTER, parameters=PLAIN | {"VISO_TYPE": 1}))["channel"], "VISO_TYPE=1"):
        assert f"`{change}`" in copter
    assert "EK3_SRC2_VELXY=6" not in copter
    unset = with_parameters(PX4, EKF2_AGP0_CTRL=0, EKF2_AGP0_ID=0, EKF2_AGP0_DELAY=300.0)
    for parameter, value in (change.split("=") for change in (*wrong(unset)["channel"], *px4.port_changes(921_600))):
        assert re.search(rf"`{parameter}` \| {value}[ |]", px4_page)


# The command.


@pytest.fixture
def _quick(monkeypatch):
    monkeypatch.setattr(module, "LISTEN_S", 0.2)


@pytest.fixture
def link() -> str:
    return f"udpin:127.0.0.1:{free_port()}"


def peer(link: str, **autopilot) -> AnsweringAutopilot:
    return AnsweringAutopilot(parse_link(link).number, messages=healthy_messages(), **autopilot)


def findings_of(printed: str) -> dict[str, tuple[bool, str]]:
    found = (line.split(maxsplit=2) for line in printed.splitlines() if not line.startswith(" "))
    return {what: (verdict == "ok", message) for verdict, what, message in found}


@pytest.mark.usefixtures("_quick")
def test_the_command_over_a_link(link, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with peer(link, parameters=PLAIN | {"GPS2_TYPE": 14}) as autopilot:
        code = main(["doctor", "--link", link])
    found = findings_of(capsys.readouterr().out)
    assert {what: message for what, (ok, message) in found.items() if not ok and what != "bytecode"} == {}
    assert code == (0 if found["bytecode"][0] else 1)
    assert found["channel"][1] == "GPS_INPUT as receiver 2, as its GPS2_TYPE is 14."
    assert list(tmp_path.iterdir()) == []
    assert autopilot.names() == {"HEARTBEAT", "COMMAND_LONG", "PARAM_REQUEST_READ", "TIMESYNC"}


@pytest.mark.usefixtures("_quick")
def test_the_command_prints_the_change_and_exits_with_1(link, capsys):
    with peer(link, parameters=PLAIN):
        assert main(["doctor", "--link", link]) == 1
    printed = capsys.readouterr().out
    assert not findings_of(printed)["channel"][0]
    assert "  change: GPS2_TYPE=14\n" in printed


@pytest.mark.usefixtures("_quick")
def test_the_command_knows_from_the_configuration_that_the_run_is_dry_and_how_often_it_asks(link, capsys, tmp_path):
    config = tmp_path / "config.yaml"
    config.write_text("board: rpi-zero-2w\nmavlink: {send_fixes: false}\nlog: {path: null}\n")
    with peer(link, parameters=PLAIN):
        main(["doctor", "--config", str(config), "--link", link])
    assert "A dry run (`send_fixes: false`) needs no change" in findings_of(capsys.readouterr().out)["channel"][1]
    autopilot = AutopilotThread(link.replace("udpin", "udpout"), vehicle="px4-copter")
    try:
        main(["doctor", "--config", str(config), "--link", link])
        slow = findings_of(capsys.readouterr().out)
        config.write_text(config.read_text() + "source: {rate_hz: 0.5}\n")
        main(["doctor", "--config", str(config), "--link", link])
        quick = findings_of(capsys.readouterr().out)
    finally:
        autopilot.finish()
    assert (slow["channel"][0], slow["rate"][0], quick["rate"][0]) == (True, False, True)
    assert quick["clock"][0], "its time is that of this machine"
    assert "a query every 5 s" in slow["rate"][1]


@pytest.mark.usefixtures("_quick")
def test_the_command_prints_json(link, capsys, tmp_path):
    config = tmp_path / "config.yaml"
    config.write_text(f"mavlink: {{link: '{link}'}}\nlog: {{path: null}}\n")
    with peer(link, parameters=PLAIN, vehicle=mavlink.MAV_TYPE_FIXED_WING, system_id=42):
        main(["doctor", "--config", str(config), "--json"])
    result = json.loads(capsys.readouterr().out)
    assert (result["link"], result["reading"]["system_id"], result["reading"]["vehicle"]) == (link, 42, "plane")
    assert result["ok"] == all(each["ok"] for each in result["findings"])
    assert {"what", "ok", "message", "changes"} == set(result["findings"][0])


@pytest.mark.usefixtures("_quick")
@pytest.mark.parametrize(("key", "is_heard"), [(bytes(range(32)), True), (bytes(32), False)])
def test_the_command_signs_with_the_key_of_its_configuration(link, capsys, tmp_path, key, is_heard):
    (tmp_path / "key").touch(mode=0o600)
    (tmp_path / "key").write_bytes(bytes(range(32)))
    (tmp_path / "c.yaml").write_text(f"mavlink: {{signing_key: {tmp_path}/key}}\nlog: {{path: null}}\n")
    with peer(link, parameters=PLAIN | {"GPS2_TYPE": 14}, key=key, wants_signed=True):
        main(["doctor", "--config", str(tmp_path / "c.yaml"), "--link", link])
    found = findings_of(capsys.readouterr().out)
    assert ("channel" in found) == is_heard
    if is_heard:
        assert found["signing"] == (True, "its packets carry the right signature, and so do ours")
    else:
        assert "messages arrive, and are refused (wrong signature)" in found["link"][1]
    assert {path.name for path in tmp_path.iterdir()} == {"key", "c.yaml"}, "the time is not written"


@pytest.mark.usefixtures("_quick")
def test_where_no_autopilot_is_the_command_says_so_and_looks_at_the_board(link, capsys):
    assert main(["doctor", "--link", link]) == 1
    found = findings_of(capsys.readouterr().out)
    assert found["link"] == (
        False,
        f"{link}: no heartbeat of an autopilot in 5 s: let the autopilot, its simulator or a router send to this port.",
    )
    assert "python" in found
    assert "channel" not in found


def test_a_server_that_is_not_up_is_wrong(capsys):
    link = f"tcp:127.0.0.1:{free_port(socket.SOCK_STREAM)}"
    assert main(["doctor", "--link", link]) == 1
    assert findings_of(capsys.readouterr().out)["link"][1].startswith(f"{link} is not there (Connection refused)")


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["--link", "udp:127.0.0.1"], "is no MAVLink link"),
        (["--link", "serial:/dev/null:fast"], "the baud rate must be a number"),
        (["--link", "udpout:no-such-host.invalid:14550"], "there is no host"),
        ([], "There is no link to the flight controller"),
        (["--config", "/absent.yaml"], "cannot be read"),
    ],
)
def test_a_wrong_request_is_a_sentence_and_exits_with_2(arguments, sentence, capsys):
    assert main(["doctor", *arguments]) == 2
    assert sentence in capsys.readouterr().err
