"""The flight log on real files, a full device, a file size limit and a small file system."""

import json
import logging
import os
import platform
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from fakes import FakeClock
from full_disk import limit_file_size

from edgevpr.core.appending import list_numbered
from edgevpr.core.config import load_config
from edgevpr.core.contract import PartSpec, TechniqueSpec
from edgevpr.core.errors import EdgevprError
from edgevpr.core.reasons import Reason, ReasonCode
from edgevpr.core.types import Position, QueryCost, StepCosts
from edgevpr.places.mapfile import PlaceMap
from edgevpr.runtime.flight.flightlog import FlightLog, read_log, select_last_flight
from edgevpr.runtime.flight.startup import start_fields
from edgevpr.runtime.recognise.locate import locate_at_place
from edgevpr.runtime.recognise.recognition import Recognition

COST = QueryCost(
    t_encode_s=0.01,
    t_match_s=0.02,
    u_encode=0.25,
    u_match=0.25,
    cpu_s=0.03,
    rss_mb=61.5,
    used_mah=1.23456789e-05,
    marginal_mah=float("nan"),
)


@pytest.fixture
def path(tmp_path) -> Path:
    return tmp_path / "flight.jsonl"


@pytest.fixture
def sync_calls(monkeypatch) -> list[int]:
    """The calls of fdatasync, which still happen."""
    calls = []
    fdatasync = os.fdatasync
    monkeypatch.setattr(os, "fdatasync", lambda fd: (calls.append(fd), fdatasync(fd)))
    return calls


def read_kinds(path: Path) -> list[str]:
    """Kinds of all lines, each of which must be whole."""
    return [json.loads(line)["kind"] for line in path.read_bytes().splitlines()]


def test_write_logs_a_match_with_nan_as_null(path):
    match = Recognition(
        frame=None,
        accepted=True,
        reason=Reason(ReasonCode.ACCEPTED_WITHOUT_RIVAL, {"score": 0.9}),
        located=locate_at_place(Position(50.12345678901, -1.5, None), 20.0),
        accuracy_m=20.0,
        steps=StepCosts(),
        cost=COST,
    )
    with FlightLog(path) as log:
        log.write("match", t_mono_s=12.5, event=match)
        (record,) = read_log(path)  # before the log is closed
    assert record["time"].endswith("Z")
    assert record["t_mono_s"] == 12.5
    assert record["event"]["located"]["position"] == {"lat_deg": 50.1234568, "lon_deg": -1.5, "alt_m": None}
    assert record["event"]["cost"]["used_mah"] == 1.234568e-05
    assert record["event"]["cost"]["marginal_mah"] is None


def test_create_logs_program_configuration_and_map_in_the_first_line(path):
    spec = TechniqueSpec(name="cohog", parameters={"image": 512}, coarse=PartSpec((4,), "<f4"), model_sha256="ab")
    config = load_config(None, {"map": "valley.gpkg"})
    with FlightLog(path) as log, PlaceMap.create(path.with_name("valley.gpkg"), spec) as place_map:
        log.write("start", **start_fields(config, "rpi-zero-2w", spec, place_map))
    (record,) = read_log(path)
    assert record["map_identity"]["places"] == 0
    assert record["model_sha256"] == "ab"
    assert record["libraries"]["numpy"] == np.__version__
    assert "scipy" not in record["libraries"], "not loaded by a flight"
    assert record["python"] == platform.python_version()
    assert record["machine"] == platform.machine()
    assert record["technique"] == "cohog"
    assert record["parameters"] == {"image": 512}
    assert record["board"] == "rpi-zero-2w"
    assert record["map"] == "valley.gpkg"
    assert record["config"]["match"]["neighbour_m"] == 50
    assert record["version"]


def test_flight_log_syncs_at_most_once_a_second_and_at_the_end(path, sync_calls):
    clock = FakeClock()
    log = FlightLog(path, clock)
    for _ in range(9):  # two seconds at four lines a second
        log.write("match")
        clock.now_s += 0.25
    assert len(sync_calls) == 3
    log.write("match")
    for waited_s, count in ((0.0, 3), (1.0, 4), (1.0, 4)):  # a line that no other follows, then none
        clock.now_s += waited_s
        log.sync_if_due(clock())
        assert len(sync_calls) == count
    log.close()
    assert len(sync_calls) == 5


