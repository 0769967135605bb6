"""The flight log on real files, a full device, a file size limit and a small file system."""

import json
import logging
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from fakes import FakeClock
from full_disk import no_file_larger_than

from edgevpr.config import load_config
from edgevpr.contract import PartSpec, TechniqueSpec
from edgevpr.errors import EdgevprError
from edgevpr.helpers.appending import earlier_part
from edgevpr.runtime.flight.flightlog import FlightLog, read_log, start_fields
from edgevpr.runtime.recognise.locate import at_place
from edgevpr.runtime.recognise.recognition import Recognition
from edgevpr.types import Position, QueryCost, Steps

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
def syncs(monkeypatch) -> list[int]:
    """The calls of fdatasync, which still happen."""
    calls = []
    fdatasync = os.fdatasync
    monkeypatch.setattr(os, "fdatasync", lambda fd: (calls.append(fd), fdatasync(fd)))
    return calls


def kinds(path: Path) -> list[str]:
    """Kinds of all lines, each of which must be whole."""
    return [json.loads(line)["kind"] for line in path.read_bytes().splitlines()]


def test_every_line_can_be_read_before_the_log_is_closed(path):
    log = FlightLog(path, FakeClock())
    log.write("state", camera="lost")
    (record,) = read_log(path)
    assert record["kind"] == "state"
    assert record["camera"] == "lost"
    assert record["t_mono_s"] == 1000.0
    assert record["time"].endswith("Z")
    log.close()


def test_a_match_is_written_as_it_is_with_nan_as_null(path):
    match = Recognition(
        frame=None,
        accepted=True,
        reason="score 0.9",
        located=at_place(Position(50.12345678901, -1.5, None), 20.0),
        accuracy_m=20.0,
        steps=Steps(),
        cost=COST,
    )
    with FlightLog(path) as log:
        log.write("match", t_mono_s=12.5, event=match)
    (record,) = read_log(path)
    assert record["t_mono_s"] == 12.5
    assert record["event"]["located"]["position"] == {"lat_deg": 50.1234568, "lon_deg": -1.5, "alt_m": None}
    assert record["event"]["cost"]["used_mah"] == 1.234568e-05
    assert record["event"]["cost"]["marginal_mah"] is None


def test_numpy_paths_infinities_and_foreign_file_names_are_written(path):
    with FlightLog(path) as log:
        log.write("x", score=np.float32(0.1), n=np.int64(3), row=np.array([1.0, np.inf]), file=Path("a/b"), ok=np.True_)
        log.write("y", file="flight \udcff.mp4", place="Přeštice")
    first, second = read_log(path)
    assert (first["score"], first["n"], first["row"], first["file"], first["ok"]) == (0.1, 3, [1.0, None], "a/b", True)
    assert (second["file"], second["place"]) == ("flight \udcff.mp4", "Přeštice")
    assert "Přeštice" in path.read_text(errors="strict")


def test_the_first_line_says_who_flies_with_what(path):
    spec = TechniqueSpec(name="cohog", parameters={"image": 512}, coarse=PartSpec((4,), "<f4"))
    config = load_config(None, {"map": "valley.gpkg"})
    with FlightLog(path) as log:
        log.write("start", **start_fields(config, "rpi-zero-2w", spec))
    (record,) = read_log(path)
    assert record["technique"] == "cohog"
    assert record["parameters"] == {"image": 512}
    assert record["board"] == "rpi-zero-2w"
    assert record["map"] == "valley.gpkg"
    assert record["config"]["match"]["neighbour_m"] == 50
    assert record["version"]


def test_the_disk_is_synced_at_most_once_a_second_and_at_the_end(path, syncs):
    clock = FakeClock()
    log = FlightLog(path, clock)
    for _ in range(9):  # two seconds at four lines a second
        log.write("match")
        clock.now_s += 0.25
    assert len(syncs) == 3
    log.close()
    assert len(syncs) == 4


def test_flights_are_appended_one_after_another(path):
    for flight in ("first", "second"):
        with FlightLog(path) as log:
            log.write(flight)
    assert kinds(path) == ["first", "second"]


