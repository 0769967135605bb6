"""`edgevpr run` as a process of its own: real frames, a real link, signals, and a log that survives."""

import os
import signal
import time

import psutil
import pytest
from flight_process import finish_flight, open_notify_socket, read_cpu_s, serve_autopilot, start, wait_for
from flights import PLACES, STEP_DEG, select

from edgevpr.cli.main import main
from edgevpr.core.reasons import Reason, ReasonCode
from edgevpr.runtime.flight import startup
from edgevpr.runtime.flight.flightlog import read_log

pytestmark = pytest.mark.process


@pytest.fixture
def fly(recording, tmp_path):
    """Start a flight over the map's own pictures; its log is `tmp_path`/flight.jsonl unless another is named."""

    def start_flight(*flags, log=tmp_path / "flight.jsonl", **environment):
        return start(recording / "cohog.gpkg", recording / "blind" / "images", log, *flags, **environment)

    return start_flight


def test_run_sends_what_it_logs(fly, tmp_path):
    with serve_autopilot() as (link, asked):
        run = fly("--link", link, "--rate-hz", "3")  # ten seconds: a vehicle must have been heard before the first fix
        said = finish_flight(run)
        seen = asked()
    lines = list(read_log(tmp_path / "flight.jsonl"))
    queries, end = select(lines, "query"), lines[-1]
    assert [line["kind"] for line in (lines[0], end)] == ["start", "end"]
    assert len(queries) == end["queries"] == PLACES
    assert all(line["accepted"] for line in queries)
    assert seen.bad_bytes == seen.lost_packets == seen.fixes_denied == 0
    assert seen.companion == "1/197"
    for name in ("COMMAND_INT", "NAMED_VALUE_INT", "NAMED_VALUE_FLOAT", "ONBOARD_COMPUTER_STATUS"):
        # What was sent before the flight controller listened is gone, and nothing else.
        assert 0 < seen.messages[name] <= end["mavlink"]["sent"][name]
    mapped = {(round(50.0 + number * STEP_DEG, 7), 8.0) for number in range(PLACES)}
    assert {(fix["lat_deg"], fix["lon_deg"]) for line in queries if (fix := line["fix"])["sent"]} <= mapped
    assert seen.fixes_accepted == end["mavlink"]["acks"]["ACCEPTED"] == seen.messages["COMMAND_INT"]
    # A line that says so was right, and so was the next; what waited for longer is told by the line of its answer.
    told = {line["query"] for line in queries if line["fix"]["sent"]}
    answered = [line for line in select(lines, "answer") if line["sent"]]
    assert [line["result"] for line in answered] == ["ACCEPTED"] * seen.fixes_accepted
    assert told <= {line["query"] for line in answered}
    assert len(answered) == len({line["query"] for line in answered})
    assert f"{seen.fixes_accepted} accepted" in said
    # The board draws between the queries too, and reading is part of a query's cost.
    totals, slack = queries[-1]["totals"], 1 + 1e-4
    assert totals["used_mah"] * slack > sum(line["costs"]["used_mah"] for line in queries)
    assert totals["used_mah"] * slack > totals["marginal_mah"]
    assert totals["marginal_mah"] * slack > sum(line["costs"]["marginal_mah"] for line in queries) > 0


WITHHELD = {"DRY_RUN", "NO_TELEMETRY"}  # the second for five seconds


