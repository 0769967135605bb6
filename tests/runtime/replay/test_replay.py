"""A flight that a real process has recorded, with a real link, is flown again: to the byte, or with something else."""

import json
import shutil
import signal

import pytest
import yaml
from commands import expect_refusal
from flight_process import finish_flight, serve_autopilot, start, wait_for
from flights import PLACES, select
from mavlink_peers import Peer, UdpPort

from edgevpr.cli.main import main
from edgevpr.mavlink.wire import mavlink
from edgevpr.review.compare import compare_lines
from edgevpr.review.replay import replay
from edgevpr.runtime.flight.recording import TAPE, list_recordings

pytestmark = pytest.mark.slow

FAST_RATE = "--rate-hz", "15"


@pytest.fixture
def fly(recording, tmp_path):
    """Start a recorded flight over the map's own pictures; its log is `tmp_path`/flight.jsonl."""

    def start_flight(*flags, place_map=None, pictures=None):
        place_map = place_map or recording / "cohog.gpkg"
        pictures = pictures or recording / "blind" / "images"
        return start(place_map, pictures, tmp_path / "flight.jsonl", "--record", str(tmp_path / "recorded"), *flags)

    return start_flight


def replay_and_compare(log, **how):
    """Replay the flight of a log, and hold both against each other; give the lines of the replay."""
    again = replay(log, **how)
    lines = compare_lines(again.flown, again.lines)
    assert lines.others == []
    assert again.packets.others == []
    assert lines.alike == len(again.lines) > 0
    assert again.guessed == 0
    return again, lines


def test_replay_of_an_ardupilot_flight_is_identical_or_reports_other_answers(fly, tmp_path, monkeypatch, capsys):
    log = str(tmp_path / "flight.jsonl")
    with serve_autopilot() as (link, _):
        finish_flight(fly("--link", link, *FAST_RATE))
    again, lines = replay_and_compare(log)
    assert again.why_ended is None
    assert lines.after == 0
    assert [line["kind"] for line in (again.lines[0], again.lines[-1])] == ["start", "end"]
    assert len(select(again.lines, "query")) == PLACES
    sent = again.lines[-1]["mavlink"]["sent"]
    assert again.packets.alike >= sum(sent.values()) > PLACES, "every packet was compared"
    monkeypatch.setattr("edgevpr.runtime.recognise.recognition.round", lambda value, digits=0: 7.0, raising=False)
    assert main(["replay", log]) == 1
    assert ": score was " in capsys.readouterr().out
    assert main(["replay", log, "--json"]) == 1
    assert len(json.loads(capsys.readouterr().out)["lines"]["others"]) == PLACES


def test_replay_of_a_px4_flight_is_identical(fly, tmp_path):
    with serve_autopilot(vehicle="px4-plane") as (link, _):
        finish_flight(fly("--link", link, "--rate-hz", "8"))
    again, _ = replay_and_compare(tmp_path / "flight.jsonl")
    assert again.lines[-1]["mavlink"]["received"]["HEARTBEAT"] > 0


def test_replay_includes_signals_and_a_closed_terminal(fly, tmp_path):
    log = tmp_path / "flight.jsonl"
    with serve_autopilot() as (link, _):
        flight = fly("--link", link, "--rate-hz", "5")
        wait_for("query", log, flight)
        flight.send_signal(signal.SIGHUP)
        wait_for("query", log, flight, count=5)
        flight.send_signal(signal.SIGTERM)
        finish_flight(flight)
    again, _ = replay_and_compare(log)
    assert again.why_ended is None


def test_replay_of_a_flight_timed_by_its_images_is_identical(fly, recording, tmp_path):
    rows = []
    for number in range(6):
        picture = f"{number}.png"
        shutil.copy(recording / "blind" / "images" / picture, tmp_path / picture)
        rows.append(f"{picture},,,{1000 + 0.1 * number:.1f}")
    (tmp_path / "positions.csv").write_text("\n".join(["file,lat,lon,time", *rows]))
    finish_flight(fly("--rate-hz", "0.02", pictures=tmp_path))
    (tape,) = (tmp_path / "recorded").glob(f"*/{TAPE}")  # an earlier build had more keys of a board
    tape.write_text(tape.read_text().replace('"arm64_mips": ', '"single": 1.0, "arm64_mips": ', 1))
    assert '"single": 1.0' in tape.read_text()
    again, _ = replay_and_compare(tmp_path / "flight.jsonl")
    assert again.lines[0]["decided"]["rate_hz"] == pytest.approx(10)
    assert len(select(again.lines, "query")) == 6