def test_after_a_pulled_battery_it_goes_on_on_a_new_line(path):
    path.write_bytes(b'{"kind": "match"}\n{"kind": "ma')
    with FlightLog(path) as log:
        log.write("start")
    assert [record["kind"] for record in read_log(path)] == ["match", "start"]
    assert path.read_bytes().startswith(b'{"kind": "match"}\n{"kind": "ma\n{"kind": "start"')


def test_reading_leaves_out_a_cut_last_line_and_what_is_no_record(path):
    path.write_bytes(b'{"kind": "a"}\n\n[1]\n\0\0\0\0\n\xff\xfe\n{"kind": "b"}\n{"kind": "c", "x": 1')
    assert list(read_log(path)) == [{"kind": "a"}, {"kind": "b"}]


def test_a_flight_that_was_cut_at_any_byte_is_read_up_to_its_last_whole_line(path):
    with FlightLog(path) as log:
        for n in range(3):
            log.write("query", n=n, place="Přeštice")
    whole = path.read_bytes()
    ends = [place + 1 for place, byte in enumerate(whole) if byte == ord("\n")]
    for cut in range(len(whole)):
        path.write_bytes(whole[:cut])
        kept = sum(end - 1 <= cut for end in ends)  # the last byte of a line, its end, may be missing
        assert numbers(path) == list(range(kept))
        with FlightLog(path) as log:
            log.write("start")
        assert [each["kind"] for each in read_log(path)] == ["query"] * kept + ["start"]


def test_a_full_device_is_said_once_counted_and_never_raised(caplog):
    with FlightLog("/dev/full") as log:
        for _ in range(5):
            log.write("match")
        assert log.lost_lines == 5
        assert log.state.startswith("The flight log /dev/full cannot be written (No space left on device): make room")
    assert [record.getMessage() for record in caplog.records] == [log.state]


def test_a_disk_that_has_room_again_is_written_again_without_half_a_line(path, caplog):
    caplog.set_level(logging.INFO)
    log = FlightLog(path)
    log.write("before")
    whole = path.read_bytes()
    with no_file_larger_than(len(whole) + 10):
        log.write("lost")
        log.write("lost")
        assert path.read_bytes() == whole
        assert log.state
    log.write("after")
    log.close()
    assert kinds(path) == ["before", "gap", "after"]
    assert next(r for r in read_log(path) if r["kind"] == "gap")["lost_lines"] == 2
    assert (log.state, log.lost_lines) == (None, 2)
    said = [record.getMessage() for record in caplog.records]
    assert len(said) == 2
    assert said[1] == f"The flight log {path} is written again; 2 lines are missing."


def test_a_second_failure_is_said_again(path, caplog):
    with FlightLog(path) as log:
        for _ in range(2):
            with no_file_larger_than(0):
                log.write("lost")
            log.write("kept")
    assert kinds(path) == ["gap", "kept", "gap", "kept"]
    assert [record["lost_lines"] for record in read_log(path) if record["kind"] == "gap"] == [1, 2]
    assert len(caplog.records) == 4


def test_a_medium_that_was_put_back_is_opened_anew(tmp_path):
    medium, log_path = tmp_path / "medium", tmp_path / "flight.jsonl"
    log_path.symlink_to("/dev/full")  # the medium fails ...
    log = FlightLog(log_path)
    log.write("lost")
    log_path.unlink()
    log_path.symlink_to(medium / "flight.jsonl")  # ... is gone ...
    log.write("lost")
    assert log.state
    medium.mkdir()  # ... and is back
    log.write("after")
    log.close()
    assert kinds(log_path) == ["gap", "after"]
    assert log.lost_lines == 2


def test_a_sync_that_fails_is_a_failure_too(path, monkeypatch):
    def failing(fd: int) -> None:
        raise OSError(5, "Input/output error")

    with FlightLog(path) as log:
        with monkeypatch.context() as patch:
            patch.setattr(os, "fdatasync", failing)
            log.write("match")
        assert "Input/output error" in log.state
        log.write("match")
        assert log.state is None


