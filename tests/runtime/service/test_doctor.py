"""`edgevpr doctor`: the rules, on what might be read of a flight controller; and the command over a real link."""

import json
import re
from dataclasses import replace
from pathlib import Path

import pytest
from answering_autopilot import AnsweringAutopilot, healthy_messages
from mavlink_peers import AutopilotThread, free_port

from edgevpr.cli.main import main
from edgevpr.mavlink import asking as module
from edgevpr.mavlink.address import parse_link
from edgevpr.mavlink.asking import AutopilotReading
from edgevpr.mavlink.messages import SENSOR_ID
from edgevpr.mavlink.signing import UNSIGNED, WRONG
from edgevpr.mavlink.wire import mavlink
from edgevpr.runtime.service.doctor import autopilot_findings, silence
from edgevpr.runtime.service.rules import RULES

UDP, SERIAL = parse_link("udpin:127.0.0.1:14550"), parse_link("serial:/dev/ttyAMA0:57600")
FIXES, DRY = True, False
PLAIN = {"GPS1_TYPE": 1, "GPS2_TYPE": 0, "GPS_AUTO_SWITCH": 1, "VISO_TYPE": 0, "FLOW_TYPE": 0, "EK3_SRC1_POSXY": 3}
READY = 0x33F
COPTER = AutopilotReading(
    system_id=1,
    firmware="ardupilot",
    vehicle="copter",
    is_armed=False,
    version=(4, 6, 2),
    version_text="4.6.2",
    parameters=PLAIN | {"GPS2_TYPE": 14},
    heard=("ATTITUDE", "GLOBAL_POSITION_INT", "GPS_RAW_INT"),
    gps_fix=(3, None),
    filter_flags=READY,
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


# What is said, once each; a `|` parts what must be in the message.
BARE, VISUAL = replace(COPTER, parameters=PLAIN), replace(COPTER, parameters=PLAIN | {"VISO_TYPE": 1})
HOVERING = replace(COPTER, vehicle="plane", parameters=PLAIN | {"Q_ENABLE": 1})
MUTE = replace(COPTER, answers=False, version=None, parameters={}, heard=(), filter_flags=None, origin=None)
SIGNED = replace(MUTE, signs=True, is_signed_to=True)
FUSED = with_parameters(VISUAL, EK3_SRC2_POSXY=6, EK3_SRC2_VELXY=6)


@pytest.mark.parametrize(
    ("reading", "what", "message"),
    [
        (COPTER, "channel", "GPS_INPUT as receiver 2, as its GPS2_TYPE is 14."),
        (PX4, "channel", "Message 296, as its EKF2_AGP0_CTRL fuses positions."),
        (replace(PX4, vehicle="plane", parameters={}), "channel", "Command 43003, as "),
        (HOVERING, "channel", "while it hovers (Q_ENABLE=1): without GPS it falls back to QHOVER or QLAND"),
        (BARE, "channel", "lands by its EKF failsafe after some 9 s"),
        (with_parameters(BARE, GPS2_TYPE=1), "channel", "takes the place of the second receiver (type 1)"),
        (with_parameters(BARE, FLOW_TYPE=6), "channel", "the flow is not used"),
        (replace(BARE, vehicle="rover"), "channel", "stops by its EKF failsafe"),
        (with_parameters(VISUAL, EK3_SRC2_POSXY=6), "channel", "switches to source set 2."),
        (with_parameters(VISUAL, EK3_SRC1_POSXY=6), "channel", "ODOMETRY, as its VISO_TYPE is 1."),
        (replace(VISUAL, vehicle="plane"), "EK3_SRCn_POSXY", "No source set of the filter takes our position."),
        (FUSED, "EK3_SRCn_VELXY", "trust it more than its gyros. Until then edgevpr sends nothing."),
        (replace(COPTER, is_armed=True), "link", ", armed; an answer takes 20 ms"),
        (MUTE, "link", "is heard, but answers nothing: the wire |, or a signing key"),
        (replace(MUTE, signs=True), "link", "it may want signed requests"),
        (SIGNED, "link", "the clock of this board"),
        (SIGNED, "signing", "its packets carry the right signature, and so do ours"),
    ],
)
def test_what_is_said(reading, what, message):
    assert all(part in said(reading, what) for part in message.split("|"))


@pytest.mark.parametrize("vehicle", ["copter", "rover", "vehicle"])
@pytest.mark.parametrize(
    "parameters", [PLAIN, {"FLOW_TYPE": 6}, {"FLOW_TYPE": 0, "EK3_SRC1_VELXY": 5}, {"VISO_TYPE": 2}]
)
def test_without_anything_that_carries_it_single_fixes_are_wrong(vehicle, parameters):
    found = wrong(replace(COPTER, vehicle=vehicle, parameters=PLAIN | parameters))
    assert found == {"channel": ("GPS2_TYPE=14",)}


def test_a_plane_that_hovers_needs_what_a_copter_needs():
    assert wrong(HOVERING) == {"channel": ("GPS2_TYPE=14",)}
    assert wrong(with_parameters(HOVERING, Q_ENABLE=0)) == {}
    assert wrong(with_parameters(HOVERING, FLOW_TYPE=6, EK3_SRC1_VELXY=5)) == {}


def test_a_copter_without_a_channel_is_told_what_to_change_for_its_firmware():
    assert wrong(BARE) == {"channel": ("GPS2_TYPE=14",)}
    assert wrong(with_parameters(BARE, GPS_AUTO_SWITCH=0)) == {"channel": ("GPS2_TYPE=14", "GPS_AUTO_SWITCH=1")}
    older = replace(COPTER, parameters={"GPS_TYPE": 1, "GPS_TYPE2": 0, "GPS_AUTO_SWITCH": 1})
    assert wrong(older) == {"channel": ("GPS_TYPE2=14",)}


def test_each_row_of_the_table_that_is_broken_is_a_finding():
    several = with_parameters(COPTER, GPS_AUTO_SWITCH=4, GPS_PRIMARY=1, EK3_SRC1_POSXY=6, AHRS_EKF_TYPE=2, EK3_ENABLE=0)
    assert wrong(several) == {
        "GPS_PRIMARY": ("GPS_PRIMARY=0",),
        "EK3_SRCn_POSXY": ("EK3_SRC1_POSXY=3",),
        "AHRS_EKF_TYPE": ("EK3_ENABLE=1", "AHRS_EKF_TYPE=3"),
    }
    assert said(COPTER, "parameters")


def test_odometry_needs_a_source_set_and_an_origin():
    changes = ("EK3_SRC2_POSXY=6", "EK3_SRC2_VELXY=0", "EK3_SRC2_POSZ=1", "EK3_SRC2_YAW=1")
    assert wrong(VISUAL) == {"EK3_SRCn_POSXY": changes}
    prepared = with_parameters(VISUAL, EK3_SRC2_POSXY=6)
    assert wrong(prepared) == {}
    assert set(wrong(replace(prepared, origin=None))) == {"channel", "origin"}


@pytest.mark.parametrize(
    ("change", "what", "changes"),
    [
        ({"version": (4, 4, 4), "version_text": "4.4.4"}, "firmware", ("ArduPilot 4.5 or later",)),
        ({"version": None, "version_text": None}, "firmware", ()),
        ({"firmware": "other"}, "firmware", ("mavlink: {send_fixes: false}",)),
        ({"says_version_1": True}, "port", ("SERIALn_PROTOCOL=2",)),
        ({"bad_bytes": 5000}, "link", ()),
        ({"other_systems": (2, 3)}, "vehicles", ("mavlink: {system_id: 1}",)),
        ({"filter_flags": None}, "filter", ()),
        ({"filter_flags": READY & ~mavlink.EKF_POS_HORIZ_ABS}, "filter", ()),
        ({"filter_flags": READY & ~mavlink.EKF_ATTITUDE}, "filter", ()),
        ({"filter_flags": READY | mavlink.EKF_CONST_POS_MODE}, "filter", ()),
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


def test_a_slow_line_is_to_be_faster():
    assert wrong(replace(COPTER, round_trip_s=0.4), SERIAL) == {"link": ("SERIALn_PROTOCOL=2", "SERIALn_BAUD=921")}
    px4_changes = ("MAV_1_CONFIG=102", "MAV_1_MODE=2", "SER_TEL2_BAUD=921600")
    assert wrong(replace(PX4, round_trip_s=0.4), SERIAL) == {"link": px4_changes}


def test_who_answers_nothing_is_judged_by_nothing_but_that():
    assert set(wrong(MUTE)) == set(wrong(SIGNED)) == {"link"}
    assert set(wrong(replace(MUTE, signs=True))) == {"link", "signing"}
    assert wrong(replace(COPTER, signs=True)) == {}


# A dry run.


@pytest.mark.parametrize("vehicle", ["copter", "rover"])
def test_a_dry_run_needs_no_second_receiver_and_hears_that_the_first_flight_with_fixes_does(vehicle):
    bare = replace(COPTER, vehicle=vehicle, parameters=PLAIN | {"GPS_AUTO_SWITCH": 0})
    assert wrong(bare) == {"channel": ("GPS2_TYPE=14", "GPS_AUTO_SWITCH=1")}
    assert wrong(bare, plan=DRY) == {}
    assert " GPS2_TYPE=14 and GPS_AUTO_SWITCH=1: This " in said(bare, "channel", plan=DRY)
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
    older = replace(COPTER, parameters={"GPS_TYPE": 1, "GPS_TYPE2": 14})
    assert wrong(older, plan=DRY) == {"channel": ("GPS_TYPE2=0",)}


# PX4.


def test_a_px4_that_stands_still_with_gps_is_fine_and_an_ardupilot_that_says_the_same_is_not():
    assert wrong(replace(PX4, filter_flags=0x3FF)) == {}, "as a real one says on the pad"
    assert set(wrong(replace(COPTER, filter_flags=0x3FF))) == {"filter"}


def test_a_px4_that_can_take_positions_is_told_how():
    bare = with_parameters(PX4, EKF2_AGP0_CTRL=0, EKF2_AGP0_ID=0, EKF2_AGP0_DELAY=300.0)
    assert wrong(bare) == {
        "channel": ("EKF2_AGP0_CTRL=1",),
        "EKF2_AGP0_DELAY": ("EKF2_AGP0_DELAY=0",),
        "EKF2_AGP0_ID": ("EKF2_AGP0_ID=1",),
    }
    assert wrong(with_parameters(PX4, EKF2_AGP0_CTRL=2)) == {"channel": ("EKF2_AGP0_CTRL=1",)}


def test_a_px4_without_message_296_must_reckon_well_by_itself():
    without = replace(PX4, parameters={})
    assert wrong(without) == wrong(with_parameters(without, EKF2_OF_CTRL=1)) == {"channel": ("EKF2_EV_CTRL=1",)}
    others = "EKF2_EV_CTRL=1, unless another system aboard sends ODOMETRY"
    assert wrong(with_parameters(without, EKF2_EV_CTRL=15)) == {"channel": (others,)}
    assert wrong(with_parameters(without, EKF2_EV_CTRL=1)) == {}
    assert wrong(with_parameters(without, EKF2_EV_CTRL=1, EKF2_EV_NOISE_MD=1)).keys() == {"EKF2_EV_NOISE_MD"}
    assert wrong(replace(without, vehicle="plane")) == {}


# Nothing heard.


@pytest.mark.parametrize(
    ("link", "bad_bytes", "others", "refused", "message"),
    [
        (SERIAL, 0, (), {}, "nothing arrives (TX and RX?)"),
        (SERIAL, 900, (), {}, "another baud rate, or another program?"),
        (UDP, 0, (5, 3), {}, "the autopilots heard are of system 3 and 5, none is the one configured."),
        (UDP, 0, (), {UNSIGNED: 4, WRONG: 5}, "messages arrive, and are refused (wrong signature): the other end has "),
        (UDP, 0, (), {}, "no heartbeat of an autopilot in 5 s: let the autopilot, its simulator or a router send "),
        (parse_link("udpout:10.0.0.2:14550"), 0, (), {}, "start what listens there"),
        (parse_link("tcp:10.0.0.2:5760"), 0, (), {}, "something answers there"),
    ],
)
def test_silence_is_explained_by_what_arrives(link, bad_bytes, others, refused, message):
    finding = silence(link, bad_bytes, set(others), refused)
    assert not finding.ok
    assert message in finding.message
    assert finding.message.startswith(f"{link}: ")


def test_the_pages_of_the_vehicles_name_what_is_told_to_change():
    docs = Path(__file__).parents[3] / "docs/how-to"
    copter, px4_page = (docs / "ardupilot-copter.md").read_text(), (docs / "px4.md").read_text()
    bare = with_parameters(replace(COPTER, parameters=PLAIN), GPS_AUTO_SWITCH=0)
    for parameter, value in (change.split("=") for change in wrong(bare)["channel"]):
        assert re.search(rf"`{parameter}`.*\| {value} \|", copter)
    for change in (*wrong(VISUAL)["EK3_SRCn_POSXY"], "VISO_TYPE=1"):
        assert f"`{change}`" in copter
    assert "EK3_SRC2_VELXY=6" not in copter
    unset = with_parameters(PX4, EKF2_AGP0_CTRL=0, EKF2_AGP0_ID=0, EKF2_AGP0_DELAY=300.0)
    changes = [
        change for each in (unset, replace(PX4, parameters={})) for found in wrong(each).values() for change in found
    ]
    for parameter, value in (change.split("=") for change in (*changes, *RULES["px4"].port_changes(921_600))):
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


@pytest.mark.network
@pytest.mark.usefixtures("_quick")
def test_the_command_over_a_link(link, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with peer(link, parameters=PLAIN | {"GPS2_TYPE": 14}) as autopilot:
        code = main(["doctor", "--link", link])
    found = findings_of(capsys.readouterr().out)
    assert {what: message for what, (ok, message) in found.items() if not ok} == {}
    assert code == 0
    assert list(tmp_path.iterdir()) == []
    assert autopilot.names() == {"HEARTBEAT", "COMMAND_LONG", "PARAM_REQUEST_READ"}


@pytest.mark.network
@pytest.mark.usefixtures("_quick")
def test_the_command_knows_from_the_configuration_that_the_run_is_dry(link, capsys, tmp_path):
    config = tmp_path / "config.yaml"
    config.write_text("board: rpi-zero-2w\nmavlink: {send_fixes: false}\nlog: {path: null}\n")
    with peer(link, parameters=PLAIN):
        assert main(["doctor", "--config", str(config), "--link", link]) == 0
    autopilot = AutopilotThread(link.replace("udpin", "udpout"), vehicle="px4-copter")
    try:
        main(["doctor", "--config", str(config), "--link", link])
        found = findings_of(capsys.readouterr().out)
    finally:
        autopilot.finish()
    assert found["channel"][0]
    assert found["filter"][0]
    assert found["clock"][0], "its time is that of this machine"


@pytest.mark.network
@pytest.mark.usefixtures("_quick")
def test_the_command_prints_json(link, capsys, tmp_path):
    config = tmp_path / "config.yaml"
    config.write_text(f"mavlink: {{link: '{link}'}}\nlog: {{path: null}}\n")
    with peer(link, parameters=PLAIN, vehicle=mavlink.MAV_TYPE_FIXED_WING, system_id=42):
        main(["doctor", "--config", str(config), "--json"])
    result = json.loads(capsys.readouterr().out)
    assert (result["link"], result["reading"]["system_id"], result["reading"]["vehicle"]) == (link, 42, "plane")
    assert result["ok"] == all(each["ok"] for each in result["findings"])
    assert {"what", "ok", "message", "changes", "exit_code"} == set(result["findings"][0])


@pytest.mark.network
@pytest.mark.usefixtures("_quick")
def test_the_command_waits_for_a_frame_of_the_camera(link, capsys, tmp_path):
    config = tmp_path / "config.yaml"
    config.write_text(f"source: {{uri: 'tcp://127.0.0.1:{free_port()}'}}\nlog: {{path: null}}\n")
    with peer(link, parameters=PLAIN | {"GPS2_TYPE": 14}):
        assert main(["doctor", "--config", str(config), "--link", link]) == 1
    found = findings_of(capsys.readouterr().out)
    assert [what for what, (ok, _) in found.items() if not ok] == ["frames"]


@pytest.mark.network
@pytest.mark.usefixtures("_quick")
def test_where_no_autopilot_is_the_command_says_so_and_looks_at_the_board(link, capsys):
    assert main(["doctor", "--link", link]) == 1
    found = findings_of(capsys.readouterr().out)
    assert not found["link"][0]
    assert "memory" in found
    assert "channel" not in found


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["--link", "udp:127.0.0.1"], "udp:127.0.0.1"),
        (["--link", "serial:/dev/null:fast"], "baud"),
        ([], "--link"),
        (["--config", "/absent.yaml"], "/absent.yaml"),
    ],
)
def test_a_wrong_request_is_a_sentence_and_exits_with_2(arguments, named, capsys):
    assert main(["doctor", *arguments]) == 2
    assert named in capsys.readouterr().err
