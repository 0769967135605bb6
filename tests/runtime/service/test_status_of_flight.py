"""The status of a flight that is a process of its own, and `edgevpr top` on a terminal and off it."""

import json
import os
import pty
import re
import select
import signal
import subprocess
import sys
import time
from contextlib import contextmanager

import psutil
import pytest
from flight_process import start, wait_for

from edgevpr.cli.main import main
from edgevpr.runtime.flight.flightlog import read_log
from edgevpr.runtime.flight.statusreader import StatusReader

PATIENCE_S = 60.0


@pytest.fixture
def fly(recording, tmp_path):
    """Start flights with the status socket that is given with them, which end with the test."""
    flights = []

    def started(socket=tmp_path / "status.sock", number=0, rate_hz="2", **environment):
        config, log = tmp_path / f"{number}.yaml", tmp_path / f"{number}.jsonl"
        config.write_text(f"status: {{socket: {socket or 'null'}}}\n")
        flags = ("--rate-hz", rate_hz, "--config", str(config))
        images = recording / "blind" / "images"
        flights.append(start(recording / "cohog.gpkg", images, log, *flags, **environment))
        return flights[-1]

    yield started
    for each in flights:
        each.kill()
        each.wait()
        each.stderr.close()


def status_of(path, wanted=lambda status: True):
    give_up_s = time.monotonic() + PATIENCE_S
    with StatusReader(path) as reader:
        while time.monotonic() < give_up_s:
            if (status := reader.read(1.0)) and wanted(status):
                return status
    raise AssertionError(f"no such status at {path}: {reader.trouble}")


def test_a_flight_tells_its_status_opens_no_port_and_removes_its_socket(fly, tmp_path):
    run, path = fly(), tmp_path / "status.sock"
    status = status_of(path, lambda status: status.accepted)
    assert status.queries >= status.accepted >= 1
    assert path.stat().st_mode & 0o777 == 0o660
    listening = [each for each in psutil.Process(run.pid).net_connections("inet") if each.status == "LISTEN"]
    assert not listening
    run.terminate()
    said = run.communicate(timeout=PATIENCE_S)
    assert run.returncode == 0, said
    assert not path.exists()


def test_a_service_has_its_socket_where_systemd_says_and_else_there_is_none(fly, tmp_path):
    (tmp_path / "run").mkdir()
    run = fly(socket=None, RUNTIME_DIRECTORY=str(tmp_path / "run"))
    assert status_of(tmp_path / "run" / "status.sock")
    run.terminate()
    run.communicate(timeout=PATIENCE_S)
    run = fly(socket=None, number=1)
    wait_for("query", tmp_path / "1.jsonl", run)
    assert not [each for each in tmp_path.rglob("*") if each.is_socket()]


def test_a_flight_that_was_killed_leaves_a_socket_that_the_next_one_takes(fly, tmp_path):
    run, path = fly(), tmp_path / "status.sock"
    with StatusReader(path) as reader:
        while reader.read(1.0) is None:
            pass
        run.kill()
        run.communicate()
        while reader.read(0.1) is not None:
            pass
        assert reader.trouble
        assert path.is_socket()
        fly(number=1)
        while reader.read(1.0) is None:
            pass


def test_a_second_flight_is_refused_and_a_second_service_flies_without(fly, tmp_path):
    fly()
    first = status_of(tmp_path / "status.sock")
    refused = fly(number=1)
    said = refused.communicate(timeout=PATIENCE_S)[1]
    assert refused.returncode == 1
    assert "edgevpr: Another flight tells its status at" in said
    assert "Traceback" not in said
    service = fly(number=2, NOTIFY_SOCKET=str(tmp_path / "nobody"))
    wait_for("query", tmp_path / "2.jsonl", service)
    service.terminate()
    assert "Another flight tells its status at" in service.communicate(timeout=PATIENCE_S)[1]
    assert service.returncode == 0
    assert status_of(tmp_path / "status.sock").elapsed_s > first.elapsed_s, "the first one still has it"