@pytest.mark.parametrize("umask", [0, 0o022, 0o077])
def test_a_log_is_for_its_owner_and_group_whatever_the_umask(umask, path):
    before = os.umask(umask)
    try:
        FlightLog(path).close()
    finally:
        os.umask(before)
    assert path.stat().st_mode & 0o777 == 0o640
    path.chmod(0o600)  # by somebody who had a reason
    FlightLog(path).close()
    assert path.stat().st_mode & 0o777 == 0o600


def flown(log, clock, *names):
    for name in names:
        log.write(name)
        clock.now_s += 0.5


def test_a_log_that_is_deleted_in_flight_goes_on_and_says_how_much_is_lost(path, caplog):
    clock = FakeClock()
    with FlightLog(path, clock) as log:
        flown(log, clock, "start", "a", "b")
        path.unlink()
        flown(log, clock, "c", "d", "e")
    assert kinds(path) == ["start", "gap", "c", "d", "e"]
    (gap,) = [record for record in read_log(path) if record["kind"] == "gap"]
    assert gap["lost_lines"] == log.lost_lines == 3
    said = [record.getMessage() for record in caplog.records]
    assert re.match(rf"The flight log {path} was deleted in flight, and {log.lost_lines} lines of it are lost", said[0])
    assert said[1] == f"The flight log {path} is written again; {log.lost_lines} lines are missing."
    assert len(said) == 2
    assert log.state is None


def test_a_log_that_is_moved_in_flight_loses_nothing(path, caplog):
    clock = FakeClock()
    with FlightLog(path, clock) as log:
        flown(log, clock, "start", "a", "b")
        path.rename(path.with_suffix(".1"))
        flown(log, clock, "c", "d", "e")
    assert kinds(path.with_suffix(".1")) == ["start", "a", "b"]
    assert kinds(path) == ["start", "gap", "c", "d", "e"]
    assert log.lost_lines == 0
    assert "was moved or replaced in flight, and 0 lines" in caplog.text


def test_a_log_in_whose_place_another_one_was_put_has_its_start_there_too(path):
    with FlightLog(path) as log:
        log.write("start")
        path.rename(path.with_suffix(".mine"))
        path.write_bytes(b'{"kind": "end"}\n')
        log.write("a")
    assert kinds(path) == ["end", "start", "gap", "a"]


def test_a_log_whose_folder_is_deleted_is_tried_again(path, caplog):
    path = path.parent / "logs" / "flight.jsonl"
    path.parent.mkdir()
    clock = FakeClock()
    with FlightLog(path, clock) as log:
        flown(log, clock, "start", "a", "b")
        shutil.rmtree(path.parent)
        flown(log, clock, "c", "d", "e")
        assert log.state
        path.parent.mkdir()
        flown(log, clock, "f")
    assert kinds(path) == ["start", "gap", "f"]
    assert log.lost_lines == 6


def test_the_password_of_a_camera_stands_in_no_line(path):
    config = load_config(None, {"source.uri": "rtsp://pilot:secret@10.0.0.2/cam", "log.path": str(path)})
    spec = TechniqueSpec(name="cohog", parameters={}, coarse=PartSpec((4,), "<f4"))
    with FlightLog(path) as log:
        log.write("start", **start_fields(config, "rpi-5", spec), source=Path("rtsp://pilot:secret@10.0.0.2"))
        log.write("source", state="rtsp://pilot:secret@10.0.0.2/cam lost")
    assert "secret" not in path.read_text()
    assert next(read_log(path))["config"]["source"]["uri"] == "rtsp://pilot:***@10.0.0.2/cam"


def test_a_pipe_is_no_log_and_is_not_waited_for(path):
    os.mkfifo(path)
    with pytest.raises(EdgevprError, match=r"cannot be opened \(it is a pipe or a disk and not a file\)"):
        FlightLog(path)


