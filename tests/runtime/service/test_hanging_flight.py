"""Flights that are processes of their own, of which a call into the camera, or the main thread, never returns: what is
said of it, that SIGTERM ends them, and what systemd's watchdog hears."""

import os
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import psutil
import pytest
from flight_process import open_notify_socket, start
from flights import select
from loopback import PATIENCE_S, wait_until

from edgevpr.runtime.flight.flightlog import read_log
from edgevpr.runtime.flight.status import read_status

pytestmark = [pytest.mark.process, pytest.mark.slow]

HANGING = Path(__file__).parents[2] / "hanging_camera.py"
END_S = 30.0  # it takes five; by far less than for ever, on a busy machine too


@pytest.fixture
def start_hanging_flight(recording, tmp_path):
    """Start a flight whose camera hangs in a step; returns it once it hangs."""
    flights = []

    def start_flight(step, **environment):
        (tmp_path / "c.yaml").write_text(f"status: {{file: {tmp_path / 'status.json'}}}\n")
        run = ["run", "--map", recording / "cohog.gpkg", "--source", "/dev/video0", "--log", tmp_path / "f.jsonl"]
        flags = ["--rate-hz", "5", "--config", tmp_path / "c.yaml"]
        command = [sys.executable, HANGING, step, tmp_path / "mark", *run, *flags]
        env = {**os.environ, **environment}
        flight = subprocess.Popen(list(map(str, command)), stderr=subprocess.PIPE, text=True, env=env)
        flights.append(flight)
        wait_until((tmp_path / "mark").exists)
        return flight

    yield start_flight
    for each in flights:
        each.kill()
        each.wait()
        each.stderr.close()


@pytest.mark.parametrize(
    ("step", "state"), [("open", "opening"), ("read", "lost"), ("pixels", "lost"), ("release", "lost")]
)
def test_run_reports_a_hanging_camera_and_ends(start_hanging_flight, step, state, tmp_path):
    flight = start_hanging_flight(step)
    status = wait_until(
        lambda: (found := read_status(tmp_path / "status.json")) and state in found[0]["source"] and found
    )
    assert state == "opening" or status[0]["health"] == "CRITICAL"
    flight.terminate()
    assert flight.wait(END_S) == 0
    lines = list(read_log(tmp_path / "f.jsonl"))
    assert lines[-1]["kind"] == "end"
    assert [line["condition"] for line in select(lines, "source")][:1] == ["LOST"] * (state == "lost")


def test_run_feeds_no_watchdog_from_a_hanging_thread_and_ends(start_hanging_flight, tmp_path):
    with open_notify_socket(tmp_path) as (listening, environment):
        flight = start_hanging_flight("main", **environment)
        listening.settimeout(2.0)
        give_up_s = time.monotonic() + PATIENCE_S
        with suppress(TimeoutError):
            while listening.recv(4096):
                assert time.monotonic() < give_up_s, "it is still fed"
    flight.terminate()
    assert flight.wait(END_S) == 1
    assert "killing" in flight.stderr.read()
    assert select(read_log(tmp_path / "f.jsonl"), "start")


@pytest.mark.network
def test_run_ends_the_program_of_a_camera(recording, tmp_path):
    """As a pipeline whose sensor hangs: the thread that waits for it is left, and it would keep the camera."""
    program = tmp_path / "gst-launch-1.0"
    program.write_text("#!/bin/sh\nexec sleep 600.25\n")
    program.chmod(0o755)
    path = f"{tmp_path}{os.pathsep}{os.environ['PATH']}"
    flight = start(recording / "cohog.gpkg", "gst: v4l2src", tmp_path / "f.jsonl", PATH=path)
    try:
        process = psutil.Process(flight.pid)
        (child,) = wait_until(lambda: [each for each in process.children() if "600.25" in each.cmdline()])
        flight.terminate()
        assert flight.wait(END_S) == 0
        wait_until(lambda: not child.is_running())
        assert list(read_log(tmp_path / "f.jsonl"))[-1]["kind"] == "end"
    finally:
        flight.kill()
        flight.wait()
        flight.stderr.close()
