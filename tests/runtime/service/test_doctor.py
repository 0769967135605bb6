"""`edgevpr doctor`: the rules, on what might be read of a flight controller; and the command over a real link."""

import json
import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
from answering_autopilot import AnsweringAutopilot, healthy_messages
from loopback import free_port
from mavlink_peers import AutopilotThread

from edgevpr.cli.main import main
from edgevpr.mavlink import requestlink as module
from edgevpr.mavlink.address import parse_link
from edgevpr.mavlink.messages import SENSOR_ID
from edgevpr.mavlink.requestlink import AutopilotReading
from edgevpr.mavlink.signing import UNSIGNED, WRONG
from edgevpr.mavlink.wire import mavlink
from edgevpr.runtime.service.doctor import check_autopilot, explain_silence
from edgevpr.runtime.service.findingcodes import FindingCode
from edgevpr.runtime.service.rules import RULES

UDP = parse_link("udpin:127.0.0.1:14550")
SERIAL = parse_link("serial:/dev/ttyAMA0:57600")
FIXES = True
DRY = False
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
    received=("ATTITUDE", "GLOBAL_POSITION_INT", "GPS_RAW_INT"),
    gps_fix=(3, None),
    filter_flags=READY,
    origin=(50.0, 14.0),
    signs=False,
    signs_requests=False,
    answers=True,
    sends_mavlink1=False,
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


def set_parameters(reading: AutopilotReading, **parameters) -> AutopilotReading:
    return replace(reading, parameters=reading.parameters | parameters)


def find_faults(reading: AutopilotReading, link=UDP, plan=FIXES) -> dict:
    """What is wrong, and the changes that it needs."""
    return {each.what: each.changes for each in check_autopilot(reading, link, plan) if not each.ok}


BARE = replace(COPTER, parameters=PLAIN)
VISUAL = replace(COPTER, parameters=PLAIN | {"VISO_TYPE": 1})
HOVERING = replace(COPTER, vehicle="plane", parameters=PLAIN | {"Q_ENABLE": 1})
MUTE = replace(COPTER, answers=False, version=None, parameters={}, received=(), filter_flags=None, origin=None)
SIGNED = replace(MUTE, signs=True, signs_requests=True)


def test_check_autopilot_accepts_a_configured_copter_and_px4():
    assert find_faults(COPTER) == find_faults(PX4) == {}


@pytest.mark.parametrize(
    ("vehicle", "parameters"),
    [
        ("copter", {"GPS1_TYPE": 14, "GPS2_TYPE": 14}),
        ("plane", {}),
        ("plane", {"Q_ENABLE": 0}),
        ("plane", {"Q_ENABLE": 1, "GPS2_TYPE": 14}),
        ("plane", {"Q_ENABLE": 1, "FLOW_TYPE": 6, "EK3_SRC1_VELXY": 5}),
        ("copter", {"FLOW_TYPE": 6, "EK3_SRC2_VELXY": 5}),
    ],
)
def test_check_autopilot_accepts_each_source_of_position(vehicle, parameters):
    assert find_faults(replace(COPTER, vehicle=vehicle, parameters=PLAIN | parameters)) == {}


@pytest.mark.parametrize("vehicle", ["copter", "rover", "vehicle"])
@pytest.mark.parametrize("changes", [PLAIN, {"FLOW_TYPE": 6}, {"FLOW_TYPE": 0, "EK3_SRC1_VELXY": 5}, {"VISO_TYPE": 2}])
def test_check_autopilot_requires_a_second_receiver_without_another_source(vehicle, changes):
    assert find_faults(replace(COPTER, vehicle=vehicle, parameters=PLAIN | changes)) == {"channel": ("GPS2_TYPE=14",)}
    assert find_faults(HOVERING) == {"channel": ("GPS2_TYPE=14",)}


def test_check_autopilot_names_parameters_as_the_firmware_does():
    assert find_faults(BARE) == {"channel": ("GPS2_TYPE=14",)}
    assert find_faults(set_parameters(BARE, GPS_AUTO_SWITCH=0)) == {"channel": ("GPS2_TYPE=14", "GPS_AUTO_SWITCH=1")}
    older = replace(COPTER, parameters={"GPS_TYPE": 1, "GPS_TYPE2": 0, "GPS_AUTO_SWITCH": 1})
    assert find_faults(older) == {"channel": ("GPS_TYPE2=14",)}
    assert find_faults(replace(older, parameters=older.parameters | {"GPS_TYPE": 14})) == {}