_ON_A_SMALL_FILE_SYSTEM = """
import sys
from pathlib import Path
from edgevpr.runtime.flight.flightlog import FlightLog
folder = Path(sys.argv[1])
log = FlightLog(folder / "flight.jsonl")
ballast = folder / "ballast"
ballast.write_bytes(bytes(16 * 4096))
while log.state is None:
    log.write("match", fill="x" * 3000)
lost_while_full = log.lost_lines
log.write("match", fill="x" * 3000)
assert log.lost_lines == lost_while_full + 1
ballast.unlink()
log.write("after")
log.close()
assert log.state is None
sys.stdout.write(log.path.read_text())
"""


def test_a_file_system_that_fills_up_and_is_cleared_holds_only_whole_lines(tmp_path):
    enter = ["unshare", "--user", "--map-root-user", "--mount", "sh", "-c"]
    mount = f"mount -t tmpfs -o size=256k tmpfs {tmp_path}"
    if not shutil.which("unshare") or subprocess.run([*enter, mount], capture_output=True).returncode:
        pytest.skip("this machine does not let a test mount a small file system of its own (unshare)")
    run = f"{mount} && exec {sys.executable} -c '{_ON_A_SMALL_FILE_SYSTEM}' {tmp_path}"
    written = subprocess.run([*enter, run], capture_output=True, text=True, check=True).stdout
    lines = [json.loads(line)["kind"] for line in written.splitlines()]
    assert lines[-2:] == ["gap", "after"]
    assert set(lines[:-2]) == {"match"}


def test_without_a_path_nothing_is_written(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with FlightLog(None) as log:
        log.write("match")
    assert log.state is None
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["", "absent/flight.jsonl", "file/flight.jsonl"])
def test_a_path_that_cannot_be_opened_is_one_sentence(tmp_path, name):
    (tmp_path / "file").touch()
    with pytest.raises(EdgevprError, match=r"^The flight log .* cannot be opened \(.*\): give a file in a folder"):
        FlightLog(tmp_path / name)


def test_a_log_that_was_killed_loses_nothing_that_was_written(path):
    script = "import os, sys; from edgevpr.runtime.flight.flightlog import FlightLog\n"
    script += "log = FlightLog(sys.argv[1])\nfor i in range(50): log.write('match', i=i)\nos.kill(os.getpid(), 9)"
    assert subprocess.run([sys.executable, "-c", script, str(path)]).returncode == -9
    assert [record["i"] for record in read_log(path)] == list(range(50))


PART_MB = 0.004  # two of them are the limit of the tests below


def numbers(path: Path) -> list[int]:
    return [record["n"] for record in read_log(path) if record["kind"] == "query"]


def written(path: Path, count: int, **settings) -> FlightLog:
    with FlightLog(path, max_mb=2 * PART_MB, **settings) as log:
        log.write("start", version="1")
        for n in range(count):
            log.write("query", n=n)
    return log


def test_a_log_that_is_full_goes_on_in_a_new_part_and_both_can_be_read_alone(path, caplog):
    written(path, 80)
    first, second = numbers(earlier_part(path)), numbers(path)
    assert earlier_part(path).name == "flight.1.jsonl"
    assert first + second == list(range(80))
    (start,), (again,) = ([each for each in read_log(part) if each["kind"] == "start"] for part in parts(path))
    assert again == {**start, "repeated": True}
    assert kinds(path)[0] == "start"
    assert not caplog.records


def parts(path: Path) -> tuple[Path, Path]:
    return earlier_part(path), path


def test_the_newest_lines_are_kept_and_the_disk_use_is_bounded(path):
    written(path, 1000)
    assert all(part.stat().st_size <= 1e6 * PART_MB for part in parts(path))
    kept = numbers(earlier_part(path)) + numbers(path)
    assert kept == list(range(kept[0], 1000))
    assert kept[0] > 900
    assert {kinds(part)[0] for part in parts(path)} == {"start"}
    assert len(list(path.parent.iterdir())) == 2
    assert earlier_part(path).stat().st_mode & 0o777 == path.stat().st_mode & 0o777 == 0o640


