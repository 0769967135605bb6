"""`edgevpr check` on a real map, folder, socket and pty; and on each thing that can be wrong."""

import shutil
import socket
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import pytest
import yaml
from answering_autopilot import AnsweringAutopilot
from pictures import textured

from edgevpr import techniques
from edgevpr.core.types import Frame, StageCost
from edgevpr.mavlink.address import parse_link
from edgevpr.places.mapfile import PlaceMap
from edgevpr.runtime.preflight import pick
from edgevpr.runtime.preflight.choose import too_late
from edgevpr.runtime.service.check import Finding, check

pytestmark = [pytest.mark.network, pytest.mark.slow]

ITEMS = ["configuration", "board", "battery", "map", "source", "link", "log"]


def free_port(kind: socket.SocketKind) -> int:
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@pytest.fixture(scope="module")
def flight_folder(tmp_path_factory) -> Path:
    """A folder with a map of `hog` and the images it was made of."""
    folder = tmp_path_factory.mktemp("flight")
    (folder / "images").mkdir()
    technique = techniques.create("hog")
    with PlaceMap.create(folder / "valley.gpkg", technique.spec) as place_map:
        for seed in range(2):
            image = textured(seed)
            cv2.imwrite(str(folder / "images" / f"{seed}.png"), image)
            place_map.add(Frame(image=image, name=f"{seed}.png", t_mono_s=0.0), technique.encode(image))
    return folder


@pytest.fixture
def settings(flight_folder, tmp_path) -> dict:
    """A configuration with which all is well."""
    return {
        "board": "rpi-zero-2w",
        "map": str(flight_folder / "valley.gpkg"),
        "source": {"uri": str(flight_folder / "images")},
        "mavlink": {"link": f"udpin:127.0.0.1:{free_port(socket.SOCK_DGRAM)}"},
        "log": {"path": str(tmp_path / "flight.jsonl")},
    }


@pytest.fixture
def config_file(tmp_path) -> Path:
    return tmp_path / "config.yaml"


def wrong(config_file: Path, settings: dict) -> list[Finding]:
    """What `check` finds wrong without an autopilot and without waiting for a frame."""
    config_file.write_text(yaml.safe_dump(settings))
    findings = check(config_file, offline=True)
    assert [finding.what for finding in findings] == ITEMS
    return [finding for finding in findings if not finding.ok]


def test_a_query_that_is_too_slow_for_any_fix_is_wrong_unless_no_fixes_are_wanted(settings, config_file, monkeypatch):
    probe = pick.probe
    monkeypatch.setattr(pick, "probe", lambda technique: replace(probe(technique), encode=StageCost(6.0, 6.0)))
    (finding,) = wrong(config_file, settings | {"board": "this"})
    assert finding.what == "map"
    assert too_late(6.0) in finding.message
    without_fixes = {"mavlink": {"link": settings["mavlink"]["link"], "send_fixes": False}}
    assert wrong(config_file, settings | {"board": "this"} | without_fixes) == []


def test_a_ground_link_and_a_signing_key_are_looked_at(settings, config_file, tmp_path):
    key = tmp_path / "key"
    key.write_bytes(bytes(32))
    key.chmod(0o600)
    settings["mavlink"] |= {"ground": "udpout:127.0.0.1:9", "signing_key": str(key)}
    assert wrong(config_file, settings) == []
    assert not key.with_name("key.time").exists(), "root must not make what the service is to write"
    key.chmod(0o640)
    (finding,) = wrong(config_file, settings)
    assert (finding.what, "chmod 600" in finding.message) == ("link", True)
    settings["mavlink"] = {"ground": "udpout:127.0.0.1:9"}
    (finding,) = wrong(config_file, settings)
    assert finding.what == "link"


def test_a_tlog_is_looked_at_like_the_flight_log(settings, config_file, tmp_path):
    settings["log"]["tlog"] = str(tmp_path / "flight.tlog")
    config_file.write_text(yaml.safe_dump(settings))
    found = check(config_file, offline=True)
    assert [(each.what, each.ok, each.message) for each in found][-1] == ("tlog", True, str(tmp_path / "flight.tlog"))
    assert list(tmp_path.iterdir()) == [config_file]
    settings["log"]["tlog"] = str(tmp_path / "absent" / "flight.tlog")
    config_file.write_text(yaml.safe_dump(settings))
    (finding,) = [each for each in check(config_file, offline=True) if not each.ok]
    assert (finding.what, "`log: {tlog:" in finding.message) == ("tlog", True)
    settings["mavlink"]["link"] = None
    config_file.write_text(yaml.safe_dump(settings))
    last = check(config_file, offline=True)[-1]
    assert (last.what, last.ok) == ("tlog", True)


def test_all_is_well_and_nothing_is_left_behind(settings, config_file, tmp_path, flight_folder):
    assert wrong(config_file, settings) == []
    assert list(tmp_path.iterdir()) == [config_file]
    assert sorted(path.name for path in flight_folder.iterdir()) == ["images", "valley.gpkg"]


@pytest.mark.parametrize("text", ["map: [", "mapp: valley.gpkg", "source: {rate_hz: 1000}", "\x00", "- 1", None])
def test_a_configuration_that_cannot_be_read_is_the_only_finding(config_file, text):
    if text is not None:
        config_file.write_text(text)
    (finding,) = check(config_file)
    assert (finding.what, finding.ok) == ("configuration", False)
    assert str(config_file) in finding.message