def test_check_autopilot_has_a_finding_for_each_broken_rule():
    several = set_parameters(COPTER, GPS_AUTO_SWITCH=4, GPS_PRIMARY=1, EK3_SRC1_POSXY=6, AHRS_EKF_TYPE=2, EK3_ENABLE=0)
    assert find_faults(several) == {
        "GPS_PRIMARY": ("GPS_PRIMARY=0",),
        "EK3_SRCn_POSXY": ("EK3_SRC1_POSXY=3",),
        "AHRS_EKF_TYPE": ("EK3_ENABLE=1", "AHRS_EKF_TYPE=3"),
    }


def test_check_autopilot_wants_a_source_set_and_an_origin_for_odometry():
    changes = ("EK3_SRC2_POSXY=6", "EK3_SRC2_VELXY=0", "EK3_SRC2_POSZ=1", "EK3_SRC2_YAW=1")
    assert find_faults(VISUAL) == {"EK3_SRCn_POSXY": changes}
    prepared = set_parameters(VISUAL, EK3_SRC2_POSXY=6)
    assert find_faults(prepared) == {}
    assert set(find_faults(replace(prepared, origin=None))) == {"origin"}


@pytest.mark.parametrize(
    ("change", "what", "changes"),
    [
        ({"version": (4, 4, 4), "version_text": "4.4.4"}, "firmware", ()),
        ({"version": None, "version_text": None}, "firmware", ()),
        ({"firmware": "other"}, "firmware", ("mavlink: {send_fixes: false}",)),
        ({"sends_mavlink1": True}, "port", ("SERIALn_PROTOCOL=2",)),
        ({"bad_bytes": 5000}, "link", ()),
        ({"other_systems": (2, 3)}, "vehicles", ("mavlink: {system_id: 1}",)),
        ({"filter_flags": None}, "filter", ()),
        ({"filter_flags": READY & ~mavlink.EKF_POS_HORIZ_ABS}, "filter", ()),
        ({"filter_flags": READY & ~mavlink.EKF_ATTITUDE}, "filter", ()),
        ({"filter_flags": READY | mavlink.EKF_CONST_POS_MODE}, "filter", ()),
        ({"gps_fix": (None, None)}, "gps", ()),
        ({"gps_fix": (1, 2)}, "gps", ()),
        ({"origin": None}, "origin", ()),
        ({"clock_ahead_s": 86_400.0}, "clock", ("timedatectl set-ntp true",)),
        ({"clock_ahead_s": -86_400.0}, "clock", ("timedatectl set-ntp true",)),
        ({"received": ("ATTITUDE",)}, "streams", ()),
    ],
)
def test_check_autopilot_finds_each_fault_alone(change, what, changes):
    assert find_faults(replace(COPTER, **change)) == {what: changes}


def test_check_autopilot_accepts_unknown_values():
    assert find_faults(replace(COPTER, clock_ahead_s=None, round_trip_s=None, gps_fix=(0, 4))) == {}


def test_check_autopilot_wants_a_faster_line():
    changes = ("SERIALn_PROTOCOL=2", "SERIALn_BAUD=921")
    assert find_faults(replace(COPTER, round_trip_s=0.4), SERIAL) == {"link": changes}
    px4_changes = ("MAV_1_CONFIG=102", "MAV_1_MODE=2", "SER_TEL2_BAUD=921600")
    assert find_faults(replace(PX4, round_trip_s=0.4), SERIAL) == {"link": px4_changes}


def test_check_autopilot_reports_only_the_link_without_an_answer():
    assert set(find_faults(MUTE)) == set(find_faults(SIGNED)) == {"link"}
    assert set(find_faults(replace(MUTE, signs=True))) == {"link", "signing"}
    assert find_faults(replace(COPTER, signs=True)) == {}


@pytest.mark.parametrize("vehicle", ["copter", "rover"])
def test_check_autopilot_wants_no_second_receiver_for_a_dry_run(vehicle):
    bare = replace(COPTER, vehicle=vehicle, parameters=PLAIN | {"GPS_AUTO_SWITCH": 0})
    assert find_faults(bare) == {"channel": ("GPS2_TYPE=14", "GPS_AUTO_SWITCH=1")}
    assert find_faults(bare, plan=DRY) == {}