def test_without_a_limit_there_is_one_file(path):
    with FlightLog(path) as log:
        for n in range(1000):
            log.write("query", n=n)
    assert numbers(path) == list(range(1000))
    assert not earlier_part(path).exists()


def test_a_flight_that_follows_a_long_one_begins_a_part_with_its_own_start(path):
    path.write_bytes(b'{"kind": "query", "n": 7}\n' * 150 + b'{"kind": "qu')
    written(path, 1)
    assert kinds(path) == ["start", "query"]
    assert "repeated" not in next(read_log(path))
    assert numbers(earlier_part(path)) == [7] * 150


def test_a_part_is_kept_beside_the_file_that_a_link_leads_to(tmp_path):
    (tmp_path / "card").mkdir()
    link = tmp_path / "flight.jsonl"
    link.symlink_to(tmp_path / "card" / "flight.jsonl")
    written(link, 80)
    assert link.is_symlink()
    assert numbers(tmp_path / "card" / "flight.1.jsonl") + numbers(link) == list(range(80))


def test_a_log_that_cannot_be_renamed_is_written_on_and_said_once(path, caplog):
    earlier_part(path).mkdir()
    log = written(path, 200)
    assert numbers(path) == list(range(200))
    assert (log.state, log.lost_lines) == (None, 0)
    assert [record.getMessage() for record in caplog.records] == [
        f"The flight log {path} grows past log.max_mb, since it cannot be renamed (Is a directory): let the flight "
        "write to its folder."
    ]


def test_a_start_that_was_lost_is_made_up_for(path):
    path.write_bytes(b'{"kind": "end"}\n')  # of the flight before
    with FlightLog(path) as log:
        with no_file_larger_than(path.stat().st_size):
            log.write("start", version="1")
        log.write("query", n=1)
        log.write("query", n=2)
    assert kinds(path) == ["end", "start", "gap", "query", "query"]


def test_a_disk_that_is_full_when_a_part_begins_loses_lines_and_no_part(path):
    log = FlightLog(path, max_mb=2 * PART_MB)
    log.write("start")
    log.write("query", n=1)
    before = path.read_bytes()
    with no_file_larger_than(10):
        log.write("query", n=2, fill="x" * int(1e6 * PART_MB))
    assert log.state
    assert earlier_part(path).read_bytes() == before
    assert path.read_bytes() == b""
    log.write("query", n=3)
    log.close()
    assert kinds(path) == ["start", "gap", "query"]
    assert log.lost_lines == 1


def test_kill_9_at_any_time_loses_no_line_of_the_parts(path):
    script = "import sys; from itertools import count; from edgevpr.runtime.flight.flightlog import FlightLog\n"
    script += f"log = FlightLog(sys.argv[1], max_mb={2 * PART_MB})\nlog.write('start')\n"
    script += "for n in count(int(sys.argv[2])):\n    log.write('query', n=n); print(n, flush=True)"
    begin = 0
    for _ in range(5):
        writing = subprocess.Popen([sys.executable, "-c", script, path, str(begin)], stdout=subprocess.PIPE, text=True)
        said = [-1]
        while int(said[-1]) < begin + 300:  # a dozen parts on
            said.append(writing.stdout.readline())
        writing.kill()
        said += writing.communicate()[0].split()
        kept = [n for part in parts(path) if part.exists() for n in numbers(part)]
        assert kept == list(range(kept[0], kept[-1] + 1))
        assert kept[-1] >= int(said[-1]), "what was written is there"
        assert kept[-1] - kept[0] > 20
        begin = kept[-1] + 1


def test_a_service_waits_for_the_medium_of_its_log(tmp_path, caplog):
    path = tmp_path / "card" / "flight.jsonl"
    log = FlightLog(path, wait=True)
    assert "the flight goes on without it" in log.state
    log.write("query", n=1)
    path.parent.mkdir()  # the card is put back
    log.write("query", n=2)
    log.close()
    assert [(line["kind"], line.get("n")) for line in read_log(path)] == [("gap", None), ("query", 2)]
    assert log.state is None
