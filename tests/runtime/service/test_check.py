"""`edgevpr check` on a real map, folder, socket and pty; and on each thing that can be wrong."""

import re
import shutil
from pathlib import Path

import pytest
import yaml
from answering_autopilot import AnsweringAutopilot
from loopback import free_port
from pictures import draw_texture, write_flight
from walks import make_map

from edgevpr import techniques
from edgevpr.cli.main import main
from edgevpr.core.types import Frame
from edgevpr.mavlink.address import parse_link
from edgevpr.places.mapfile import PlaceMap
from edgevpr.power.boards import load_board
from edgevpr.runtime.service import check
from edgevpr.runtime.service.findingcodes import FindingCode

pytestmark = [pytest.mark.network, pytest.mark.slow]

ITEMS = ["configuration", "board", "map", "source", "link", "log"]


@pytest.fixture(scope="module")
def flight_folder(tmp_path_factory) -> Path:
    """A folder with a map of `hog` and the images it was made of."""
    folder = tmp_path_factory.mktemp("flight")
    frames = [Frame(image=draw_texture(seed), name=f"{seed}.png", t_mono_s=0.0) for seed in range(2)]
    write_flight(folder / "images", [frame.image for frame in frames])
    make_map(folder / "valley.gpkg", techniques.create("hog"), frames)
    return folder


@pytest.fixture
def settings(flight_folder, tmp_path) -> dict:
    """A configuration with which all is well."""
    return {
        "board": "rpi-zero-2w",
        "map": str(flight_folder / "valley.gpkg"),
        "source": {"uri": str(flight_folder / "images")},
        "mavlink": {"link": f"udpin:127.0.0.1:{free_port()}"},
        "log": {"path": str(tmp_path / "flight.jsonl")},
    }


@pytest.fixture
def config_file(tmp_path) -> Path:
    return tmp_path / "config.yaml"


def find_offline_faults(config_file: Path, settings: dict) -> list[check.Finding]:
    """What `check` finds wrong without an autopilot and without waiting for a frame."""
    config_file.write_text(yaml.safe_dump(settings))
    findings = check.check_configuration(config_file, offline=True)
    assert [finding.what for finding in findings] == ITEMS
    return [finding for finding in findings if not finding.ok]


def test_check_finds_a_query_too_slow_for_any_fix_unless_it_is_a_dry_run(settings, config_file, monkeypatch):
    monkeypatch.setattr(check, "measure_query", lambda *_: 6.0)
    (finding,) = find_offline_faults(config_file, settings)
    assert (finding.what, finding.reason.code) == ("map", FindingCode.QUERY_TOO_SLOW)
    assert finding.reason.parameters["t_query_s"] == 6.0
    settings["mavlink"]["send_fixes"] = False
    assert find_offline_faults(config_file, settings) == []


@pytest.mark.parametrize(("board", "is_other"), [("this", False), ("thesis-xeon", True)])
def test_check_reports_a_query_time_not_measured_on_the_board(settings, config_file, board, is_other):
    config_file.write_text(yaml.safe_dump(settings | {"board": board}))
    (finding,) = (each for each in check.check_configuration(config_file, offline=True) if each.what == "map")
    assert finding.reason.parameters["t_query_s"] > 0
    assert finding.reason.parameters["machine"].endswith(f", not on {load_board(board).title}") == is_other


def test_check_opens_the_signing_key(settings, config_file, tmp_path):
    key = tmp_path / "key"
    key.write_bytes(bytes(32))
    key.chmod(0o600)
    settings["mavlink"]["signing_key"] = str(key)
    assert find_offline_faults(config_file, settings) == []
    assert not key.with_name("key.time").exists(), "root must not make what the service is to write"
    key.chmod(0o640)
    (finding,) = find_offline_faults(config_file, settings)
    assert finding.what == "link"


def test_check_leaves_no_files(settings, config_file, tmp_path, flight_folder):
    assert find_offline_faults(config_file, settings) == []
    assert list(tmp_path.iterdir()) == [config_file]
    assert sorted(path.name for path in flight_folder.iterdir()) == ["images", "valley.gpkg"]


@pytest.mark.parametrize("text", ["map: [", "mapp: valley.gpkg", "source: {rate_hz: 1000}", "\x00", "- 1", None])
def test_check_stops_at_an_unreadable_configuration(config_file, text):
    if text is not None:
        config_file.write_text(text)
    (finding,) = check.check_configuration(config_file)
    assert (finding.what, finding.ok) == ("configuration", False)
    assert str(config_file) in finding.reason.parameters["problem"]