def test_a_reader_that_hangs_does_not_hold_up_the_flight(fly, tmp_path):
    run, path = fly(rate_hz="4"), tmp_path / "status.sock"
    command = [sys.executable, "-m", "edgevpr", "top", "--socket", path]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as top:
        assert top.stdout.readline()
        top.send_signal(signal.SIGSTOP)
        assert run.communicate(timeout=PATIENCE_S)
        top.kill()
    assert run.returncode == 0
    assert list(read_log(tmp_path / "0.jsonl"))[-1]["kind"] == "end"


def test_once_prints_the_whole_status_for_people_and_programs(fly, tmp_path, capsys):
    fly()
    path = str(tmp_path / "status.sock")
    status_of(path, lambda status: status.accepted)
    assert main(["top", "--socket", path, "--once"]) == 0
    shown = dict(line.split(maxsplit=1) for line in capsys.readouterr().out.splitlines())
    for label in ("edgevpr", "frames", "rate", "queries", "CPU", "RAM", "heat", "charge", "match", "newest", "link"):
        assert shown[label]
    assert re.search(r"place \d+ \(\d\d\.png\), confidence 0\.9\d+|confidence 1\.0000", shown["match"])
    assert main(["top", "--socket", path, "--once", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["accepted"] >= 1


def test_where_no_flight_runs_once_says_so(tmp_path, capsys):
    assert main(["top", "--socket", str(tmp_path / "s"), "--once"]) == 1
    assert capsys.readouterr().err == (
        f"edgevpr: No flight tells its status at {tmp_path}/s: start one, or name its socket with --socket.\n"
    )


def test_off_a_terminal_it_prints_lines_says_that_a_flight_ended_and_goes_on(fly, tmp_path):
    command = [sys.executable, "-m", "edgevpr", "top", "--socket", str(tmp_path / "status.sock")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as top:
        assert top.stdout.readline().startswith("no flight tells its status at ")
        for number in range(2):
            run = fly(number=number)
            assert "queries" in top.stdout.readline()
            run.terminate()
            run.communicate(timeout=PATIENCE_S)
            while "queries" in (line := top.stdout.readline()):
                assert "\x1b" not in line
            assert re.match("the flight at .* has ended|no flight tells", line)
        top.send_signal(signal.SIGINT)
        said = top.communicate(timeout=PATIENCE_S)
    assert top.returncode == 0
    assert said[1] == ""


@contextmanager
def terminal(*command):
    """A program on a terminal of 60 columns and 12 lines; gives a call that waits for words on it, and returns all."""
    pid, descriptor = pty.fork()
    if pid == 0:
        os.environ.update(COLUMNS="60", LINES="12")
        os.execv(sys.executable, [sys.executable, "-m", "edgevpr", *command])
    seen = ""

    def wait_for_words(words, times=1):
        nonlocal seen
        give_up_s = time.monotonic() + PATIENCE_S
        while seen.count(words) < times:
            assert time.monotonic() < give_up_s, seen
            if select.select([descriptor], [], [], 1.0)[0]:
                seen += os.read(descriptor, 65_536).decode()
        return seen

    try:
        yield wait_for_words
        os.write(descriptor, b"\x03")
        assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 0
    finally:
        os.close(descriptor)


def test_on_a_terminal_it_draws_over_what_it_drew_and_within_its_size(fly, tmp_path):
    with terminal("top", "--socket", str(tmp_path / "status.sock")) as wait_for_words:
        wait_for_words("no flight tells")
        run = fly()
        seen = wait_for_words("charge", times=3)
        run.terminate()
        run.communicate(timeout=PATIENCE_S)
        wait_for_words("no flight tells", times=seen.count("no flight tells") + 1)
    blocks = re.split(r"\x1b\[\d+F\x1b\[J", seen)
    assert len(blocks) > 3
    assert "\x1b" not in "".join(blocks)
    for block in blocks:
        assert len(block.splitlines()) <= 11
        assert all(len(line) < 60 for line in block.splitlines())
    assert "\x1b[11F\x1b[J" in seen