def test_replay_of_a_killed_flight_ends_with_its_tape(fly, tmp_path):
    log = tmp_path / "flight.jsonl"
    with serve_autopilot() as (link, _):
        flight = fly("--link", link, "--rate-hz", "10")
        wait_for("query", log, flight, count=12)
        flight.kill()
        finish_flight(flight, -signal.SIGKILL)
    again, _ = replay_and_compare(log)
    assert again.why_ended
    assert len(select(again.lines, "query")) >= 2, "what is half a second old is on the disk"
    tape = list_recordings(tmp_path / "recorded")[-1] / TAPE
    first, rest = tape.read_bytes().split(b"\n", 1)
    for share in (0.1, 0.6):  # a power cut, at any byte
        tape.write_bytes(first + b"\n" + rest[: round(share * len(rest))])
        shorter, _ = replay_and_compare(log)
        assert len(shorter.lines) <= len(again.lines)


def test_replay_ignores_only_the_signature_of_signed_packets(fly, tmp_path):
    key = tmp_path / "key"
    key.write_bytes(bytes(range(32)))
    key.chmod(0o600)
    config = tmp_path / "c.yaml"
    port = UdpPort()
    settings = {"signing_key": str(key), "signing_state": str(tmp_path / "time")}
    config.write_text(yaml.safe_dump({"mavlink": settings | {"link": f"udpout:127.0.0.1:{port.number}"}}))
    flight = fly("--config", str(config), "--rate-hz", "5")
    unsigned = Peer(port)
    assert unsigned.expect("HEARTBEAT").get_header().incompat_flags == mavlink.MAVLINK_IFLAG_SIGNED
    unsigned.heartbeat()
    finish_flight(flight)
    port.close()
    again, _ = replay_and_compare(tmp_path / "flight.jsonl")
    assert (tmp_path / "time").exists()
    assert again.packets.alike > 0
    assert again.lines[-1]["mavlink"]["refused_signatures"] == {"unsigned": 1}
    assert bytes(range(32)).hex() not in (list_recordings(tmp_path / "recorded")[-1] / TAPE).read_text()


def test_replay_reports_missing_files(fly, recording, tmp_path, capsys):
    log = tmp_path / "flight.jsonl"
    assert str(log) in expect_refusal(capsys, "replay", log)
    finish_flight(start(recording / "cohog.gpkg", recording / "blind" / "images", log, "--rate-hz", "60"))
    assert "not recorded" in expect_refusal(capsys, "replay", log)
    log.unlink()
    place_map = tmp_path / "m.gpkg"
    shutil.copy(recording / "cohog.gpkg", place_map)
    finish_flight(fly(*FAST_RATE, place_map=place_map))
    place_map.rename(tmp_path / "elsewhere.gpkg")
    assert "--map" in expect_refusal(capsys, "replay", log)
    (there := tmp_path / "there").mkdir()
    shutil.move(str(tmp_path / "recorded"), str(there))
    shutil.move(str(log), str(there))
    moved = str(there / log.name)
    (frame,) = (there / "recorded").glob("*/frames/000020.jpg")
    frame.write_bytes(frame.read_bytes()[:100])
    assert main(["replay", moved, "--map", str(tmp_path / "elsewhere.gpkg")]) == 0
    said = capsys.readouterr().out
    assert "truncated" in said
    assert " 0 differ" in said
    (tape,) = (there / "recorded").glob(f"*/{TAPE}")
    tape.write_text(tape.read_text().replace('"mavlink": {', '"mavlink": {"ground": "udpout:10.0.0.2:14550", ', 1))
    assert "second link" in expect_refusal(capsys, "replay", moved)
    shutil.rmtree(there / "recorded")
    assert "neither at" in expect_refusal(capsys, "replay", moved)