@pytest.mark.parametrize(
    ("changes", "wrong_things"),
    [
        ({"mavlink": {"link": None}, "log": {"path": None}}, []),
        ({"source": {"uri": "rtsp://127.0.0.1:9/camera"}}, []),  # it may deliver later
        ({"map": None, "source": {"uri": None}}, ["map", "source"]),
        ({"battery": {"pack": "4x5200"}}, ["map"]),
        ({"technique": "cohog"}, ["map"]),
        ({"source": {"uri": "/dev/video99"}}, ["source"]),
        ({"source": {"uri": "ftp://camera/x"}}, ["source"]),
        ({"mavlink": {"link": "udp:127.0.0.1"}}, ["link"]),
        ({"mavlink": {"link": "serial:/dev/ttyACM99:921600"}}, ["link"]),
        ({"mavlink": {"link": "tcp:127.0.0.1:9"}}, ["link"]),
        ({"log": {"path": "/"}}, ["log"]),
        ({"log": {"path": "/absent/flight.jsonl"}}, ["log"]),
    ],
)
def test_check_finds_faults_offline(settings, config_file, changes, wrong_things):
    assert [finding.what for finding in find_offline_faults(config_file, settings | changes)] == wrong_things


def test_check_of_an_unknown_board_does_not_open_the_map(settings, config_file):
    config_file.write_text(yaml.safe_dump(settings | {"board": "rpi-zero-2"}))
    findings = {finding.what: finding.ok for finding in check.check_configuration(config_file, offline=True)}
    assert not findings["board"]
    assert "map" not in findings


def test_check_reports_places_beyond_the_budget(settings, config_file):
    big = config_file.with_name("big.gpkg")
    shutil.copy(settings["map"], big)
    with PlaceMap.open_for_writing(big) as place_map:
        frame, technique = Frame(image=draw_texture(3), name="3.png", t_mono_s=0.0), techniques.create("hog")
        descriptor = technique.encode(frame.image)
        while len(place_map) * technique.spec.coarse.nbytes < 1e6:
            place_map.add(frame, descriptor)
    config_file.write_text(yaml.safe_dump(settings | {"map": str(big), "memory": {"budget_mb": 1}}))
    (finding,) = (each for each in check.check_configuration(config_file, offline=True) if each.what == "map")
    assert re.search(r"\b[1-9]\d* places ", finding.reason.parameters["technique"])


def find_online_faults(config_file: Path, settings: dict) -> list[check.Finding]:
    """What `check` finds wrong when it waits for a frame and a heartbeat."""
    config_file.write_text(yaml.safe_dump(settings))
    return [finding for finding in check.check_configuration(config_file) if not finding.ok]


def start_autopilot(settings: dict, **how) -> AnsweringAutopilot:
    return AnsweringAutopilot(parse_link(settings["mavlink"]["link"]).number, **how)


def test_check_waits_for_a_frame_and_a_heartbeat(settings, config_file, capsys):
    config_file.write_text(yaml.safe_dump(settings))
    with start_autopilot(settings, system_id=7) as autopilot:
        assert main(["check", "--config", str(config_file)]) == 0
    assert [line.split()[1] for line in capsys.readouterr().out.splitlines()] == ITEMS
    assert autopilot.names() <= {"HEARTBEAT"}


def test_check_finds_another_autopilot_than_the_configured(settings, config_file):
    settings["mavlink"]["system_id"] = 3
    with start_autopilot(settings, system_id=4):
        (finding,) = find_online_faults(config_file, settings)
    assert (finding.reason.code, finding.reason.parameters["systems"]) == (FindingCode.OTHER_SYSTEM, "4")


def test_check_finds_a_camera_without_frames(settings, config_file):
    settings["source"]["uri"] = f"rtsp://127.0.0.1:{free_port()}/camera"
    settings["mavlink"]["link"] = None
    (finding,) = find_online_faults(config_file, settings)
    assert (finding.what, finding.reason.code) == ("source", FindingCode.NO_FRAME)


def test_check_does_not_count_a_damaged_image_as_a_frame(settings, config_file, tmp_path):
    folder = tmp_path / "images"
    folder.mkdir()
    (folder / "1.png").write_bytes(b"no picture")
    settings["source"]["uri"], settings["mavlink"]["link"] = str(folder), None
    (finding,) = find_online_faults(config_file, settings)
    assert finding.what == "source"
    shutil.copy(next(Path(settings["map"]).parent.glob("images/*.png")), folder / "2.png")
    assert find_online_faults(config_file, settings) == []