def test_sync_if_due_records_an_error_between_lines_without_raising(path, monkeypatch, caplog):
    clock = FakeClock()
    with FlightLog(path, clock) as log:
        log.write("first")
        log.write("second")
        clock.now_s += 1.0
        with monkeypatch.context() as patch:
            patch.setattr(os, "fdatasync", lambda fd: os.write(os.open("/dev/full", os.O_WRONLY), b"x"))
            log.sync_if_due(clock())
        assert "No space" in log.fault
        log.write("third")
    assert read_kinds(path) == ["first", "second", "gap", "third"]


def test_read_log_skips_a_truncated_last_line_and_invalid_records(path):
    whole, last = b'{"kind": "a"}\n\n[1]\n\0\0\0\0\n\xff\xfe\n{"kind": "b"}\n', b'{"kind": "c", "x": 1}'
    for cut in range(len(last)):
        path.write_bytes(whole + last[:cut])
        assert list(read_log(path)) == [{"kind": "a"}, {"kind": "b"}]


def test_write_resumes_without_a_partial_line_once_the_disk_has_space(path, caplog):
    caplog.set_level(logging.INFO)
    log = FlightLog(path)
    log.write("before")
    whole = path.read_bytes()
    with limit_file_size(len(whole) + 10):
        log.write("lost")
        log.write("lost")
        assert path.read_bytes() == whole
        assert log.fault
    log.write("after")
    log.close()
    assert read_kinds(path) == ["before", "gap", "after"]
    assert next(r for r in read_log(path) if r["kind"] == "gap")["lost_lines"] == 2
    assert (log.fault, log.lost_lines) == (None, 2)
    said = [record.getMessage() for record in caplog.records]
    assert len(said) == 2
    assert "2 lines" in said[1]


@pytest.mark.parametrize("umask", [0, 0o022, 0o077])
def test_flight_log_is_readable_by_owner_and_group_under_any_umask(umask, path):
    before = os.umask(umask)
    try:
        FlightLog(path).close()
    finally:
        os.umask(before)
    assert path.stat().st_mode & 0o777 == 0o640
    path.chmod(0o600)  # by somebody who had a reason
    FlightLog(path).close()
    assert path.stat().st_mode & 0o777 == 0o600


def write_names(log, clock, *names):
    for name in names:
        log.write(name)
        clock.now_s += 0.5


@pytest.mark.parametrize("taken_away", [Path.unlink, lambda path: path.rename(path.with_suffix(".1"))])
def test_flight_log_continues_in_a_new_file_if_deleted_or_moved(path, caplog, taken_away):
    clock = FakeClock()
    with FlightLog(path, clock) as log:
        write_names(log, clock, "start", "a", "b")
        taken_away(path)
        write_names(log, clock, "c", "d", "e")
    assert read_kinds(path) == ["start", "c", "d", "e"]
    assert len(caplog.records) == 1
    assert select_last_flight(path).missing


def test_write_hides_the_password_of_the_camera(path):
    config = load_config(None, {"source.uri": "rtsp://pilot:secret@10.0.0.2/cam", "log.path": str(path)})
    spec = TechniqueSpec(name="cohog", parameters={}, coarse=PartSpec((4,), "<f4"))
    with FlightLog(path) as log, PlaceMap.create(path.with_name("m.gpkg"), spec) as place_map:
        source = Path("rtsp://pilot:secret@10.0.0.2")
        log.write("start", **start_fields(config, "rpi-5", spec, place_map), source=source)
        log.write("source", state="rtsp://pilot:secret@10.0.0.2/cam lost")
    assert "secret" not in path.read_text()
    assert next(read_log(path))["config"]["source"]["uri"].startswith("rtsp://pilot:***@")


@pytest.mark.parametrize(
    ("name", "said"), [("", "cannot"), ("absent/flight.jsonl", "cannot"), ("file/x.jsonl", "cannot"), ("pipe", "pipe")]
)
def test_flight_log_refuses_a_path_that_is_not_a_log_at_once(tmp_path, name, said):
    (tmp_path / "file").touch()
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(EdgevprError, match=said) as refused:
        FlightLog(tmp_path / name)
    assert "\n" not in str(refused.value)


PART_MB = 0.004  # four of them are the limit of the tests below


def read_numbers(path: Path) -> list[int]:
    return [record["n"] for record in read_log(path) if record["kind"] == "query"]


def write(path: Path, count: int, begin: int = 0, **settings) -> FlightLog:
    with FlightLog(path, max_mb=4 * PART_MB, **settings) as log:
        log.write("start", version="1")
        for n in range(begin, begin + count):
            log.write("query", n=n)
    return log


def list_parts(path: Path) -> list[Path]:
    return [*list_numbered(path), path]