def test_dry_run_sends_everything_but_fixes(fly, tmp_path):
    with serve_autopilot() as (link, asked):
        said = finish_flight(fly("--link", link, "--rate-hz", "20", "--dry-run"))
        seen = asked()
    assert "COMMAND_INT" not in seen.messages
    for name in ("HEARTBEAT", "NAMED_VALUE_INT", "NAMED_VALUE_FLOAT", "ONBOARD_COMPUTER_STATUS"):
        assert seen.messages[name] > 0
    lines = list(read_log(tmp_path / "flight.jsonl"))
    queries, start_line = select(lines, "query"), lines[0]
    assert all(line["accepted"] for line in queries)
    assert not any(line["fix"]["sent"] for line in queries)
    assert {line["fix"]["why"]["code"] for line in queries} <= WITHHELD
    assert start_line["decided"]["dry_run"]
    assert not start_line["config"]["mavlink"]["send_fixes"]
    assert lines[-1]["mavlink"]["sent"]["STATUSTEXT"] >= 2, "started, and dry run; more on a busy machine"
    assert said.count(str(Reason(ReasonCode.DRY_RUN))) == 2, "at the start, and with the counts at the end"


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_run_ends_by_a_signal_with_a_complete_log(fly, tmp_path, number):
    run = fly("--rate-hz", "0.5", "--link", "udpout:127.0.0.1:9")
    wait_for("query", tmp_path / "flight.jsonl", run)
    run.send_signal(number)
    assert run.wait(timeout=60) == 0
    run.stderr.close()
    lines = list(read_log(tmp_path / "flight.jsonl"))
    assert lines[-1]["kind"] == "end"
    # By the flight's own clock, which other programs cannot hold up: the service manager waits two seconds.
    assert lines[-1]["t_mono_s"] - lines[0]["t_mono_s"] < 2 * lines[-1]["queries"] + 2.0
    assert lines[-1]["queries"] < PLACES


def test_run_ends_by_a_signal_before_the_flight(recording, tmp_path, monkeypatch, caplog):
    """A large map takes its time on a slow board."""

    def compute_forever(*_, **__):
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(60)
        pytest.fail("it went on computing")

    monkeypatch.setattr(startup, "open_recogniser", compute_forever)
    place_map, images, log = recording / "cohog.gpkg", recording / "seen" / "images", tmp_path / "f.jsonl"
    with caplog.at_level("INFO"):
        assert main(["run", "--map", str(place_map), "--source", str(images), "--log", str(log)]) == 0
    assert "stopped" in caplog.messages[-1]
    assert not log.exists()


def test_run_breaks_off_a_long_query(recording, tmp_path):
    """Many regions of thirty places, compared as the thesis does, take seconds."""
    place_map, images, log = tmp_path / "slow.gpkg", recording / "blind" / "images", tmp_path / "flight.jsonl"
    built = ["map", "build", place_map, "--images", images, "--technique", "cohog", "--param", "w1=1200"]
    assert main([*map(str, built), "--no-calibrate"]) == 0
    with open_notify_socket(tmp_path) as (listening, environment):
        run = start(place_map, images, log, "--matching", "thesis", **environment)
        while b"READY=1" not in listening.recv(4096):
            pass
        busy_s = read_cpu_s(run.pid)
        while read_cpu_s(run.pid) < busy_s + 0.5:  # more than reading and encoding take
            assert run.poll() is None
            time.sleep(0.02)
        run.terminate()
        finish_flight(run)
    assert [line["kind"] for line in read_log(log)] == ["start", "end"], "what is broken off is no query"


def test_run_notifies_systemd(fly, tmp_path):
    with open_notify_socket(tmp_path) as (listening, environment):
        run = fly("--rate-hz", "20", **environment)
        said = []
        while "STOPPING=1" not in said:
            said += listening.recv(4096).decode().splitlines()
        run.communicate(timeout=60)
    assert said.count("READY=1") == 1
    assert said.count("WATCHDOG=1") >= 5
    assert any(line.startswith("STATUS=") and "queries" in line for line in said)


def test_run_puts_a_relative_log_into_the_folder_of_logs(fly, tmp_path):
    (tmp_path / "logs").mkdir()
    finish_flight(fly("--rate-hz", "60", log="own.jsonl", LOGS_DIRECTORY=str(tmp_path / "logs")))
    assert list(read_log(tmp_path / "logs" / "own.jsonl"))[-1]["kind"] == "end"


def test_service_runs_without_a_writable_status_and_opens_no_port(fly, tmp_path):
    config, status = tmp_path / "c.yaml", tmp_path / "nowhere" / "s"
    config.write_text(f"status: {{file: {status}}}\n")
    assert str(status) in finish_flight(fly("--config", config), code=1)
    log = tmp_path / "2.jsonl"
    service = fly("--config", config, "--rate-hz", "2", log=log, NOTIFY_SOCKET=str(tmp_path / "nobody"))
    wait_for("query", log, service)
    assert {each.status for each in psutil.Process(service.pid).net_connections("inet")} <= {psutil.CONN_NONE}
    service.terminate()
    finish_flight(service)
