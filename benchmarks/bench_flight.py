"""Measure `edgevpr run` with a large map: peak memory, time to the first match, CPU load without frames.

The flight is a process of its own, as on the aircraft, with a generated `cohog` map, pictures from a folder and a link.
Its memory and CPU time are read from /proc. RSS includes library pages in the system's page cache: the same flight has
137 MB right after the libraries were installed, and 96 MB once the cache was dropped, as by a restart.
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
from flight_process import finish_flight, read_cpu_s, start, wait_for, watch_memory, write_frames

from edgevpr.techniques import create

PLACES = 10_000
FRAMES = 60
STARTS = 5
IDLE_DURATION_S = 10.0
SETTLE_DURATION_S = 2.0
DEAD_STREAM_URI = "rtsp://127.0.0.1:9/nobody"
LINK_FLAGS = ["--link", "udpout:127.0.0.1:9"]
MATCH_SCRIPT = "import cv2, edgevpr, pathlib, sys; opened = edgevpr.Map(sys.argv[1])"
MATCH_SCRIPT += "; [opened.match(cv2.imread(str(path))) for path in pathlib.Path(sys.argv[2]).iterdir()]"
FORBIDDEN_LIBRARIES = ["onnxruntime", "matplotlib"]


def make_row(what: str, value: float, unit: str, target: float | None) -> Row:
    """Return one row of the table. `target`: the largest `value` allowed; None: no limit."""
    return {"what": what, "value": value, "unit": unit, "target": target}


def measure_flight() -> list[Row]:
    """Make the map in a temporary folder, and return the rows of all measurements."""
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
    """Return the peak memory of a flight of `FRAMES` queries."""
    flight = start(place_map, frames, folder / "memory.jsonl", *LINK_FLAGS, "--rate-hz", "10")
    peak_mb, mapped = watch_memory(flight)
    finish_flight(flight)
    for name in FORBIDDEN_LIBRARIES:
        assert name not in mapped, f"{name} was imported"
    return [
        make_row("peak RSS (VmHWM)", peak_mb["VmHWM"], "MB", 130.0),
        make_row("... without libraries (RssAnon)", peak_mb["RssAnon"], "MB", None),
    ]


def measure_starts(place_map: Path, frames: Path, folder: Path) -> list[Row]:
    """Return the time from the start of the process to the first query in its log, median of `STARTS`."""
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
    """Return the CPU load without frames, in percent of one core."""
    no_stream_share = measure_idle_share(place_map, DEAD_STREAM_URI, folder / "absent.jsonl", until="start")
    no_frame_share = measure_idle_share(place_map, frames, folder / "waiting.jsonl", "--rate-hz", "0.01", until="query")
    return [
        make_row("idle CPU, stream not there", 100 * no_stream_share, "% of a core", 2.0),
        make_row("idle CPU, between two frames", 100 * no_frame_share, "% of a core", 2.0),
    ]


def measure_library_cpu(place_map: Path, frames: Path) -> Row:
    """Return the CPU time of the Python interface, relative to one OpenBLAS thread as in the commands."""
    default = {key: value for key, value in os.environ.items() if not key.endswith("_NUM_THREADS")}
    cpu_s = []
    for environment in (default, default | {"OPENBLAS_NUM_THREADS": "1"}):
        before_s = sum(os.times()[2:4])  # user and system time of child processes
        subprocess.run([sys.executable, "-c", MATCH_SCRIPT, place_map, frames], check=True, env=environment)
        cpu_s.append(sum(os.times()[2:4]) - before_s)
    return make_row("processor time of edgevpr.Map, beside one thread", cpu_s[0] / cpu_s[1], "times", 1.2)


def measure_start_s(place_map: Path, frames: Path, folder: Path) -> float:
    """Return the seconds from the start of the process to the first query in its log."""
    log = folder / "start.jsonl"
    log.unlink(missing_ok=True)
    begin_s = time.monotonic()
    flight = start(place_map, frames, log, *LINK_FLAGS)
    query = wait_for("query", log, flight)
    flight.terminate()
    finish_flight(flight)
    return query["t_mono_s"] - begin_s  # one clock for all processes


def measure_idle_share(place_map: Path, source: Path | str, log: Path, *flags: str, until: str) -> float:
    """Return the CPU load, as a share of one core, after the log has a line of the kind `until`."""
    flight = start(place_map, source, log, *LINK_FLAGS, *flags)
    wait_for(until, log, flight)
    time.sleep(SETTLE_DURATION_S)
    before_s, begin_s = read_cpu_s(flight.pid), time.monotonic()
    time.sleep(IDLE_DURATION_S)
    share = (read_cpu_s(flight.pid) - before_s) / (time.monotonic() - begin_s)
    flight.terminate()
    finish_flight(flight)
    return share


def drop_cached_pages(path: Path) -> None:
    """Remove a file from the page cache."""
    with open(path, "rb") as file:
        os.fsync(file.fileno())
        os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)