def test_flight_log_continues_in_a_new_readable_file_when_full(path, caplog):
    write(path, 120)
    assert [each.name for each in list_parts(path)] == ["flight-0001.jsonl", "flight-0002.jsonl", "flight.jsonl"]
    assert [n for part in list_parts(path) for n in read_numbers(part)] == list(range(120))
    (start,), *again = ([each for each in read_log(part) if each["kind"] == "start"] for part in list_parts(path))
    assert again == [[{**start, "repeated": True, "part": part}] for part in (2, 3)]
    assert {read_kinds(part)[0] for part in list_parts(path)} == {"start"}
    assert not caplog.records


def test_flight_log_deletes_the_oldest_files_beyond_the_limit(path):
    for flight in range(10):
        write(path, 100, 100 * flight)
        assert sum(part.stat().st_size for part in list_numbered(path)) <= 3e6 * PART_MB, "the newest may grow"
    assert all(part.stat().st_size <= 1e6 * PART_MB for part in list_parts(path))
    kept = [n for part in list_parts(path) for n in read_numbers(part)]
    assert kept == list(range(kept[0], 1000))
    assert kept[0] < 900, "the flight before is there still, in part"
    assert {read_kinds(part)[0] for part in list_parts(path)} == {"start"}
    assert {part.stat().st_mode & 0o777 for part in list_parts(path)} == {0o640}


def refuse(*_: object, **more: object) -> None:
    raise OSError(30, "Read-only file system")


def test_flight_log_continues_in_a_file_that_cannot_be_renamed_and_reports_it_once(path, caplog, monkeypatch):
    monkeypatch.setattr(os, "replace", refuse)
    write(path, 100)
    log = write(path, 100, 100)
    assert read_numbers(path) == list(range(200))
    assert not list_numbered(path), "no number is left without a file"
    assert (log.fault, log.lost_lines) == (None, 0)
    said = (
        f"The flight log {path} cannot be rotated (Read-only file system), so it grows and may "
        "exceed log.max_mb: make its folder writable for the flight."
    )
    assert caplog.messages == [said, said], "once a flight"
    assert [line["n"] for line in select_last_flight(path) if line["kind"] == "query"] == list(range(100, 200))


def test_flight_log_refuses_a_log_in_use_and_a_service_waits_for_it(path):
    with FlightLog(path) as first:
        first.write("start", name="a")
        with pytest.raises(EdgevprError, match="another edgevpr"):
            FlightLog(path)
        second = FlightLog(path, retries=True)
        second.write("query", n=1)
        assert "another edgevpr" in second.fault
        first.write("query", n=0)
    second.write("query", n=2)
    second.close()
    assert [read_kinds(part) for part in list_parts(path)] == [["start", "query"], ["gap", "query"]]


def test_flight_log_repeats_a_lost_start_line(path):
    with FlightLog(path) as log:
        with limit_file_size(10):
            log.write("start", version="1")
        log.write("query", n=1)
        log.write("query", n=2)
    assert read_kinds(path) == ["start", "gap", "query", "query"]
    assert select_last_flight(path).missing is None


@pytest.mark.slow
def test_flight_log_loses_no_line_and_no_file_at_kill_9(path):
    script = "import sys; from itertools import count; from edgevpr.runtime.flight.flightlog import FlightLog\n"
    script += f"log = FlightLog(sys.argv[1], max_mb={4 * PART_MB})\nlog.write('start')\n"
    script += "for n in count(int(sys.argv[2])):\n    log.write('query', n=n); print(n, flush=True)"
    begin = 0
    for _ in range(5):
        writing = subprocess.Popen([sys.executable, "-c", script, path, str(begin)], stdout=subprocess.PIPE, text=True)
        said = [-1]
        while int(said[-1]) < begin + 300:  # half a dozen files on
            said.append(writing.stdout.readline())
        writing.kill()
        said += writing.communicate()[0].split()
        kept = [n for part in list_parts(path) if part.exists() for n in read_numbers(part)]
        assert kept == list(range(kept[0], kept[-1] + 1))
        assert kept[-1] >= int(said[-1]), "what was written is there"
        assert kept[-1] - kept[0] > 20
        begin = kept[-1] + 1


def test_flight_log_of_a_service_waits_for_its_storage(tmp_path, caplog):
    path = tmp_path / "card" / "flight.jsonl"
    log = FlightLog(path, retries=True)
    assert str(path) in log.fault
    log.write("query", n=1)
    path.parent.mkdir()  # the card is put back
    log.write("query", n=2)
    log.close()
    assert [(line["kind"], line.get("n")) for line in read_log(path)] == [("gap", None), ("query", 2)]
    assert log.fault is None