@pytest.mark.parametrize(
    ("parameters", "change"),
    [
        ({"GPS2_TYPE": 14}, "GPS2_TYPE=0"),
        ({"GPS1_TYPE": 14}, "GPS1_TYPE=1"),
        ({"VISO_TYPE": 1, "EK3_SRC2_POSXY": 6}, "VISO_TYPE=0"),
    ],
)
def test_check_autopilot_finds_parameters_that_prevent_arming_in_a_dry_run(parameters, change):
    ready = replace(COPTER, parameters=PLAIN | parameters)
    assert find_faults(ready) == {}
    assert find_faults(ready, plan=DRY) == {"channel": (change,)}
    older = replace(COPTER, parameters={"GPS_TYPE": 1, "GPS_TYPE2": 14})
    assert find_faults(older, plan=DRY) == {"channel": ("GPS_TYPE2=0",)}


def test_check_autopilot_accepts_a_constant_position_of_px4_alone():
    assert find_faults(replace(PX4, filter_flags=0x3FF)) == {}, "as a real one says on the pad"
    assert set(find_faults(replace(COPTER, filter_flags=0x3FF))) == {"filter"}


def test_check_autopilot_wants_px4_to_use_message_296():
    assert find_faults(set_parameters(PX4, EKF2_AGP0_CTRL=0, EKF2_AGP0_ID=0, EKF2_AGP0_DELAY=300.0)) == {
        "channel": ("EKF2_AGP0_CTRL=1",),
        "EKF2_AGP0_DELAY": ("EKF2_AGP0_DELAY=0",),
        "EKF2_AGP0_ID": ("EKF2_AGP0_ID=1",),
    }
    assert find_faults(set_parameters(PX4, EKF2_AGP0_CTRL=2)) == {"channel": ("EKF2_AGP0_CTRL=1",)}


def test_check_autopilot_wants_odometry_of_a_px4_without_message_296():
    without = replace(PX4, parameters={})
    with_flow = set_parameters(without, EKF2_OF_CTRL=1)
    assert find_faults(without) == find_faults(with_flow) == {"channel": ("EKF2_EV_CTRL=1",)}
    (others,) = (each for each in check_autopilot(set_parameters(without, EKF2_EV_CTRL=15), UDP, FIXES) if not each.ok)
    assert (others.changes, others.reason.parameters["value"]) == (("EKF2_EV_CTRL=1",), 15)
    assert find_faults(set_parameters(without, EKF2_EV_CTRL=1)) == {}
    assert find_faults(set_parameters(without, EKF2_EV_CTRL=1, EKF2_EV_NOISE_MD=1)).keys() == {"EKF2_EV_NOISE_MD"}
    assert find_faults(replace(without, vehicle="plane")) == {}


def test_check_autopilot_finds_an_old_px4():
    old = replace(PX4, vehicle="plane", version=(1, 14, 3), version_text="1.14.3", parameters={})
    assert find_faults(old) == {"firmware": ()}
    assert set(find_faults(replace(PX4, version=None))) == {"firmware"}
    assert find_faults(replace(PX4, sends_mavlink1=True)) == {"port": ("MAV_PROTO_VER=2",)}


@pytest.mark.parametrize(
    ("link", "bad_bytes", "others", "refused", "code", "cause"),
    [
        (SERIAL, 0, (), {}, FindingCode.SERIAL_SILENT, {}),
        (SERIAL, 900, (), {}, FindingCode.SERIAL_NOT_MAVLINK, {}),
        (UDP, 0, (5, 3), {}, FindingCode.OTHER_SYSTEM, {"systems": "3 and 5"}),
        (UDP, 0, (), {UNSIGNED: 4, WRONG: 5}, FindingCode.MESSAGES_REFUSED, {"cause": WRONG}),
        (UDP, 0, (), {}, FindingCode.NO_HEARTBEAT, {}),
    ],
)
def test_explain_silence_names_the_cause(link, bad_bytes, others, refused, code, cause):
    signing, reader = SimpleNamespace(refused=refused), SimpleNamespace(bad_bytes=bad_bytes)
    finding = explain_silence(link, SimpleNamespace(signing=signing, reader=reader, other_systems=set(others)))
    assert (finding.ok, finding.reason.code) == (False, code)
    assert finding.reason.parameters.items() >= {"address": str(link), **cause}.items()


