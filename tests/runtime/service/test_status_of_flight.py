"""The status of a flight that is a process of its own."""

import re
import time

import psutil
import pytest
from flight_process import start, wait_for

from edgevpr.cli.main import main
from edgevpr.runtime.flight.status import read_status

pytestmark = [pytest.mark.process, pytest.mark.slow]

PATIENCE_S = 60.0


@pytest.fixture
def fly(recording, tmp_path):
    """Start flights with the status file that is given with them, which end with the test."""
    flights = []

    def started(file=tmp_path / "status.json", number=0, rate_hz="2", **environment):
        config, log = tmp_path / f"{number}.yaml", tmp_path / f"{number}.jsonl"
        config.write_text(f"status: {{file: {file or 'null'}}}\n")
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
    while time.monotonic() < give_up_s:
        if (found := read_status(path)) and wanted(found[0]):
            return found[0]
        time.sleep(0.05)
    raise AssertionError(f"no such status at {path}")


def test_run_writes_its_status_and_opens_no_port(fly, tmp_path, capsys):
    run, path = fly(), tmp_path / "status.json"
    status = status_of(path, lambda status: status["accepted"])
    assert status["queries"] >= status["accepted"] >= 1
    assert path.stat().st_mode & 0o777 == 0o660
    listening = [each for each in psutil.Process(run.pid).net_connections("inet") if each.status == "LISTEN"]
    assert not listening
    assert main(["top", "--file", str(path), "--once"]) == 0
    shown = dict(line.split(maxsplit=1) for line in capsys.readouterr().out.splitlines())
    for label in ("edgevpr", "frames", "rate", "queries", "CPU", "RAM", "heat", "charge", "match", "newest", "link"):
        assert shown[label]
    assert re.search(r"place \d+ \(\d\d\.png\), confidence \d", shown["match"])
    run.terminate()
    said = run.communicate(timeout=PATIENCE_S)
    assert run.returncode == 0, said
    assert not path.exists()


def test_service_flies_where_no_status_can_be_written(fly, tmp_path):
    refused = fly(file=tmp_path / "nowhere" / "s")
    said = refused.communicate(timeout=PATIENCE_S)[1]
    assert refused.returncode == 1
    assert str(tmp_path / "nowhere" / "s") in said
    service = fly(file=tmp_path / "nowhere" / "s", number=2, NOTIFY_SOCKET=str(tmp_path / "nobody"))
    wait_for("query", tmp_path / "2.jsonl", service)
    service.terminate()
    service.communicate(timeout=PATIENCE_S)
    assert service.returncode == 0
