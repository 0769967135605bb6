"""`edgevpr run` as a process of its own: real frames, a real link, signals, and a log that survives."""

import json
import os
import signal
import socket
import subprocess
import sys
import time

import cv2
import pytest
from pictures import textured

from edgevpr.cli import main
from edgevpr.runtime.flight.flightlog import read_log


@pytest.fixture(scope="module")
def flight(tmp_path_factory):
    """A map of four places with positions, and 30 frames over them."""
    folder = tmp_path_factory.mktemp("flight")
    for name, count in (("ref", 4), ("query", 30)):
        (folder / name).mkdir()
        for number in range(count):
            cv2.imwrite(str(folder / name / f"{number:02d}.png"), textured(number % 4, 240, 320))
    rows = [f"{number:02d}.png,{50 + number * 0.001},8.0" for number in range(4)]
    (folder / "ref" / "positions.csv").write_text("\n".join(["file,lat,lon", *rows]))
    assert main(["map", "build", str(folder / "m.gpkg"), "--images", str(folder / "ref"), "--technique", "cohog"]) == 0
    return folder


def start(flight, log, *flags, **environment):
    return subprocess.Popen(
        [
            sys.executable, "-m", "edgevpr", "run", "--map", flight / "m.gpkg", "--source", flight / "query",
            "--log", log, *flags,
        ],
        stderr=subprocess.PIPE, text=True, env={**os.environ, **environment},
    )  # fmt: skip


def wait_for_queries(log, count, process):
    deadline_s = time.monotonic() + 60
    while time.monotonic() < deadline_s and process.poll() is None:
        if log.exists() and sum(line["kind"] == "query" for line in read_log(log)) >= count:
            return
        time.sleep(0.05)
    pytest.fail(f"no {count} queries in the log: {process.stderr.read() if process.poll() is not None else ''}")


