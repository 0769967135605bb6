"""A flight read from the files that its log has become."""

import json
import os
import re
from pathlib import Path

import pytest

from edgevpr.core.appending import list_numbered
from edgevpr.core.errors import EdgevprError, UsageError
from edgevpr.runtime.flight.flightlog import FlightLog, select_last_flight

PART_MB = 0.01


@pytest.fixture
def path(tmp_path) -> Path:
    return tmp_path / "flight.jsonl"


def fly(path: Path, numbers: range, **start) -> None:
    with FlightLog(path, max_mb=4 * PART_MB) as log:
        log.write("start", **start)
        for n in numbers:
            log.write("query", n=n, fill="x" * int(0.51e6 * PART_MB))
        log.write("end")


def list_numbers(lines) -> list[int]:
    return [line["n"] for line in lines if line["kind"] == "query"]


@pytest.fixture
def log_files(path) -> list[Path]:
    """The files of two flights, of two and of four files with a query each."""
    fly(path, range(2), version="1")
    fly(path, range(100, 104), version="2")
    files = [*list_numbered(path), path]
    assert [each.name for each in files] == [*(f"flight-{n:04d}.jsonl" for n in range(1, 6)), "flight.jsonl"]
    return files


def test_select_last_flight_reads_the_whole_flight_with_one_start_line(path, log_files):
    whole = select_last_flight(path)
    lines = list(whole)
    assert [line["kind"] for line in lines] == ["start", *["query"] * 4, "end"]
    assert (lines[0]["version"], "repeated" in lines[0]) == ("2", False)
    assert list_numbers(lines) == [100, 101, 102, 103]
    assert list(whole.files) == log_files[2:]
    assert whole.missing is None
    assert list(whole) == lines, "it can be read twice"


def test_select_last_flight_reads_up_to_the_end_of_a_numbered_file(log_files):
    assert list_numbers(select_last_flight(log_files[0])) == [0]
    assert list_numbers(select_last_flight(log_files[1])) == [0, 1]
    assert list_numbers(select_last_flight(log_files[4])) == [100, 101, 102]


def test_select_last_flight_reports_a_missing_file_and_reads_the_rest(path, log_files):
    log_files[3].unlink()
    whole = select_last_flight(path)
    assert list_numbers(whole) == [100, 102, 103]
    assert (str(path) in whole.missing, "(1)" in whole.missing) == (True, True)


def test_select_last_flight_skips_truncated_lines_of_each_file(path, log_files):
    for each in log_files[2:5]:
        os.truncate(each, each.stat().st_size - 10)
    with open(path, "ab") as newest:
        newest.write(b'{"kind": "query", "n": 10')
    assert list_numbers(select_last_flight(path)) == [103]
    assert select_last_flight(path).missing is None


def test_select_last_flight_accepts_a_repeated_start_line_after_a_storage_change(path):
    start = {"kind": "start", "time": "t", "t_mono_s": 1.0}
    again = {**start, "repeated": True, "part": 2}
    lines = [start, {"kind": "query", "n": 1}, again, {"kind": "query", "n": 2}]
    path.write_text("".join(json.dumps(line) + "\n" for line in lines))
    whole = select_last_flight(path)
    assert [line["kind"] for line in whole] == ["start", "query", "query"]
    assert whole.missing is None
    path.rename(path.with_name("flight-0001.jsonl"))
    path.write_text(json.dumps({**again, "part": 3}) + '\n{"kind": "query", "n": 3}\n')
    assert list_numbers(select_last_flight(path)) == [1, 2, 3]
    assert select_last_flight(path).missing is None


def test_select_last_flight_refuses_other_files_in_one_sentence(tmp_path):
    (tmp_path / "empty").touch()
    with pytest.raises(EdgevprError, match="no flight-log lines"):
        select_last_flight(tmp_path / "empty")
    for missing in (tmp_path, tmp_path / "nothing", "/dev/zero"):
        with pytest.raises(UsageError, match=re.escape(str(missing))):
            select_last_flight(missing)