@pytest.mark.parametrize(
    ("changes", "wrong_things", "named"),
    [
        ({"map": None, "source": {"uri": None}}, ["map", "source"], ""),
        ({"board": "rpi-zero-2"}, ["board", "map"], "rpi-zero-2w"),
        ({"battery": {"pack": "4x5200"}}, ["battery", "map"], "4x5200"),
        ({"technique": "cohog"}, ["map"], "hog, not cohog"),
        (
            {"mapping": {"learn": True}, "mavlink": {"link": None}, "source": {"uri": "rtsp://127.0.0.1:9/camera"}},
            ["source"],
            "--link",
        ),
        ({"source": {"uri": "/dev/video99"}}, ["source"], "/dev/video99"),
        ({"source": {"uri": "ftp://camera/x"}}, ["source"], "ftp://camera/x"),
        ({"source": {"uri": "udp://127.0.0.1"}}, ["source"], "udp://127.0.0.1"),
        ({"mavlink": {"link": "udp:127.0.0.1"}}, ["link"], "udp:127.0.0.1"),
        ({"mavlink": {"link": "serial:/dev/ttyACM99:921600"}}, ["link"], "serial:/dev/ttyACM99:921600"),
        ({"mavlink": {"link": "tcp:127.0.0.1:9"}}, ["link"], "Connection refused"),
        ({"log": {"path": "/"}}, ["log"], "/"),
        ({"log": {"path": "/absent/flight.jsonl"}}, ["log"], "/absent"),
    ],
)
def test_what_is_wrong_is_found_at_once(settings, config_file, changes, wrong_things, named):
    findings = wrong(config_file, settings | changes)
    assert [finding.what for finding in findings] == wrong_things
    assert named.strip("-") in findings[0].message


def test_a_flight_that_learns_needs_no_map_yet_and_none_is_made(settings, config_file, tmp_path):
    settings |= {"mapping": {"learn": True}, "map": str(tmp_path / "new.gpkg")}
    assert wrong(config_file, settings) == []
    assert not (tmp_path / "new.gpkg").exists()
    PlaceMap.create(tmp_path / "new.gpkg", techniques.create("hog").spec).close()
    assert wrong(config_file, settings) == []
    settings["map"] = str(tmp_path / "absent" / "new.gpkg")
    (finding,) = wrong(config_file, settings)
    assert finding.what == "map"


def test_places_that_the_budget_does_not_hold_are_told(flight_folder, settings, config_file):
    big = config_file.with_name("big.gpkg")
    shutil.copy(settings["map"], big)
    with PlaceMap.open_for_adding(big) as place_map:
        frame, technique = Frame(image=textured(3), name="3.png", t_mono_s=0.0), techniques.create("hog")
        descriptor = technique.encode(frame.image)
        while len(place_map) * technique.spec.coarse.nbytes < 1e6:
            place_map.add(frame, descriptor)
    config_file.write_text(yaml.safe_dump(settings | {"map": str(big), "memory": {"budget_mb": 1}}))
    (finding,) = (each for each in check(config_file, offline=True) if each.what == "map")
    assert " places are left " in finding.message


def wrong_online(config_file: Path, settings: dict, **how) -> list[Finding]:
    """What `check` finds wrong when it waits for a frame and a heartbeat."""
    config_file.write_text(yaml.safe_dump(settings))
    return [finding for finding in check(config_file, **how) if not finding.ok]


def autopilot_of(settings: dict, **how) -> AnsweringAutopilot:
    return AnsweringAutopilot(parse_link(settings["mavlink"]["link"]).number, **how)


def test_a_frame_and_a_heartbeat_are_waited_for_and_told(settings, config_file):
    told = []
    config_file.write_text(yaml.safe_dump(settings))
    with autopilot_of(settings, system_id=7) as autopilot:
        findings = {finding.what: finding for finding in check(config_file, say=told.append)}
    assert all(finding.ok for finding in findings.values())
    assert findings["source"].message.endswith("160 x 120 pixels")
    assert findings["link"].message.endswith("system 7")
    assert [len(text) > 0 for text in told] == [True, True, False]
    assert autopilot.names() <= {"HEARTBEAT"}


def test_a_camera_that_does_not_deliver_is_wrong(settings, config_file):
    settings["source"]["uri"] = f"rtsp://127.0.0.1:{free_port(socket.SOCK_STREAM)}/camera"
    settings["mavlink"]["link"] = None
    (finding,) = wrong_online(config_file, settings)
    assert finding.what == "source"
    assert finding.message.startswith(f"{settings['source']['uri']}: ")


def edgevpr_check(config_file: Path, *arguments: str) -> subprocess.CompletedProcess:
    command = [sys.executable, "-m", "edgevpr", "check", "--config", str(config_file), *arguments]
    return subprocess.run(command, capture_output=True, text=True)


def test_the_command_prints_a_line_for_each_thing_and_exits_with_0(settings, config_file):
    config_file.write_text(yaml.safe_dump(settings))
    done = edgevpr_check(config_file, "--offline")
    assert (done.returncode, done.stderr) == (0, "")
    assert [line.split()[1] for line in done.stdout.splitlines()] == ITEMS
    with autopilot_of(settings):
        done = edgevpr_check(config_file)
    assert (done.returncode, done.stderr) == (0, "")
    assert edgevpr_check(config_file).returncode == 1