def free_udp_port():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def test_the_flight_controller_receives_what_the_log_says(flight, tmp_path):
    port, log = free_udp_port(), tmp_path / "flight.jsonl"
    autopilot = subprocess.Popen(
        [sys.executable, "-m", "edgevpr", "simulate", "autopilot", "--link", f"udpin:127.0.0.1:{port}", "--json"],
        stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    run = start(flight, log, "--link", f"udpout:127.0.0.1:{port}", "--rate-hz", "10")
    said = run.communicate(timeout=120)[1]
    autopilot.send_signal(signal.SIGTERM)
    seen = json.loads(autopilot.communicate(timeout=20)[0])
    assert run.returncode == 0, said
    lines = list(read_log(log))
    queries = [line for line in lines if line["kind"] == "query"]
    end = lines[-1]
    assert [line["kind"] for line in (lines[0], end)] == ["start", "end"]
    assert len(queries) == end["queries"] == 30
    assert all(line["accepted"] for line in queries)
    assert seen["bad_bytes"] == seen["lost_packets"] == seen["fixes_denied"] == 0
    assert seen["companion"] == "1/197"
    for name in ("COMMAND_INT", "NAMED_VALUE_INT", "NAMED_VALUE_FLOAT", "ONBOARD_COMPUTER_STATUS"):
        # What was sent before the flight controller listened is gone, and nothing else.
        assert 0 < seen["messages"][name] <= end["mavlink"]["sent"][name]
    mapped = {(50.0 + number * 0.001, 8.0) for number in range(4)}
    assert {(round(fix["lat_deg"], 7), fix["lon_deg"]) for fix in seen["fixes"]} <= mapped
    assert seen["fixes_accepted"] == end["mavlink"]["acks"]["ACCEPTED"] == seen["messages"]["COMMAND_INT"]
    for line in queries:
        cost = line["costs"]
        assert 0 < cost["u_encode"] <= 1
        assert 0 < cost["u_match"] <= 1
        assert cost["rss_mb"] > 10
    # The board draws between the queries too, and the process does more than its queries' stages.
    totals, slack = queries[-1]["totals"], 1 + 1e-4
    assert totals["used_mah"] * slack > sum(line["costs"]["used_mah"] for line in queries)
    assert totals["process_mah"] * slack > totals["marginal_mah"]
    assert totals["marginal_mah"] * slack > sum(line["costs"]["marginal_mah"] for line in queries) > 0


def test_fixes_are_withheld_when_told_so_and_events_still_go_out(flight, tmp_path):
    config = tmp_path / "c.yaml"
    config.write_text("mavlink: {send_fixes: false}\n")
    port, log = free_udp_port(), tmp_path / "flight.jsonl"
    autopilot = subprocess.Popen(
        [sys.executable, "-m", "edgevpr", "simulate", "autopilot", "--link", f"udpin:127.0.0.1:{port}", "--json"],
        stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    run = start(flight, log, "--link", f"udpout:127.0.0.1:{port}", "--rate-hz", "10", "--config", str(config))
    run.communicate(timeout=120)
    autopilot.terminate()
    seen = json.loads(autopilot.communicate(timeout=20)[0])
    assert "COMMAND_INT" not in seen["messages"]
    assert seen["messages"]["NAMED_VALUE_INT"] > 0


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_ends_the_flight_with_everything_flushed(flight, tmp_path, number):
    log = tmp_path / "flight.jsonl"
    run = start(flight, log, "--rate-hz", "0.5", "--link", "udpout:127.0.0.1:9")
    wait_for_queries(log, 1, run)
    asked_s = time.monotonic()
    run.send_signal(number)
    assert run.wait(timeout=20) == 0
    assert time.monotonic() - asked_s < 2.0, "the service manager waits two seconds"
    run.stderr.close()
    assert list(read_log(log))[-1]["kind"] == "end"


def test_kill_9_costs_no_line_that_was_written(flight, tmp_path):
    log = tmp_path / "flight.jsonl"
    run = start(flight, log, "--rate-hz", "20")
    wait_for_queries(log, 5, run)
    run.kill()
    run.communicate()
    queries = [line["query"] for line in read_log(log) if line["kind"] == "query"]
    assert queries == [f"{number:02d}.png" for number in range(len(queries))]
    again = start(flight, log, "--rate-hz", "60")
    again.communicate(timeout=120)
    assert again.returncode == 0
    assert list(read_log(log))[-1]["kind"] == "end"


def test_a_full_disk_does_not_end_the_flight(flight):
    run = start(flight, "/dev/full", "--rate-hz", "60")
    said = run.communicate(timeout=120)[1]
    assert run.returncode == 0
    assert "30 queries, 30 accepted" in said
    assert said.count("flight log") == 1, "said once, not with every line"


def test_systemd_hears_ready_alive_and_stopping(flight, tmp_path):
    address = str(tmp_path / "notify")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(address)
        manager.settimeout(60)
        log = tmp_path / "flight.jsonl"
        run = start(flight, log, "--rate-hz", "10", NOTIFY_SOCKET=address, WATCHDOG_USEC="400000")
        said = []
        while "STOPPING=1" not in said:
            said += manager.recv(4096).decode().splitlines()
        run.communicate(timeout=60)
    assert said.count("READY=1") == 1
    assert said.count("WATCHDOG=1") >= 5
    assert any(line.startswith("STATUS=") and "queries" in line for line in said)


def test_a_source_that_is_not_there_yet_leaves_the_loop_turning(flight, tmp_path):
    address = str(tmp_path / "notify")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(address)
        manager.settimeout(60)
        run = subprocess.Popen(
            [
                sys.executable, "-m", "edgevpr", "run", "--map", flight / "m.gpkg", "--source",
                "rtsp://127.0.0.1:9/nobody", "--log", tmp_path / "f.jsonl",
            ],
            stderr=subprocess.PIPE, text=True,
            env={**os.environ, "NOTIFY_SOCKET": address, "WATCHDOG_USEC": "400000"},
        )  # fmt: skip
        said = []
        while said.count("WATCHDOG=1") < 8 or not any("reopening" in line for line in said):
            said += manager.recv(4096).decode().splitlines()
        run.terminate()
        assert run.wait(timeout=20) == 0
        run.stderr.close()