def test_doctor_changes_are_on_the_how_to_pages():
    docs = Path(__file__).parents[3] / "docs/how-to"
    copter, px4_page = (docs / "ardupilot-copter.md").read_text(), (docs / "px4.md").read_text()
    bare = set_parameters(replace(COPTER, parameters=PLAIN), GPS_AUTO_SWITCH=0)
    for parameter, value in (change.split("=") for change in find_faults(bare)["channel"]):
        assert re.search(rf"`{parameter}`.*\| {value} \|", copter)
    for change in (*find_faults(VISUAL)["EK3_SRCn_POSXY"], "VISO_TYPE=1"):
        assert f"`{change}`" in copter
    assert "EK3_SRC2_VELXY=6" not in copter
    unset = set_parameters(PX4, EKF2_AGP0_CTRL=0, EKF2_AGP0_ID=0, EKF2_AGP0_DELAY=300.0)
    changes = [
        change
        for each in (unset, replace(PX4, parameters={}))
        for found in find_faults(each).values()
        for change in found
    ]
    for parameter, value in (change.split("=") for change in (*changes, *RULES["px4"].port_changes(921_600))):
        assert re.search(rf"`{parameter}` \| {value}[ |]", px4_page)


@pytest.fixture
def _listen_briefly(monkeypatch):
    monkeypatch.setattr(module, "LISTEN_S", 0.2)


@pytest.fixture
def link() -> str:
    return f"udpin:127.0.0.1:{free_port()}"


def serve_peer(link: str, **autopilot) -> AnsweringAutopilot:
    return AnsweringAutopilot(parse_link(link).number, messages=healthy_messages(), **autopilot)


def parse_findings(printed: str) -> dict[str, bool]:
    found = (line.split(maxsplit=2) for line in printed.splitlines() if not line.startswith(" "))
    return {what: verdict == "ok" for verdict, what, _ in found}


@pytest.mark.network
@pytest.mark.usefixtures("_listen_briefly")
def test_doctor_over_a_link_only_reads(link, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with serve_peer(link, parameters=PLAIN | {"GPS2_TYPE": 14}) as autopilot:
        code = main(["doctor", "--link", link])
    assert [what for what, ok in parse_findings(capsys.readouterr().out).items() if not ok] == []
    assert code == 0
    assert list(tmp_path.iterdir()) == []
    assert autopilot.names() == {"HEARTBEAT", "COMMAND_LONG", "PARAM_REQUEST_READ"}


@pytest.mark.network
@pytest.mark.usefixtures("_listen_briefly")
def test_doctor_reads_the_configuration_and_prints_json(link, capsys, tmp_path):
    config = tmp_path / "config.yaml"
    config.write_text(f"mavlink: {{link: '{link}', send_fixes: false}}\nlog: {{path: null}}\n")
    autopilot = AutopilotThread(link.replace("udpin", "udpout"), vehicle="px4-copter")
    try:
        main(["doctor", "--config", str(config), "--json"])
    finally:
        autopilot.finish()
    result = json.loads(capsys.readouterr().out)
    assert (result["link"], result["reading"]["system_id"], result["reading"]["vehicle"]) == (link, 1, "copter")
    assert result["ok"] == all(each["level"] == "ok" for each in result["findings"])
    fine = {each["what"] for each in result["findings"] if each["level"] == "ok"}
    assert {"channel", "filter", "clock"} <= fine, "it is a dry run, and its time is that of this machine"


@pytest.mark.network
@pytest.mark.usefixtures("_listen_briefly")
def test_doctor_waits_for_a_frame_of_the_camera(link, capsys, tmp_path):
    config = tmp_path / "config.yaml"
    config.write_text(f"source: {{uri: 'tcp://127.0.0.1:{free_port()}'}}\nlog: {{path: null}}\n")
    with serve_peer(link, parameters=PLAIN | {"GPS2_TYPE": 14}):
        assert main(["doctor", "--config", str(config), "--link", link]) == 1
    assert [what for what, ok in parse_findings(capsys.readouterr().out).items() if not ok] == ["frames"]


@pytest.mark.network
@pytest.mark.usefixtures("_listen_briefly")
@pytest.mark.parametrize(("where", "code"), [("here", 1), ("udpout:no-such-host.invalid:14550", 2)])
def test_doctor_checks_the_machine_without_an_autopilot(where, code, link, capsys):
    assert main(["doctor", "--link", link if where == "here" else where]) == code
    found = parse_findings(capsys.readouterr().out)
    assert not found["link"]
    assert "memory" in found
    assert "channel" not in found
