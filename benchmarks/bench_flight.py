"""What `edgevpr run` takes with a large map: peak memory, start to the first match, CPU while there is nothing to see.

A process of its own, as on the aircraft: a generated map of `cohog`, pictures from a folder, a link. What another
process does is read in /proc. RSS counts pages of libraries as they lie in the system's cache: right after libraries
were installed the same flight has 137 MB, and 96 once the cache was dropped, as by a restart.
"""

import os
import statistics
import subprocess
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory

import base  # noqa: F401
from base import Row
from big_map import make_big_map
from flight_process import read_cpu_s, start, wait_for, watch_memory, write_frames

from edgevpr.techniques import create

PLACES = 10_000
FRAMES = 60
STARTS = 5
IDLE_DURATION_S = 10.0
SETTLE_DURATION_S = 2.0
DEAD_STREAM_URI = "rtsp://127.0.0.1:9/nobody"
LINK_FLAGS = ["--link", "udpout:127.0.0.1:9"]
MATCH_SCRIPT = "import cv2, edgevpr, pathlib, sys; opened = edgevpr.Map(sys.argv[1])"
MATCH_SCRIPT += "; [opened.match(cv2.imread(str(each))) for each in pathlib.Path(sys.argv[2]).iterdir()]"
FORBIDDEN_LIBRARIES = ["onnxruntime", "matplotlib"]


def make_row(what: str, value: float, unit: str, target: float | None) -> Row:
    """Return one line of the table; `target` is the most that `value` may be, None where none was set."""
    return {"what": what, "value": value, "unit": unit, "target": target}


def measure_flight() -> list[Row]:
    """Make the map in a temporary folder, fly, look."""
    with TemporaryDirectory() as name:
        folder = Path(name)
        place_map, frames = folder / "big.gpkg", folder / "frames"
        make_big_map(place_map, create("cohog").spec, PLACES)
        write_frames(frames, FRAMES)
        measure_start_s(place_map, frames, folder)  # compiles the bytecode, and fills the page cache
        return [
            *measure_memory(place_map, frames, folder),
            *measure_starts(place_map, frames, folder),
            *measure_idle_cpu(place_map, frames, folder),
            measure_library_cpu(place_map, frames),
        ]


def measure_memory(place_map: Path, frames: Path, folder: Path) -> list[Row]:
    """The most that a flight of `FRAMES` queries takes."""
    flight = start(place_map, frames, folder / "memory.jsonl", *LINK_FLAGS, "--rate-hz", "10")
    largest, mapped = watch_memory(flight)
    assert wait_for_exit(flight) == 0
    for name in FORBIDDEN_LIBRARIES:
        assert name not in mapped, f"{name} was imported"
    return [
        make_row("peak RSS (VmHWM)", largest["VmHWM"], "MB", 130.0),
        make_row("... without libraries (RssAnon)", largest["RssAnon"], "MB", None),
    ]


def measure_starts(place_map: Path, frames: Path, folder: Path) -> list[Row]:
    """From the start of the process to the first answer in its log, median of `STARTS`."""
    warm_s = [measure_start_s(place_map, frames, folder) for _ in range(STARTS)]
    cold_s = []
    for _ in range(STARTS):
        drop_cached_pages(place_map)
        cold_s.append(measure_start_s(place_map, frames, folder))
    return [
        make_row("start to first match", statistics.median(warm_s), "s", 2.0),
        make_row("... with the map not in the page cache", statistics.median(cold_s), "s", 2.0),
    ]


def measure_idle_cpu(place_map: Path, frames: Path, folder: Path) -> list[Row]:
    """CPU-seconds a second without frames, in percent of one core."""
    absent = measure_idle_share(place_map, DEAD_STREAM_URI, folder / "absent.jsonl", until="start")
    waiting = measure_idle_share(place_map, frames, folder / "waiting.jsonl", "--rate-hz", "0.01", until="query")
    return [
        make_row("idle CPU, stream not there", 100 * absent, "% of a core", 2.0),
        make_row("idle CPU, between two frames", 100 * waiting, "% of a core", 2.0),
    ]


def measure_library_cpu(place_map: Path, frames: Path) -> Row:
    """Processor time of the Python interface over that with one thread of NumPy's library, as the command line has."""
    free = {key: value for key, value in os.environ.items() if not key.endswith("_NUM_THREADS")}
    used_s = []
    for environment in (free, free | {"OPENBLAS_NUM_THREADS": "1"}):
        before_s = sum(os.times()[2:4])  # user and system time of child processes
        subprocess.run([sys.executable, "-c", MATCH_SCRIPT, place_map, frames], check=True, env=environment)
        used_s.append(sum(os.times()[2:4]) - before_s)
    return make_row("processor time of edgevpr.Map, beside one thread", used_s[0] / used_s[1], "times", 1.2)


def measure_start_s(place_map: Path, frames: Path, folder: Path) -> float:
    log = folder / "start.jsonl"
    log.unlink(missing_ok=True)
    begin_s = time.monotonic()
    flight = start(place_map, frames, log, *LINK_FLAGS)
    answer = wait_for("query", log, flight)
    flight.terminate()
    assert wait_for_exit(flight) == 0
    return answer["t_mono_s"] - begin_s  # one clock for all processes


def measure_idle_share(place_map: Path, source: Path | str, log: Path, *flags: str, until: str) -> float:
    flight = start(place_map, source, log, *LINK_FLAGS, *flags)
    wait_for(until, log, flight)
    time.sleep(SETTLE_DURATION_S)
    before_s, begin_s = read_cpu_s(flight.pid), time.monotonic()
    time.sleep(IDLE_DURATION_S)
    share = (read_cpu_s(flight.pid) - before_s) / (time.monotonic() - begin_s)
    flight.terminate()
    assert wait_for_exit(flight) == 0
    return share


def drop_cached_pages(path: Path) -> None:
    """Let the kernel drop what it holds of a file."""
    with open(path, "rb") as file:
        os.fsync(file.fileno())
        os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)


def wait_for_exit(flight: subprocess.Popen) -> int:
    """Return the exit code; what a flight that failed has said goes to standard error."""
    errors = flight.communicate(timeout=60)[1]
    if flight.returncode:
        print(errors, file=sys.stderr)
    return flight.returncode
